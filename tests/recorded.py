"""A recording made without a gateway: a session of the library, written as the gateway would."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robosac import wire
from robosac.recording.content import Moment, Opening
from robosac.recording.truth import Truth
from robosac.recording.writing import RecordingFile
from robosac.scenes import IntersectionScene
from robosac.session import Session, default_defense, defense_for

EGO = "car-1"
SECOND = 10**9


@dataclass
class Said:
    message: object
    digest: str
    signature: bytes | None = None
    at: float = 1.0


def opening(detector, team, **changes):
    info = detector.info
    settings = default_defense(info)
    values = {
        "session_id": "5e" * 16,
        "ego_id": EGO,
        "teammates": team,
        "detector": info.name,
        "weights_digest": info.weights_digest,
        "calibration_digest": None,
        "defense": settings.model_dump(mode="json"),
        "least_score": info.consensus_score,
        "latency_budget_ms": 200.0,
        "frame_period_ms": 200.0,
        "created_at": "2026-11-22T12:00:00.000Z",
        "version": "0.1.0",
        "bodies": True,
        "part": 1,
    }
    return Opening(**{**values, **changes})


def moments(detector, numbers=range(3), *, attacker=None, truth=True):
    """Frames of a scene as a session decides them; what an attacker sends is the negative of its map."""
    scene = IntersectionScene(seed=8)
    team = tuple(name for name in scene.agents if name != EGO)
    session = Session(detector, team, defense_for(default_defense(detector.info), detector.info))
    for number in numbers:
        frame = scene.frame(number)
        messages = {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}
        if attacker is not None:
            sent = {name: -array for name, array in messages[attacker].tensors.items()}
            messages[attacker] = type(messages[attacker])(messages[attacker].pose, sent)
        before, previous = session.state, session.previous
        others = {name: message for name, message in messages.items() if name != EGO}
        result = session.decide(number, messages[EGO], others, np.random.default_rng(number))
        session.remember(result)
        said = {EGO: messages[EGO], **others}
        yield Moment(
            time_ns=(1_000 + number) * SECOND,
            messages={name: Said(m, wire.content_digest(number, name, m)) for name, m in said.items()},
            fused=tuple(others),
            team=team,
            seed=f"{number:064x}",
            answer=result.answer(number, {}, {"total": 5.0}, EGO),
            state=before,
            previous=previous,
            left=session.state,
            left_previous=session.previous,
            least_score=detector.info.consensus_score,
            truth=Truth(frame.truth(EGO), () if attacker is None else (attacker,)) if truth else None,
        )


def write(path: Path, detector, some, close=True, **changes):
    some = list(some)
    file = RecordingFile(path, opening(detector, some[0].team, **changes), some[0].time_ns)
    for moment in some:
        file.add(moment)
    if close:
        file.close()
    else:
        file.abandon()
    return path
