from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac.audit import GENESIS, commitment, digest, seal
from robosac.consensus import Verdict
from robosac.defenses import Outcome, Reason, Rejection, Source
from robosac.fusion import FusionResult
from robosac.signatures import show_public_key, sign
from service import audit
from service.gathering import Received
from service.store import SessionRecord

SESSION = "5e5510"
KEY = Ed25519PrivateKey.from_private_bytes(bytes(31) + b"\x01")


def seal_all(events: Iterable[Mapping[str, Any]], session: str = SESSION) -> list[bytes]:
    """The lines of a log, chained anew."""
    lines: list[str] = []
    for seq, event in enumerate(events, 1):
        lines.append(seal(event, session, seq, digest(lines[-1]) if lines else GENESIS))
    return [line.encode() + b"\n" for line in lines]


def head(lines: list[bytes]) -> str:
    return digest(lines[-1].decode().removesuffix("\n"))


def proof(name: str, frame: int) -> dict[str, str]:
    content = digest(f"{name} in {frame}")
    signature = sign(KEY, SESSION, content) if name == "rsu" else None
    return Received(None, content, signature).proof  # type: ignore[arg-type]


def answered(frame: int, seed: str, *outcomes: Outcome, trusted: tuple[str, ...] = (), source=Source.CONSENSUS):
    accepted = outcomes[-1].teammates if source is Source.CONSENSUS else trusted
    why = Rejection(Reason.DISSENSUS, {"hypotheses": [0], "lowest_jaccard_index": 0.125})
    rejected = {"car-2": why if outcomes else Rejection(Reason.DISTRUSTED)}
    state = {"trusted": list(trusted), "frames_since_check": 0}
    boxes = np.array([[1.5, 2.0, 4.0, 2.0, 0.25, 0.75]])
    result = FusionResult(
        boxes, source, accepted, rejected, outcomes, 0.2, True, False, None, {}, state, None
    )  # fmt: skip
    answer = {
        "frame": frame,
        "boxes": boxes.tolist(),
        "source": source.value,
        "accepted": list(accepted),
        "rejected": [{"vehicle_id": n, "reason": r.reason.value, **r.evidence} for n, r in rejected.items()],
        "hypotheses": [
            {"teammates": list(o.teammates), "jaccard_index": o.jaccard_index, "verdict": o.verdict.value}
            for o in outcomes
        ],
        "sampling_steps": len(outcomes),
    }
    event = audit.frame_answered(
        answer,
        result,
        seed=seed,
        ego_pose=np.eye(4),
        messages={name: proof(name, frame) for name in ("car-1", "car-2", "rsu", "car-3")},
        previous_frame=None,
        unlogged={},
    )
    return {**event, "next_seed_commitment": commitment(f"{int(seed, 16) + 1:064x}")}


@pytest.fixture
def events(detector) -> list[dict[str, Any]]:
    """A static team: found in frame 0, trusted in frame 1, an equivocation, a newcomer, found again in frame 5."""
    keys = {"rsu": show_public_key(KEY)}
    record = SessionRecord(
        session_id=SESSION,
        ego_id="car-1",
        teammates=("car-2", "rsu", "car-3"),
        detector=detector.info.name,
        defense={"kind": "static_team", "consensus_threshold": 0.3},
        latency_budget_ms=200.0,
        gather_ms=100.0,
        frame_period_ms=200.0,
        token_ids={},
        created_at=audit.now(),
        seed=f"{0:064x}",
        public_keys=keys,
        state={"trusted": [], "frames_since_check": 0},
    )
    against = Outcome(("car-2", "rsu"), 0.125, Verdict.DISSENSUS)
    found = Outcome(("rsu", "car-3"), 0.75, Verdict.CONSENSUS)
    team = ["car-2", "rsu", "car-3"]
    return [
        audit.session_opened(record, detector.info),
        answered(0, f"{0:064x}", against, found, trusted=("rsu", "car-3")),
        answered(1, f"{1:064x}", source=Source.TRUSTED, trusted=("rsu", "car-3")),
        audit.message_refused("car-2", Reason.MALFORMED, "ein Würfel", frame=2, field="pose"),
        audit.equivocation("rsu", 1, {"digest": proof("rsu", 1)["digest"]}, proof("rsu", 99)),
        audit.team_changed(team, [*team, "car-4"], keys, {"trusted": ["rsu"], "frames_since_check": 0}),
        answered(5, f"{2:064x}", against, found, trusted=("rsu", "car-3")),
        audit.session_ended("closed"),
    ]


@pytest.fixture
def lines(events) -> list[bytes]:
    return seal_all(events)
