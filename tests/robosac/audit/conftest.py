import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac.answers import Distrust, Reason, Source, Verdict
from robosac.audit import GENESIS, commitment, digest, expanded, seal
from robosac.audit.events import (
    Equivocation,
    FrameAnswered,
    MessageRefused,
    Proof,
    SessionEnded,
    SessionOpened,
    TeamChanged,
)
from robosac.defenses import Outcome, Rejection
from robosac.fusion import FusionResult
from robosac.signatures import show_public_key, sign

SESSION = "5e5510"
KEY = Ed25519PrivateKey.from_private_bytes(bytes(31) + b"\x01")


def seal_all(events: Iterable[Mapping[str, Any]], session: str = SESSION) -> list[bytes]:
    """The lines of a log, chained anew."""
    lines: list[str] = []
    for seq, event in enumerate(events, 1):
        lines.append(seal(event, session, seq, digest(lines[-1]) if lines else GENESIS))
    return [line.encode() + b"\n" for line in lines]


def unpacked(line: bytes | str) -> dict[str, Any]:
    """A record at length, so that a test can change it and `seal_all` write it as format 1 did."""
    return {name: value for name, value in expanded(json.loads(line)).items() if name != "format"}


def head(lines: list[bytes]) -> str:
    return digest(lines[-1].decode().removesuffix("\n"))


def proof(name: str, frame: int, what: str = "") -> Proof:
    content = digest(f"{name} in {frame}{what}")
    return Proof(digest=content, signature=sign(KEY, SESSION, name, frame, content) if name == "rsu" else None)


def answered(
    frame: int, seed: str, *outcomes: Outcome, trusted: tuple[str, ...] = (), source=Source.CONSENSUS, missing=()
):
    accepted = outcomes[-1].teammates if source is Source.CONSENSUS else trusted
    why = Rejection(Reason.DISSENSUS, {"hypotheses": [0], "lowest_jaccard_index": 0.125})
    rejected = {"car-2": why if outcomes else Rejection(Reason.DISTRUSTED, distrust=Distrust.UNTRUSTED)}
    rejected |= {name: Rejection(Reason.MISSING) for name in missing}
    state = {"trusted": list(trusted), "frames_since_check": 0}
    boxes = np.array([[1.5, 2.0, 4.0, 2.0, 0.25, 0.75]])
    result = FusionResult(
        accepted,
        source,
        rejected,
        0.2,
        state,
        boxes=boxes,
        hypotheses=outcomes,
        deadline_met=True,
        out_of_time=False,
        fault=None,
        timings_ms={},
        previous=None,
    )
    event = FrameAnswered(
        **dict(result.answer(frame, {}, {})),
        seed=seed,
        ego_pose=np.eye(4),
        messages={name: proof(name, frame) for name in ("car-1", "car-2", "rsu", "car-3")},
        out_of_time=False,
        state=state,
        next_seed_commitment=commitment(f"{int(seed, 16) + 1:064x}"),
    )
    return event.as_json()


@pytest.fixture
def events(detector) -> list[dict[str, Any]]:
    """A static team: found in frame 0, trusted in frame 1, an equivocation, a newcomer, found again in frame 5."""
    keys = {"rsu": show_public_key(KEY)}
    opened = SessionOpened(
        version="0.1.0",
        ego_id="car-1",
        teammates=("car-2", "rsu", "car-3"),
        detector=detector.info.name,
        weights_digest=detector.info.weights_digest,
        defense={"kind": "static_team", "consensus_threshold": 0.3},
        latency_budget_ms=200.0,
        gather_ms=100.0,
        frame_period_ms=200.0,
        public_keys=keys,
        state={"trusted": [], "frames_since_check": 0},
        next_seed_commitment=commitment(f"{0:064x}"),
    )
    against = Outcome(("car-2", "rsu"), 0.125, Verdict.DISSENSUS)
    found = Outcome(("rsu", "car-3"), 0.75, Verdict.CONSENSUS)
    team = ("car-2", "rsu", "car-3", "car-4")
    change = TeamChanged(
        joined=("car-4",),
        left=(),
        teammates=team,
        public_keys=keys,
        state={"trusted": ["rsu"], "frames_since_check": 0},
    )
    refusal = MessageRefused(vehicle_id="car-2", reason=Reason.MALFORMED, detail="ein Würfel", frame=2, field="pose")
    first = Proof(digest=proof("rsu", 1).digest)
    return [
        opened.as_json(),
        answered(0, f"{0:064x}", against, found, trusted=("rsu", "car-3")),
        answered(1, f"{1:064x}", source=Source.TRUSTED, trusted=("rsu", "car-3")),
        refusal.as_json(),
        Equivocation(vehicle_id="rsu", frame=1, first=first, second=proof("rsu", 1, ", otherwise")).as_json(),
        change.as_json(),
        answered(5, f"{2:064x}", against, found, trusted=("rsu", "car-3"), missing=("car-4",)),
        SessionEnded(why="closed").as_json(),
    ]


@pytest.fixture
def lines(events) -> list[bytes]:
    return seal_all(events)
