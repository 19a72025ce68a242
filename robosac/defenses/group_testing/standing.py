"""How each box of an answer stands: on whose word, against whose, or taken from a fusion without whoever spoiled it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from itertools import compress

import numpy as np

from robosac.answers import Standing, Support
from robosac.boxes import BoolArray, FloatArray, IntArray, pairwise_iou
from robosac.defenses.group_testing.claims import DENIES, LEANS, NEARLY_SUPPORTS, SUPPORTS, two_witnesses
from robosac.defenses.group_testing.differences import AWAY_EFFECT, carried, gone, gone_alone
from robosac.defenses.group_testing.objects import IN_PLACE, SHOWN_SCORE, Shown
from robosac.defenses.protocol import Hypothesis, Judged, JudgedBox

SAME_M = 2.5
"""A box of another fusion, centred so near, stands for the same vehicle."""
SAME_IOU = 0.3
"""Boxes that overlap so much stand for the same vehicle."""
OVERLAP_IOU = 0.1
"""No two vehicles overlap so much."""
Repair = tuple[Shown, int]
"""A box of another fusion."""


def judge(
    answer: Shown,
    decoded: Sequence[Shown],
    reshaped: Sequence[tuple[int, Shown, int]] = (),
    of_ego: Shown | None = None,
) -> Judged:
    """Judge the boxes of an answer.

    1. A contradicted box is left out.
    2. A box that is out of place is taken from the part of the answer that has it nearest to its place; one that was
       carried off (`differences.carried`), from the part that has it where others say; and one that is ``reshaped``,
       from the part that has it in the shape that others show. One that is still out of place there is ``disputed``.
    3. A vehicle that a part of the answer shows, and the answer has lost although it stands by testimony, is taken from
       there. Of the answer without one teammate that of the others is enough, and the word of one witness, if nobody
       else denies it: then it stands as any other box. No vehicle is there twice by it.
    4. Any other box is ``confirmed`` by the ego, if all but the teammate who supports it most support it together
       (`Claims.beside`), and ``disputed`` if they do not. Where the ego does not support it, it is ``disputed`` if
       somebody denies it, or all others together lean against it (`Claims.rest`); ``confirmed`` by two teammates, of
       whom the second may nearly support it if they all do together; or ``single_witness``. Whoever sees its vehicle
       elsewhere (`Shown.seen_elsewhere`) denies it, too.

    Parameters
    ----------
    answer : Shown
    decoded : sequence of Shown
        All that was decoded in the frame.
    reshaped : sequence of tuple
        Of boxes of the answer that have a false shape: which, a part, and which box of that.
    of_ego : Shown, optional
        What the ego shows alone. An answer with one teammate has no other part: what it has lost of this, and shows
        nothing near, is taken from there if the ego supports it.
    """
    parts = [shown for shown in decoded if shown.teammates and set(shown.teammates) < set(answer.teammates)]
    away, contradicted, displaced = answer.away(), answer.contradicted, answer.displaced
    kept, repairs, by_one = ~contradicted, list[Repair](), set[tuple[Hypothesis, int]]()
    for index in np.flatnonzero(displaced).tolist():
        better = _in_place(answer.boxes[index], float(away[index]), parts)
        if better is not None:
            kept[index] = False
            repairs.append(better)
    for index, part, at in reshaped:
        if kept[index]:
            kept[index] = False
            repairs.append((part, at))
    for part in parts:
        left = [name for name in answer.teammates if name not in part.teammates]
        lost = set(gone(answer, part).tolist())
        if len(left) == 1:  # by the word of the others, too
            lost.update(gone(answer, part, left).tolist())
            alone = set(gone_alone(answer, part, left).tolist()) - lost
            by_one.update((part.teammates, at) for at in alone)
            lost |= alone
        for at in sorted(lost):
            place = part.boxes[at, :2]
            if all(np.hypot(*(place - other.boxes[i, :2])) > SAME_M for other, i in repairs):
                repairs.append((part, at))
        for index, at in carried(answer, part, left).T.tolist():
            if kept[index]:
                kept[index] = False
                repairs.append((part, at))
    if of_ego is not None and len(answer.teammates) == 1:
        repairs += [(of_ego, at) for at in _holes(answer, kept, of_ego)]
    repairs, kept = _each_once(repairs, answer, kept)
    objects = _judged(answer, np.flatnonzero(kept))
    for part, at in repairs:
        objects += _judged(part, np.array([at]), None if (part.teammates, at) in by_one else _repaired(part, at))
    return tuple(objects), tuple(_judged(answer, np.flatnonzero(contradicted), Standing.CONTRADICTED))


def _holes(answer: Shown, kept: BoolArray, of_ego: Shown) -> list[int]:
    """Boxes of what the ego shows alone, by their places there, that an answer with one teammate has lost, and that no
    box is near which it keeps (n,).
    """
    near = answer.boxes[kept & (answer.boxes[:, 5] >= SHOWN_SCORE), :2]
    lost = gone(answer, of_ego, answer.teammates).tolist()
    return [at for at in lost if np.hypot(*(near - of_ego.boxes[at, :2]).T).min(initial=np.inf) > SAME_M]


def _each_once(repairs: Sequence[Repair], answer: Shown, kept: BoolArray) -> tuple[list[Repair], BoolArray]:
    """The repairs, and the boxes (n,) of the answer that stay, so that no vehicle is there twice: what the answer has
    in its place needs no repair. A faint box gives way to one, and so does a box that overlaps it on the word of those
    alone whom the part does without: they have moved the vehicle there.
    """
    faint, chosen = answer.boxes[:, 5] < SHOWN_SCORE, list[Repair]()
    placed = kept & ~faint
    for part, at in repairs:
        box = part.boxes[at : at + 1]
        overlap = pairwise_iou(box, answer.boxes)[0]
        same = overlap >= SAME_IOU
        again = any(pairwise_iou(box, other.boxes[i : i + 1])[0, 0] >= SAME_IOU for other, i in chosen)
        if not again and not (same & placed).any():
            chosen.append((part, at))
            others = answer.claims.without(set(answer.teammates) - set(part.teammates))
            kept = kept & ~(same & faint) & ~((overlap >= OVERLAP_IOU) & ~two_witnesses(others.supporting))
    return chosen, kept


def _judged(shown: Shown, which: IntArray, status: Standing | None = None) -> list[JudgedBox]:
    """Some of the boxes of a fusion, by their places (n,); they stand as the fourth step says, or as is known."""
    claims, found = shown.claims, list[JudgedBox]()
    if not len(which):
        return found
    said, supporting, elsewhere = (
        claims.likelihood[:, which],
        claims.supporting[:, which],
        shown.seen_elsewhere[:, which],
    )
    ego, backed = supporting[0], claims.beside[which] >= SUPPORTS
    leaning = np.where(ego, ~backed, claims.rest[which] <= LEANS)
    denying = said <= np.where(leaning, np.maximum(LEANS, said.min(axis=0, initial=np.inf)), DENIES)
    second = backed & supporting.any(axis=0) & ((said >= NEARLY_SUPPORTS).sum(axis=0) >= 2)
    several = (supporting.sum(axis=0) >= 2) | second
    known = (np.where(ego, backed, several & ~denying.any(axis=0)) & ~elsewhere.any(axis=0)).tolist()
    supporting, denying = supporting & ~elsewhere, denying | elsewhere

    @cache  # most boxes have the same few witnesses
    def named(speaking: bytes) -> Hypothesis:
        return tuple(compress(claims.witnesses, speaking))

    by_box = zip(which.tolist(), supporting.T, denying.T, known, strict=True)
    for index, supports, denies, confirmed in by_box:
        witnesses, deniers = named(supports.tobytes()), named(denies.tobytes())
        unknown = Standing.DISPUTED if deniers else Standing.SINGLE_WITNESS
        stands = status or (Standing.CONFIRMED if confirmed else unknown)
        found.append(JudgedBox(shown.teammates, index, _support(stands, witnesses, deniers)))
    return found


@lru_cache(maxsize=4096)  # most boxes have the same few witnesses
def _support(status: Standing, witnesses: Hypothesis, deniers: Hypothesis) -> Support:
    return Support(status=status, witnesses=witnesses, deniers=deniers)


def _repaired(part: Shown, at: int) -> Standing:
    """How a box stands that is taken from a part; it may be less out of place there, and still be so."""
    return Standing.DISPUTED if part.away()[at] > IN_PLACE else Standing.REPAIRED


def _in_place(box: FloatArray, away: float, parts: Sequence[Shown]) -> Repair | None:
    """The box of a part that stands for this one and is least out of place."""
    best: tuple[float, Shown, int] | None = None
    for part in parts:
        for at in np.flatnonzero(np.hypot(*(part.boxes[:, :2] - box[:2]).T) < SAME_M).tolist():
            other = float(part.away()[at])
            if 0.0 < other <= away - AWAY_EFFECT and (best is None or other < best[0]):
                best = (other, part, at)
    return None if best is None else best[1:]
