"""The parts of a running gateway, for whoever serves or inspects it."""

from __future__ import annotations

from dataclasses import dataclass

from service.admission import Admission
from service.engine import Engine
from service.frames import Frames
from service.identity import ApiKeys
from service.metrics import Metrics
from service.opening import Opening
from service.sessions import Sessions
from service.teams import Teams


@dataclass(frozen=True)
class Gateway:
    """One gateway: detectors and their thread, sessions and teams, what answers frames, and who may open a session."""

    admission: Admission
    engine: Engine
    metrics: Metrics
    opening: Opening
    sessions: Sessions
    teams: Teams
    frames: Frames
    api_keys: ApiKeys
