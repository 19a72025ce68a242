"""Vehicles that a fusion shows in another shape than they have: turned, stretched or shrunk.

Witnesses say where a vehicle is, not how it heads nor how large it is. So where a vehicle has another shape without
somebody, others are asked what each of them shows of it, fused with the ego alone.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from robosac.boxes import FloatArray, IntArray, laid_iou
from robosac.defenses.group_testing.claims import SUPPORTS, two_witnesses
from robosac.defenses.group_testing.differences import SAME_BOX_M, same_boxes
from robosac.defenses.group_testing.objects import PLACED_SCORE, Shown
from robosac.defenses.protocol import EGO

SHAPED_SCORE = 0.6
"""Boxes from this score on have a shape."""
OTHER_SHAPE = 0.65
"""Two boxes have different shapes if they overlap by less, laid on one another."""
IN_PLACE_M = 0.5
"""They are centred so near each other, or one of them is out of place, as witnesses tell."""
LIKE = 0.75
"""A box is like another one if they overlap by so much, laid on one another."""
RATHER = 0.15
"""A box is rather like one of two others if it overlaps that one by so much more."""
ASKED = 3
"""So many are asked, or two that lie together could not be outvoted."""
BLAMING = 3
"""It takes so many, of whom the ego may be one, to blame somebody for a shape: where a detector is unsure, two often
agree by chance.
"""
_TURNED, _GROWN, _THIN_M = 0.1, 0.1, 1e-3


def reshaped(joined: Shown, without: Shown, suspects: Collection[str]) -> IntArray:
    """Boxes of two fusions, by their places in each (2, k), that show one vehicle in different shapes.

    Both have a score of .6 or more, and the ego or two teammates but the suspects support the second. They are centred
    within .5 m of each other. Laid on one another they overlap by less than .65.
    """
    supported = two_witnesses(without.claims.without(suspects).supporting)
    crisp = joined.boxes[:, 5] >= SHAPED_SCORE, (without.boxes[:, 5] >= SHAPED_SCORE) & supported
    found = np.stack(same_boxes(joined, without, *crisp))
    now, before = joined.boxes[found[0]], without.boxes[found[1]]
    grown = np.abs(np.log(np.maximum(now[:, 2:4], _THIN_M) / np.maximum(before[:, 2:4], _THIN_M))).max(axis=1)
    differ = (np.abs(np.sin(now[:, 4] - before[:, 4])) > _TURNED) | (grown > _GROWN)  # spares most boxes the overlap
    found = found[:, differ & (np.hypot(*(now - before)[:, :2].T) <= IN_PLACE_M)]
    return found[:, laid_iou(joined.boxes[found[0]], without.boxes[found[1]]) < OTHER_SHAPE]


def to_ask(without: Shown, at: int) -> tuple[str, ...]:
    """Whom to ask for the shape of a vehicle: those fused who support it most."""
    claims = without.claims
    said = {name: claims.likelihood[i, at] for i, name in enumerate(claims.witnesses) if name in without.teammates}
    return tuple(sorted((name for name in said if said[name] >= SUPPORTS), key=lambda name: -said[name])[:ASKED])


def agreeing(now: FloatArray, before: FloatArray, alone: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Who shows a vehicle rather in the shape that it had before, if those are enough to go by: the ego, or two
    teammates; and more than show it in the shape that it has now.

    Parameters
    ----------
    now, before : (6,) ndarray
    alone : mapping of str to (n, 6) ndarray
        What each shows that was asked, the ego among them.
    """
    likes = {name: _likes(boxes, now, before) for name, boxes in alone.items()}
    names = tuple(name for name, like in likes.items() if like > 0)
    enough = EGO in names or len(names) >= 2
    return names if enough and sum(likes.values()) > 0 else ()


def _likes(boxes: FloatArray, now: FloatArray, before: FloatArray) -> int:
    """Whether somebody's own boxes (n, 6) show a vehicle rather as before, 1, or as now, -1; else 0."""
    boxes = boxes[boxes[:, 5] >= PLACED_SCORE]
    apart = np.hypot(*(boxes[:, :2] - before[:2]).T)
    if apart.min(initial=np.inf) > SAME_BOX_M:
        return 0
    own = boxes[[apart.argmin()] * 2]
    as_now, as_before = laid_iou(own, np.stack([now, before])).tolist()
    return int(as_before >= max(LIKE, as_now + RATHER)) - int(as_now >= max(LIKE, as_before + RATHER))
