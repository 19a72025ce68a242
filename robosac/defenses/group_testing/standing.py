"""How each box of an answer stands: on whose word, against whose, or taken from a fusion without whoever spoiled it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import numpy as np

from robosac.answers import Standing, Support
from robosac.boxes import FloatArray
from robosac.defenses.group_testing.claims import DENIES, LEANS, NEARLY_SUPPORTS, SUPPORTS
from robosac.defenses.group_testing.differences import AWAY_EFFECT, gone, gone_alone
from robosac.defenses.group_testing.objects import Shown
from robosac.defenses.protocol import JudgedBox

SAME_M = 2.5
"""A box of another fusion, centred so near, stands for the same vehicle."""
Judged = tuple[tuple[JudgedBox, ...], tuple[JudgedBox, ...]]
"""Boxes of an answer, and those that are contradicted."""


def judge(answer: Shown, decoded: Sequence[Shown]) -> Judged:
    """Judge the boxes of an answer.

    1. A contradicted box is left out.
    2. A box that is out of place is taken from the part of the answer that has it nearest to its place.
    3. A vehicle that a part of the answer shows, and the answer has lost although it stands by testimony, is taken from
       there. Of the answer without one teammate the word of one witness is enough, if nobody else denies it.
    4. Any other box is ``confirmed`` by the ego, if all but the teammate who supports it most support it together
       (`Claims.beside`), and ``disputed`` if they do not. Where the ego does not support it, it is ``disputed`` if
       somebody denies it, or all others together lean against it (`Claims.rest`); ``confirmed`` by two teammates, of
       whom the second may nearly support it if they all do together; or ``single_witness``.

    Parameters
    ----------
    answer : Shown
    decoded : sequence of Shown
        All that was decoded in the frame.
    """
    parts = [shown for shown in decoded if shown.teammates and set(shown.teammates) < set(answer.teammates)]
    kept: dict[tuple[tuple[str, ...], int], JudgedBox] = {}
    left_out: list[JudgedBox] = []

    def keep(shown: Shown, index: int, status: Standing | None = None) -> None:
        kept.setdefault((shown.teammates, index), _judged(shown, index, status))

    away, contradicted, displaced = answer.away(), answer.contradicted, answer.displaced
    repaired: list[FloatArray] = []
    for index, box in enumerate(answer.boxes):
        better = _in_place(box, float(away[index]), parts) if displaced[index] else None
        if contradicted[index]:
            left_out.append(_judged(answer, index, Standing.CONTRADICTED))
        elif better is not None:
            part, at = better
            keep(part, at, Standing.REPAIRED)
            repaired.append(part.boxes[at, :2])
        else:
            keep(answer, index)
    for part in parts:
        left = [name for name in answer.teammates if name not in part.teammates]
        alone: list[int] = gone_alone(answer, part, left).tolist() if len(left) == 1 else []
        for at in (*gone(answer, part).tolist(), *alone):
            place = part.boxes[at, :2]
            if all(np.hypot(*(place - other)) > SAME_M for other in repaired):
                keep(part, at, Standing.REPAIRED)
                repaired.append(place)
    return tuple(kept.values()), tuple(left_out)


def _judged(shown: Shown, index: int, status: Standing | None) -> JudgedBox:
    claims = shown.claims
    supporting, said = claims.by_box[0][index], claims.by_box[1][index]
    witnesses = tuple(compress(claims.witnesses, supporting))
    ego, backed = supporting[0], claims.beside[index] >= SUPPORTS
    leaning = not backed if ego else claims.rest[index] <= LEANS
    least = max(LEANS, min(said)) if leaning else DENIES
    deniers = tuple(compress(claims.witnesses, map(least.__ge__, said)))
    if status is None:
        several = len(witnesses) >= 2 or (witnesses and backed and sorted(said)[-2:][0] >= NEARLY_SUPPORTS)
        known = backed if ego else several and not deniers
        unknown = Standing.DISPUTED if deniers else Standing.SINGLE_WITNESS
        status = Standing.CONFIRMED if known else unknown
    return JudgedBox(shown.teammates, index, Support(status=status, witnesses=witnesses, deniers=deniers))


def _in_place(box: FloatArray, away: float, parts: Sequence[Shown]) -> tuple[Shown, int] | None:
    """The box of a part that stands for this one and is least out of place."""
    best: tuple[float, Shown, int] | None = None
    for part in parts:
        for at in np.flatnonzero(np.hypot(*(part.boxes[:, :2] - box[:2]).T) < SAME_M).tolist():
            other = float(part.away()[at])
            if 0.0 < other <= away - AWAY_EFFECT and (best is None or other < best[0]):
                best = (other, part, at)
    return None if best is None else best[1:]
