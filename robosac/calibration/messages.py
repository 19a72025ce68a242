"""What honest messages of a detector hold: measured for the tests that they are put to before any is fused."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing import CalibrationError
from robosac.detectors import Encoder
from robosac.detectors.base import for_role
from robosac.faults import unreadable
from robosac.files import write_text
from robosac.scenes import Scene, encoded
from robosac.screening import Bounds
from robosac.screening.fingerprints import fingerprints, likeness

FRAMES = 4
"""Successive ones that are looked at of each scene."""
UNMOVED_M = 0.01
"""Nearer than this a sender stands still."""


def measure(
    detector: Encoder, scenes: Iterable[Scene], frames: int = FRAMES, tick: Callable[[], None] = lambda: None
) -> dict[str, Bounds]:
    """What the messages of all agents in the first frames of scenes hold, by tensor.

    ``still`` is 1 where nobody stands still in two successive frames: then only the same bytes are a repetition.

    Parameters
    ----------
    detector : Encoder
    scenes : iterable of Scene
        Without attackers.
    frames : int
        Of each scene, if it has so many.
    tick : callable
        Called after each scene.
    """
    largest: dict[str, float] = {}
    rms: dict[str, float] = {}
    still: list[float] = []
    for scene in scenes:
        before: dict[str, tuple[FloatArray, FloatArray]] = {}
        for index in range(frames if scene.length is None else min(frames, scene.length)):
            views = scene.frame(index).views
            sent = {name: encoded(view, detector) for name, view in views.items()}
            tensors = {name: for_role(message, detector.info, "teammate").tensors for name, message in sent.items()}
            now: dict[str, tuple[FloatArray, FloatArray]] = {}
            for name, shown in fingerprints(tensors).items():
                for tensor, (most, mean) in shown.sizes.items():
                    largest[tensor] = max(largest.get(tensor, 0.0), most)
                    rms[tensor] = max(rms.get(tensor, 0.0), mean)
                now[name] = (views[name].pose[:2, 3], shown.sketch)
                if name in before and np.hypot(*(now[name][0] - before[name][0])) < UNMOVED_M:
                    still.append(likeness(before[name][1], shown.sketch))
            before = now
        tick()
    greatest = min(max(still, default=1.0), 1.0)
    return {name: Bounds(round(largest[name], 4), round(rms[name], 4), round(greatest, 5)) for name in largest}


def held(path: Path, weights_digest: str) -> dict[str, Any]:
    """What a calibration file holds.

    Raises
    ------
    CalibrationError
        If the file cannot be read, is no calibration, or belongs to other weights.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        belongs_to = content["weights_digest"]
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {unreadable(error)}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{path} is no calibration: {error}") from error
    if belongs_to != weights_digest:
        raise CalibrationError(f"{path} belongs to weights with the digest {belongs_to!s:.12}..., calibrate again")
    return content


def add(path: Path, weights_digest: str, bounds: Mapping[str, Bounds], command: str) -> None:
    """Put what was measured into a calibration file; the rest of it stays as it is.

    Raises
    ------
    CalibrationError
        As `held`.
    """
    content = held(path, weights_digest)
    content["messages"] = {name: each.as_json() for name, each in bounds.items()}
    content["messages_command"] = command
    write_text(path, json.dumps(content) + "\n")
