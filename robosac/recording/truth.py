"""What an ego may tell beside its message for recordings alone: what is true. Nothing is decided by it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.wire import ID_PATTERN, WireError

MOST_BOXES = 1024


@dataclass(frozen=True)
class Truth:
    """The truth about a frame, as a simulation or an annotator knows it."""

    boxes: FloatArray
    """(G, 5): x, y, length, width, yaw of all other vehicles that can be found; ego frame, metres and radians."""
    attackers: tuple[str, ...] = field(default=())
    """Teammates whose messages are not what an honest vehicle would send."""

    def as_fields(self) -> dict[str, Any]:
        """The field ``truth`` of an ego's message on the wire."""
        boxes = np.ascontiguousarray(self.boxes, dtype="<f8").reshape(-1, 5)
        sent = {"dtype": "float64", "shape": list(boxes.shape), "data": boxes.tobytes()}
        return {"boxes": sent, "attackers": list(self.attackers)}


def read_truth(payload: Any, path: str = "") -> Truth | None:
    """The truth that came with a message, if it did; ``path`` is where the message stands in its body.

    Raises
    ------
    WireError
        If it is none.
    """
    told = payload.get("truth") if isinstance(payload, dict) else None
    if told is None:
        return None
    where = f"{path}.truth" if path else "truth"
    if not isinstance(told, dict):
        raise WireError("wrong-type", where, "must be a map")
    return Truth(_boxes(told.get("boxes"), f"{where}.boxes"), _attackers(told.get("attackers", []), where))


def _boxes(sent: Any, where: str) -> FloatArray:
    if not isinstance(sent, dict):
        raise WireError("wrong-type", where, "must be a map with dtype, shape and data")
    shape, data = sent.get("shape"), sent.get("data")
    if sent.get("dtype") != "float64":
        raise WireError("wrong-dtype", f"{where}.dtype", "must be 'float64'")
    if not (isinstance(shape, list) and len(shape) == 2 and type(shape[0]) is int and shape[1] == 5):
        raise WireError("wrong-shape", f"{where}.shape", "must be [number of boxes, 5]")
    if not 0 <= shape[0] <= MOST_BOXES:
        raise WireError("out-of-range", f"{where}.shape", f"at most {MOST_BOXES} boxes")
    if not isinstance(data, bytes) or len(data) != shape[0] * 40:
        raise WireError("wrong-length", f"{where}.data", f"must be {shape[0] * 40} bytes")
    boxes = np.frombuffer(data, dtype="<f8").reshape(-1, 5).astype(np.float64)
    if not np.isfinite(boxes).all():
        raise WireError("non-finite", f"{where}.data", "holds NaN or infinity")
    if (boxes[:, 2:4] <= 0).any():
        raise WireError("out-of-range", f"{where}.data", "lengths and widths must be positive")
    return boxes


def _attackers(names: Any, where: str) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise WireError("wrong-type", f"{where}.attackers", "must be an array of vehicle ids")
    if not all(re.fullmatch(ID_PATTERN, name) for name in names):
        raise WireError("out-of-range", f"{where}.attackers", f"a vehicle id must match {ID_PATTERN}")
    return tuple(names)
