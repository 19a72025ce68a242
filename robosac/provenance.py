"""From what a defence judged of single boxes to the boxes of the answer, and on whose word each stands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from robosac.answers import Support
from robosac.boxes import FloatArray
from robosac.defenses import EGO, Decision, Hypothesis, JudgedBox

Decoded = Mapping[Hypothesis, FloatArray]
"""By subset, as it was proposed: the boxes (n, 6) that were decoded of it in this frame."""


class UnverifiedAnswer(Exception):
    """A defence tried to answer with, or to trust, teammates that were not in consensus, or left one unexplained; or it
    judged boxes that are not its to answer with.
    """


def unfounded(decision: Decision, decoded: Decoded) -> Iterator[str]:
    """Why judged boxes cannot be answered with; nothing if all of them can.

    A box has to come from the accepted subset or a part of it, the ego alone among them, that was decoded in this
    frame. Each may be taken once. Whoever vouches for it or denies it has to be in the frame.

    Parameters
    ----------
    decision : Decision
        It accepts or rejects every teammate of the frame.
    decoded : mapping of subset to (n, 6) ndarray
    """
    if decision.objects is None:
        if decision.contradicted:
            yield "leaves boxes out, but judged none of those it answers with"
        return
    judged = (*decision.objects, *decision.contradicted)
    present, accepted, taken = {EGO, *decision.accepted, *decision.rejected}, set(decision.accepted), set()
    for box in judged:
        subset = tuple(box.subset)
        if not accepted.issuperset(subset):
            yield f"judges a box of some who are not all among the accepted: {list(subset)}"
        elif subset not in decoded:
            yield f"judges a box of some who were not fused in this frame: {list(subset)}"
        elif not 0 <= box.index < len(decoded[subset]):
            yield f"judges box {box.index} of {len(decoded[subset])}: {list(subset)}"
        elif (subset, box.index) in taken:
            yield f"judges box {box.index} twice: {list(subset)}"
        if not (present.issuperset(box.support.witnesses) and present.issuperset(box.support.deniers)):
            absent = {*box.support.witnesses, *box.support.deniers} - present
            yield f"takes the word of some who are not in the frame: {sorted(absent)}"
        taken.add((subset, box.index))


def best_first(judged: Sequence[JudgedBox], decoded: Decoded) -> tuple[tuple[JudgedBox, ...], FloatArray]:
    """Judged boxes by descending score, and their rows (n, 6); those of equal score stay in order."""
    if not judged:
        return (), np.zeros((0, 6))
    rows = np.array([decoded[tuple(box.subset)][box.index] for box in judged])
    order = np.argsort(-rows[:, 5], kind="stable")
    return tuple(judged[i] for i in order), rows[order]


def by_name(support: Support, ego_id: str) -> Support:
    """The same support with the ego's id in the place of `robosac.defenses.EGO`; all by name, as logs have them."""

    def named(ids: Sequence[str]) -> tuple[str, ...]:
        return tuple(sorted(ego_id if name == EGO else name for name in ids))

    return Support(status=support.status, witnesses=named(support.witnesses), deniers=named(support.deniers))
