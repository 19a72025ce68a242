"""The passes of one frame: each subset is decoded once, and several at once where the detector gains by that.

Frames may share a pass. A frame that is decided in steps says before each of its passes what it will decode (`Pass`).
Whoever has several such frames can decode that `together`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

from robosac.boxes import FloatArray
from robosac.deadline import Deadline
from robosac.defenses import Hypothesis
from robosac.detectors import PreparedFrame
from robosac.detectors.base import Batching, Joining, check_boxes


class Passes:
    """What is decoded of a prepared frame.

    Parameters
    ----------
    prepared : PreparedFrame
    deadline : Deadline
        Learns what each pass costs. Those decoded at once are one pass.
    boxes : dict of subset to (n, 6) ndarray
        What was asked for so far; it is added to. What was only decoded ahead is not among it.
    ahead : mapping of subset to (n, 6) ndarray, optional
        What was decoded before.
    """

    def __init__(
        self,
        prepared: PreparedFrame,
        deadline: Deadline,
        boxes: dict[Hypothesis, FloatArray],
        ahead: Mapping[Hypothesis, FloatArray] | None = None,
    ) -> None:
        self._prepared = prepared
        self._deadline = deadline
        self._boxes = boxes
        self._ahead = {subset: check_boxes(each) for subset, each in (ahead or {}).items()}

    def takes(self, subset: Hypothesis) -> bool:
        """Whether it takes a pass to decode a subset."""
        return subset not in self._boxes and subset not in self._ahead

    def decode(self, subset: Hypothesis, likely: Iterable[Hypothesis] = ()) -> FloatArray:
        """Boxes of a subset.

        If it takes a pass, those that are ``likely`` to be asked for as well are decoded with it: as many as are worth
        it, and would have time one after the other.
        """
        if self.takes(subset):
            with self._deadline.a_pass():
                self._ahead |= self._decoded(self.at_once(subset, likely))
        if subset not in self._boxes:
            self._boxes[subset] = self._ahead.pop(subset)
        return self._boxes[subset]

    @property
    def ahead(self) -> Mapping[Hypothesis, FloatArray]:
        """What is decoded, and was not asked for so far."""
        return self._ahead

    def coming(self, subset: Hypothesis, likely: Iterable[Hypothesis] = ()) -> Pass | None:
        """The pass that `decode` would make; None if it would make none, or it cannot be made with those of others."""
        prepared = self._prepared
        # most are worth 1, and to see whether something has the form of a protocol takes far longer than this
        if getattr(prepared, "worth", 1) == 1 or not isinstance(prepared, Joining) or not self.takes(subset):
            return None
        return Pass(self, prepared, subset, likely)

    def at_once(self, subset: Hypothesis, likely: Iterable[Hypothesis]) -> list[Hypothesis]:
        """A subset, and what is decoded with it: it comes first."""
        at_once = [subset]
        if (worth := getattr(self._prepared, "worth", 1)) > 1:
            others = (other for other in likely if self.takes(other) and other not in at_once)
            for other in islice(others, self._deadline.room(worth - 1)):
                at_once.append(other)  # one by one, so that none comes twice
        return at_once

    def keep(self, subsets: Sequence[Hypothesis], found: Sequence[FloatArray], took_s: float) -> None:
        """Keep what was decoded elsewhere, in a pass that took so long."""
        self._ahead |= dict(zip(subsets, map(check_boxes, found), strict=True))
        self._deadline.expect(took_s)

    def _decoded(self, subsets: Sequence[Hypothesis]) -> dict[Hypothesis, FloatArray]:
        prepared = self._prepared
        if len(subsets) > 1 and isinstance(prepared, Batching):
            return dict(zip(subsets, map(check_boxes, prepared.detect_all(subsets)), strict=True))
        return {subset: check_boxes(prepared.detect(subset)) for subset in subsets}


@dataclass
class Pass:
    """A pass that comes next in a frame, unless it is done before the frame goes on."""

    passes: Passes
    frame: Joining
    subset: Hypothesis
    likely: Iterable[Hypothesis]
    spent_s: float = field(default=0.0, init=False)
    """Its part of the time that it took; 0 unless it was done with others."""


def together(coming: Sequence[Pass], most: int) -> None:
    """Do passes of frames of one family as one.

    Parameters
    ----------
    coming : sequence of Pass
    most : int
        Subsets that are decoded, unless more are asked for. What only may be asked for gives way.
    """
    each = max(1, most // len(coming))
    wanted = [(of.frame, of.passes.at_once(of.subset, of.likely)[:each]) for of in coming]
    began = time.perf_counter()
    found = coming[0].frame.detect_together(wanted)
    took_s = time.perf_counter() - began
    decoded = sum(len(subsets) for _, subsets in wanted)
    for of, (_, subsets), boxes in zip(coming, wanted, found, strict=True):
        of.passes.keep(subsets, boxes, took_s)
        of.spent_s = took_s * len(subsets) / decoded
