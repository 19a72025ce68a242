"""What joins and what vanishes when messages are added to a fusion: two measures on pairs of perceptions."""

from __future__ import annotations

from dataclasses import dataclass

from robosac.boxes import FloatArray, pairwise_iou

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


@dataclass(frozen=True)
class PairMeasure:
    """How the fusion of ``a + d`` differs from that of ``a``.

    Attributes
    ----------
    loss : float
        g, geometric preservation loss, in [0, 1].
    novelty : int
        v, boxes that overlap nothing of before.
    """

    loss: float
    novelty: int


def measure(smaller: FloatArray, larger: FloatArray) -> PairMeasure | None:
    """Compare the boxes (n, 6) of a fusion with those (m, 6) of the same fusion and more messages.

    ``g = 1 - mean over boxes b of the smaller, score >= .5, of max IoU(b, boxes of the larger, score >= .15)``: honest
    messages leave others' boxes where they are. ``v`` counts boxes of the larger, score >= .3, that touch no box of the
    smaller with score >= .1.

    Returns
    -------
    PairMeasure or None
        None if the smaller has fewer than two boxes to survive.
    """
    witnesses = smaller[smaller[:, 5] >= WITNESS_SCORE]
    if len(witnesses) < MIN_WITNESSES:
        return None
    survivors = larger[larger[:, 5] >= SURVIVOR_SCORE]
    kept = pairwise_iou(witnesses, survivors).max(axis=1).mean() if len(survivors) else 0.0
    claimed = larger[larger[:, 5] >= NEW_SCORE]
    known = smaller[smaller[:, 5] >= KNOWN_SCORE]
    overlap = pairwise_iou(claimed, known).max(axis=1, initial=0.0)
    return PairMeasure(1.0 - float(kept), int((overlap == 0.0).sum()))
