"""What an answer makes of the single objects that an attack lies about, beside average precision."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from robosac.answers import FrameAnswer
from robosac.attacks.situation import Lie
from robosac.boxes import FloatArray, pairwise_iou

SCORE = 0.3
"""Boxes of an answer count from this score on."""
MATCH_IOU = 0.3
"""A box finds a vehicle from this IoU on."""
NEAR_M = 2.0
"""A box centred so near to a lie shows it."""
CONFIRMED, REPAIRED, SINGLE, DISPUTED = TOLD_AS = "confirmed", "repaired", "single_witness", "disputed"
"""How a box stands that tells a lie, the surest first."""
CONTRADICTED = "contradicted"


@dataclass(frozen=True)
class Shown:
    """An answer's boxes, and how they stand."""

    boxes: FloatArray
    """(n, 6), ego frame; those of the answer that are not contradicted."""
    standing: tuple[str, ...] | None = None
    """Parallel to the boxes; None from a defence that does not know it."""
    contradicted: FloatArray = field(default_factory=lambda: np.empty((0, 6)))
    """(k, 6): those that are contradicted, whether they are left out or kept in."""

    @classmethod
    def of(cls, answer: FrameAnswer) -> Shown:
        """Of an answer."""
        boxes = answer.boxes
        support = getattr(answer, "support", None)
        if support is None:
            return cls(boxes)
        standing = [str(each.status) for each in support]
        kept = np.array([status != CONTRADICTED for status in standing], dtype=bool)
        listed = [each.box for each in getattr(answer, "contradicted", None) or ()]
        contradicted = np.vstack([boxes[~kept], np.array(listed, dtype=np.float64).reshape(-1, 6)])
        return cls(boxes[kept], tuple(s for s, k in zip(standing, kept, strict=True) if k), contradicted)


@dataclass(frozen=True)
class Judged:
    """What became of one lie in one answer."""

    number: int
    """The lie's."""
    holds: bool
    """Whether the answer tells it, too."""
    flagged: bool | None = None
    """Whether the answer says that it is contradicted, or repairs it; None from a defence that does not know."""
    told_as: str | None = None
    """How the surest box stands that tells it (`TOLD_AS`), empty if none does; None from a defence that does not know,
    and of erased vehicles.
    """


def judge(lies: Sequence[Lie], shown: Shown, truth: FloatArray, ideal: FloatArray) -> tuple[Judged, ...]:
    """Judge the lies of a frame.

    - A *ghost* holds if a box with score >= .3 lies within 2 m of it that is not the best match of a true box.
    - An *erased* vehicle, or a *dimmed* one, is missing if no box with score >= .3 has an IoU >= .3 with it. Where the
      ideal fusion does not find it either, there is nothing to judge.
    - A *moved* one holds if the nearest box within 2 m of the lie or of the truth, score >= .3, is nearer to the lie.
    - A *reshaped* one holds if the box, score >= .3, that overlaps the lie or the truth most overlaps the lie more.

    Parameters
    ----------
    lies : sequence of Lie
        Ego frame.
    shown : Shown
        What was answered.
    truth : (G, 5) ndarray
        True boxes.
    ideal : (m, 6) ndarray
        Boxes of the fusion of everybody who is honest.
    """
    found = []
    for lie in lies:
        if lie.kind == "ghost":
            found.append(_ghost(lie, shown, truth))
        elif lie.kind == "moved":
            found.append(_moved(lie, shown))
        elif lie.kind == "reshaped":
            found.append(_reshaped(lie, shown))
        elif _overlap(lie.box, ideal).max(initial=0.0) >= MATCH_IOU:
            found.append(_erased(lie, shown))
    return tuple(found)


def _ghost(lie: Lie, shown: Shown, truth: FloatArray) -> Judged:
    iou = pairwise_iou(truth, shown.boxes) if len(truth) and len(shown.boxes) else np.zeros((1, len(shown.boxes)))
    best = {int(row.argmax()) for row in iou if row.max(initial=0.0) >= MATCH_IOU}
    near = (_apart(lie.box, shown.boxes) <= NEAR_M) & (shown.boxes[:, 5] >= SCORE)
    telling = [int(index) for index in np.flatnonzero(near) if index not in best]
    return _with_standing(lie, shown, telling, bool((_apart(lie.box, shown.contradicted) <= NEAR_M).any()))


def _moved(lie: Lie, shown: Shown) -> Judged:
    to_lie = _apart(lie.box, shown.boxes)
    to_truth = _apart(lie.box if lie.truth is None else lie.truth, shown.boxes)
    nearest = np.where(shown.boxes[:, 5] >= SCORE, np.minimum(to_lie, to_truth), np.inf)
    at = int(nearest.argmin()) if nearest.min(initial=np.inf) <= NEAR_M else None
    flagged = bool((_apart(lie.box, shown.contradicted) <= NEAR_M).any()) or (
        at is not None and shown.standing is not None and shown.standing[at] == REPAIRED
    )
    return _with_standing(lie, shown, [at] if at is not None and to_lie[at] < to_truth[at] else [], flagged)


def _reshaped(lie: Lie, shown: Shown) -> Judged:
    like_lie, like_truth = (_overlap(lie.box if box is None else box, shown.boxes) for box in (lie.box, lie.truth))
    best = np.maximum(like_lie, like_truth)
    at = int(best.argmax()) if best.max(initial=0.0) > 0.0 else None
    flagged = at is not None and shown.standing is not None and shown.standing[at] == REPAIRED
    return _with_standing(lie, shown, [at] if at is not None and like_lie[at] > like_truth[at] else [], flagged)


def _erased(lie: Lie, shown: Shown) -> Judged:
    finding = np.flatnonzero(_overlap(lie.box, shown.boxes) >= MATCH_IOU)
    if shown.standing is None:
        return Judged(lie.number, not len(finding))
    return Judged(lie.number, not len(finding), any(shown.standing[i] == REPAIRED for i in finding))


def _with_standing(lie: Lie, shown: Shown, telling: Sequence[int], flagged: bool) -> Judged:
    if shown.standing is None:
        return Judged(lie.number, bool(telling))
    standing = {shown.standing[index] for index in telling}
    return Judged(lie.number, bool(telling), flagged, next((status for status in TOLD_AS if status in standing), ""))


def _apart(box: FloatArray, boxes: FloatArray) -> FloatArray:
    apart: FloatArray = np.hypot(boxes[:, 0] - box[0], boxes[:, 1] - box[1])
    return apart


def _overlap(box: FloatArray, boxes: FloatArray) -> FloatArray:
    """IoU (n,) of a vehicle with boxes (n, 6), 0 with those that do not count."""
    overlap: FloatArray = np.where(boxes[:, 5] >= SCORE, pairwise_iou(box[None], boxes)[0], 0.0)
    return overlap


@dataclass
class ObjectHistory:
    """What became of the lies of one sequence; lists are by frame."""

    judged: list[tuple[Judged, ...]] = field(default_factory=list)
    undefended: list[tuple[Judged, ...]] = field(default_factory=list)
    """Of the same lies in the fusion of everybody."""
    all_named: list[bool] = field(default_factory=list)
    """Whether all attackers that struck were named by then."""

    @property
    def first_shown(self) -> int | None:
        """The first frame in which a lie holds in the undefended fusion; None if it never does."""
        return next((n for n, frame in enumerate(self.undefended) if any(lie.holds for lie in frame)), None)

    @property
    def frames_to_name(self) -> int | None:
        """Frames from the first in which a lie shows until all attackers are named, at least 1; None if they never
        are.
        """
        first = self.first_shown
        if first is None or True not in self.all_named:
            return None
        return max(self.all_named.index(True) - first + 1, 1)

    @property
    def longest(self) -> int:
        """Most successive frames in which one and the same lie holds."""
        longest, runs = 0, dict[int, int]()
        for frame in self.judged:
            runs = {lie.number: runs.get(lie.number, 0) + 1 for lie in frame if lie.holds}
            longest = max(longest, *runs.values(), 0)
        return longest

    @property
    def frames_to_flag(self) -> list[int]:
        """Of each lie that is ever flagged or repaired, frames from the first in which it is told, at least 1."""
        first: dict[int, int] = {}
        flagged: dict[int, int] = {}
        for number, frame in enumerate(self.judged):
            for lie in frame:
                first.setdefault(lie.number, number)
                if lie.flagged:
                    flagged.setdefault(lie.number, number - first[lie.number] + 1)
        return list(flagged.values())

    @property
    def tally(self) -> Tally:
        """Counts of object frames."""
        lies = [lie for frame in self.judged for lie in frame]
        return Tally(
            frames=len(lies),
            held=sum(lie.holds for lie in lies),
            flag_known=sum(lie.flagged is not None for lie in lies),
            flagged=sum(bool(lie.flagged) for lie in lies),
            standing_known=sum(lie.told_as is not None for lie in lies),
            confirmed=sum(lie.told_as == CONFIRMED for lie in lies),
            single_witness=sum(lie.told_as == SINGLE for lie in lies),
            disputed=sum(lie.told_as == DISPUTED for lie in lies),
        )


class Tally(NamedTuple):
    """Counts of object frames: one for each lie in each frame in which it can be judged."""

    frames: int
    held: int
    flag_known: int
    flagged: int
    standing_known: int
    confirmed: int
    single_witness: int
    disputed: int


def object_rates(histories: Iterable[ObjectHistory]) -> dict[str, Any] | None:
    """Figures of several sequences, as plain values; None if no lie was judged.

    Returns
    -------
    dict
        ``object_frames``; ``held``, ``flagged``: shares of them; ``confirmed``, ``single_witness``, ``disputed``:
        shares of them in which the lie is told so, None where the defence does not know;
        ``longest``: most successive frames in which a lie holds; ``frames_to_flag``, ``frames_to_name``: means;
        ``sequences_shown``: sequences in which a lie holds in the undefended fusion at all; ``shown_named``: those of
        them in which all attackers were named.
    """
    told = [history for history in histories if any(history.judged)]
    if not told:
        return None
    total = Tally(*np.sum([history.tally for history in told], axis=0).tolist())
    shown = [history for history in told if history.first_shown is not None]
    named = [history.frames_to_name for history in shown if history.frames_to_name is not None]
    flags = [frames for history in told for frames in history.frames_to_flag]
    return {
        "object_frames": total.frames,
        "held": total.held / total.frames,
        "longest": max(history.longest for history in told),
        "flagged": total.flagged / total.flag_known if total.flag_known else None,
        **{
            status: getattr(total, status) / total.standing_known if total.standing_known else None
            for status in (CONFIRMED, SINGLE, DISPUTED)
        },
        "frames_to_flag": float(np.mean(flags)) if flags else None,
        "sequences_shown": len(shown),
        "shown_named": len(named),
        "frames_to_name": float(np.mean(named)) if named else None,
    }
