"""The parts of a running gateway, for whoever serves or inspects it."""

from __future__ import annotations

from dataclasses import dataclass

from service.admission import Admission
from service.engine import Engine
from service.frames import Frames
from service.identity import ApiKeys
from service.metrics import Metrics
from service.sessions import Sessions


@dataclass(frozen=True)
class Gateway:
    """One gateway: the detectors and their thread, its sessions, what answers their frames, and who may open one."""

    admission: Admission
    engine: Engine
    metrics: Metrics
    sessions: Sessions
    frames: Frames
    api_keys: ApiKeys
