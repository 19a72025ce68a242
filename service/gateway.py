"""The parts of a running gateway, for whoever serves or inspects it."""

from __future__ import annotations

from dataclasses import dataclass

from service.admission import Admission
from service.engine import Engine
from service.frames import Frames
from service.metrics import Metrics
from service.sessions import Sessions


@dataclass(frozen=True)
class Gateway:
    """One gateway: the detectors and their thread, its sessions, and what answers their frames."""

    admission: Admission
    engine: Engine
    metrics: Metrics
    sessions: Sessions
    frames: Frames
