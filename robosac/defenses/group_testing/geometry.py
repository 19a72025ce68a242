"""What joins and what vanishes: when messages are added to a fusion, and from one frame to the next."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray, pairwise_iou, to_world

WITNESS_SCORE = 0.5
"""Boxes of the smaller fusion from this score on must survive in the larger one."""
SURVIVOR_SCORE = 0.15
"""A box of the larger fusion from this score on counts as surviving."""
NEW_SCORE = 0.3
"""A box of the larger fusion from this score on counts as new if nothing was there."""
KNOWN_SCORE = 0.1
"""A box of the smaller fusion from this score on counts as something there."""
MIN_WITNESSES = 2
"""With fewer boxes to survive there is no evidence."""
SAME_IOU = 0.5
"""A box of the larger fusion that stands in its place by the word of others is the same vehicle from this IoU on."""
HARDLY_IOU = 0.05
"""A box that nothing overlaps by so much is lost; one that something overlaps by less than `SAME_IOU` is moved."""
SAME_LOSS = 0.1
"""Such a box counts as this much lost, at most: about what a box changes between honest fusions on average."""


ALONG_M = 4.5
ACROSS_M = 0.8
TURN_RAD = 0.4
"""How far a vehicle gets from one frame to the next, along itself (22 m/s at 5 Hz) and across, and how far it turns."""


@dataclass(frozen=True, eq=False)
class Compared:
    """The boxes that a pair is measured by."""

    witnesses: FloatArray
    """(n, 6): boxes of ``a`` that are to survive."""
    lost: FloatArray
    """(n,): how much of each is lost, in [0, 1]."""
    added: FloatArray
    """(m, 6): boxes of ``a + d`` that overlap nothing of before."""

    def places(self) -> Mapping[str, FloatArray]:
        """Centres (k, 2) of boxes that are lost, moved and added."""
        lost = self.lost > 1.0 - HARDLY_IOU
        moved = (self.lost > 1.0 - SAME_IOU) & ~lost
        boxes = {"lost": self.witnesses[lost], "moved": self.witnesses[moved], "added": self.added}
        return {name: of[:, :2] for name, of in boxes.items()}


@dataclass(frozen=True)
class PairMeasure:
    """How the fusion of ``a + d`` differs from that of ``a``."""

    loss: float
    """g, geometric preservation loss, in [0, 1]."""
    novelty: int
    """v, boxes that overlap nothing of before."""
    compared: Compared | None = field(default=None, compare=False, repr=False)
    """Box by box, where there were boxes."""


@dataclass(frozen=True)
class Said:
    """What others than those who join say of the boxes of a fusion (n, 6), and of the larger one with them (m, 6)."""

    real: BoolArray
    """(n,): there is a vehicle."""
    vouched: BoolArray
    """(m,): there is a vehicle."""
    in_place: BoolArray
    """(m,): the vehicle is where the box is."""


def measure(
    smaller: FloatArray, larger: FloatArray, said: Said | None = None, overlap: FloatArray | None = None
) -> PairMeasure | None:
    """Compare the boxes (n, 6) of a fusion with those (m, 6) of the same fusion and more messages, whose ``overlap``
    (m, n) with the former may be known.

    ``g = 1 - mean over boxes b of the smaller, score >= .5, of max IoU(b, boxes of the larger, score >= .15)``: honest
    messages leave others' boxes where they are. ``v`` counts boxes of the larger, score >= .3, that touch no box of the
    smaller with score >= .1.

    Where others have ``said`` something, boxes of the smaller that are not real by that count for nothing, and those of
    the larger that are vouched for are not new. A box whose best IoU is at least .5, with one that is in its place,
    loses at most .1: there the detector is unsure of a vehicle's size, and nobody has moved it.

    Returns
    -------
    PairMeasure or None
        None if the smaller has fewer than two boxes to survive.
    """
    witnesses = (smaller[:, 5] >= WITNESS_SCORE) & (True if said is None else said.real)
    if np.count_nonzero(witnesses) < MIN_WITNESSES:
        return None
    overlap = pairwise_iou(larger, smaller) if overlap is None else overlap
    surviving = larger[:, 5] >= SURVIVOR_SCORE
    kept = overlap[surviving][:, witnesses]
    lost = 1.0 - kept.max(axis=0, initial=0.0)
    if said is not None and len(kept):
        same = said.in_place[surviving][kept.argmax(axis=0)] & (lost <= 1.0 - SAME_IOU)
        lost = np.where(same, np.minimum(lost, SAME_LOSS), lost)
    claimed = (larger[:, 5] >= NEW_SCORE) & (True if said is None else ~said.vouched)
    known = smaller[:, 5] >= KNOWN_SCORE
    added = larger[claimed & (overlap[:, known].max(axis=1, initial=0.0) == 0.0)]
    return PairMeasure(float(lost.mean()), len(added), Compared(smaller[witnesses], lost, added))


def followed(boxes: FloatArray, pose: FloatArray) -> FloatArray:
    """What is kept of the boxes (n, 6) of a fusion for the next frame, in the world frame.

    Parameters
    ----------
    boxes : (n, 6) ndarray
        Ego frame.
    pose : (4, 4) ndarray
        world_from_sensor of the ego.

    Returns
    -------
    (m, 4) ndarray
        x, y, yaw (up to half a turn, from -pi / 8 on), score, rounded to 1e-6, of the boxes with score >= .1.
    """
    placed = to_world(boxes[boxes[:, 5] >= KNOWN_SCORE], pose)
    placed[:, 4] = (placed[:, 4] + np.pi / 8) % np.pi - np.pi / 8  # the seam where few vehicles head
    return placed[:, [0, 1, 4, 5]].round(6)


def crowd(now: FloatArray) -> int:
    """Boxes (n, 4), as `followed` gives them, that may have come: those with score >= .3."""
    return int((now[:, 3] >= NEW_SCORE).sum())


def changes(before: FloatArray, now: FloatArray, real: Callable[[FloatArray], BoolArray] | None = None) -> int:
    """How many boxes came or went, see `come_and_gone`."""
    return sum(map(len, come_and_gone(before, now, real)))


def come_and_gone(
    before: FloatArray, now: FloatArray, real: Callable[[FloatArray], BoolArray] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Boxes that came or went between two frames of one fusion, (n, 4) and (m, 4), as `followed` gives them.

    A box has come if it has a score >= .3 and before none was kept where it can have been; it has gone if it had a
    score >= .5 and none is kept where it can be. It can get as far as `ALONG_M`, `ACROSS_M` and `TURN_RAD`
    say; front and rear are not told apart. What is there stays, or drives on: made-up boxes, and boxes that a
    perturbed map shakes, come and go. ``real`` says of boxes (n, 4) in which places a vehicle stands by the word of
    others: if a box comes and goes there, the detector is unsure, and nobody has made it up.
    """
    came, gone = _nowhere(now[now[:, 3] >= NEW_SCORE], before), gone_since(before, now)
    if real is None or not len(came) + len(gone):
        return came, gone
    counts = ~real(np.concatenate([came, gone]))
    return came[counts[: len(came)]], gone[counts[len(came) :]]


def gone_since(before: FloatArray, now: FloatArray) -> FloatArray:
    """Boxes (m, 4) that have gone, see `come_and_gone`, whoever says what of them."""
    return _nowhere(before[before[:, 3] >= WITNESS_SCORE], now)


def same_vehicles(
    boxes: FloatArray, others: FloatArray, along_m: float = ALONG_M, across_m: float = ACROSS_M
) -> tuple[IntArray, IntArray]:
    """Pairs (k,) of boxes (n, 4) and others (m, 4), by their places, of which one is where the other can get, by
    default in a frame.
    """
    x, y = boxes[:, :1] - others[:, 0], boxes[:, 1:2] - others[:, 1]
    cos, sin = np.cos(boxes[:, 2:3]), np.sin(boxes[:, 2:3])
    along, across = np.abs(cos * x + sin * y), np.abs(cos * y - sin * x)
    one, other = np.nonzero((along < along_m) & (across < across_m))
    turned = np.abs((boxes[one, 2] - others[other, 2] + np.pi / 2) % np.pi - np.pi / 2) < TURN_RAD
    return one[turned], other[turned]


def _nowhere(boxes: FloatArray, others: FloatArray) -> FloatArray:
    """Those boxes that are none of the others."""
    alone = np.ones(len(boxes), dtype=bool)
    alone[same_vehicles(boxes, others)[0]] = False
    nowhere: FloatArray = boxes[alone]
    return nowhere
