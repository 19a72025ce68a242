"""Bytes of an audit record by field: what a gateway would write of frames of the synthetic intersection."""

from __future__ import annotations

import json
import secrets
import time
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np
import torch
import typer

from robosac import attacks, wire
from robosac.audit import FULL_EVERY, GENESIS, Unsealed, Writer, commitment
from robosac.audit.events import FrameAnswered, Proof
from robosac.detectors import Message, load
from robosac.evaluation.frames import Sensed, under_attack
from robosac.fusion import FusionResult
from robosac.scenes import IntersectionScene
from robosac.session import Session

EGO = "car-1"


def main(
    teammates: int = 5,
    attackers: int = 1,
    frames: int = 60,
    seed: int = 7,
    full_every: int = FULL_EVERY,
    signed: bool = False,
) -> None:
    """Print bytes a record: of full records, of the others, on average of a long log; and by field of the others."""
    torch.set_num_threads(1)
    writer, follows, full, short, spent = Writer(full_every), None, [], [], []
    for event in events(teammates, attackers, frames, seed, signed):
        started = time.perf_counter()
        record, _, writer = writer.record(event, follows)
        line = Unsealed(record).seal(secrets.token_hex(16), event.frame + 2, GENESIS)
        spent.append(time.perf_counter() - started)
        follows = event.frame
        (full if "state" in record else short).append(line)
        state = len(Unsealed({"state": event.state}).parts["state"])
    sizes = [float(np.mean([len(line) for line in lines])) for lines in (full, short)]
    long_run = (sizes[0] + (full_every - 1) * sizes[1]) / full_every
    print(f"{teammates} teammates: full {sizes[0]:.0f} bytes, others {sizes[1]:.0f}, on average {long_run:.0f}")
    print(f"{1e3 * np.median(spent):.1f} ms to write; the state alone is {state} bytes of JSON")
    by_field = Counter[str]()
    for line in short:
        for name, value in json.loads(line).items():
            by_field[name] += len(json.dumps(value, separators=(",", ":"))) + len(name) + 4
    for name, nbytes in by_field.most_common():
        print(f"  {name:22s}{nbytes / len(short):8.0f}")


def events(teammates: int, attackers: int, frames: int, seed: int, signed: bool) -> Iterator[FrameAnswered]:
    detector, rng = load(), np.random.default_rng(seed)
    scene = IntersectionScene(seed)
    seen = sorted(set(scene.agents) - {EGO})
    team = [*seen, *(f"car-{i}" for i in range(len(seen) + 2, teammates + 2))]
    bad = frozenset(rng.choice(seen, attackers, replace=False).tolist())
    session = Session(detector, team, rng=rng)
    for frame in range(frames):
        sensed = Sensed.of(detector, scene.frame(frame), EGO, 0.0, rng)
        met = under_attack(detector, sensed, bad, attacks.load("pgd"), rng)
        honest = [met.teammates[name] for name in seen if name not in bad]
        sent = {name: met.teammates.get(name) or like(honest[i % len(honest)], rng) for i, name in enumerate(team)}
        before = session.previous
        result = session.answer(frame, met.ego, sent)
        yield event(result, frame, met.ego, sent, None if before is None else before.frame, signed)


def event(  # all that an event says
    result: FusionResult,
    frame: int,
    ego: Message,
    sent: Mapping[str, Message],
    previous_frame: int | None,
    signed: bool,
) -> FrameAnswered:
    """What a gateway puts on record of a frame."""
    seed_text, said = secrets.token_hex(32), {EGO: ego, **sent}
    proofs = {
        name: Proof(
            digest=wire.content_digest(frame, name, message),
            signature=secrets.token_bytes(64) if signed else None,
        )
        for name, message in said.items()
    }
    spent = {**result.timings_ms, "receive": 2.125, "gather": 0.017, "queue": 0.125, "total": 61.25}
    return FrameAnswered(
        **dict(result.answer(frame, {}, spent, EGO)),
        seed=seed_text,
        ego_pose=ego.pose,
        messages=proofs,
        previous_frame=previous_frame,
        out_of_time=result.out_of_time,
        fault=result.fault,
        state=dict(result.state),
        next_seed_commitment=commitment(seed_text),
    )


def like(message: Message, rng: np.random.Generator) -> Message:
    """What another vehicle beside the sender might send: a scene holds no more than five."""
    noisy = {
        name: (tensor + 0.02 * rng.standard_normal(tensor.shape) * (tensor != 0)).astype(tensor.dtype)
        for name, tensor in message.tensors.items()
    }
    return Message(message.pose, noisy)


if __name__ == "__main__":
    typer.run(main)
