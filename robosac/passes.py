"""The passes of one frame: each subset is decoded once, and several at once where the detector gains by that."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

from robosac.boxes import FloatArray
from robosac.deadline import Deadline
from robosac.defenses import Hypothesis
from robosac.detectors import PreparedFrame
from robosac.detectors.base import Batching, check_boxes


class Passes:
    """What is decoded of a prepared frame.

    Parameters
    ----------
    prepared : PreparedFrame
    deadline : Deadline
        Learns what each pass costs. Those decoded at once are one pass.
    boxes : dict of subset to (n, 6) ndarray
        What was asked for so far; it is added to. What was only decoded ahead is not among it.
    """

    def __init__(self, prepared: PreparedFrame, deadline: Deadline, boxes: dict[Hypothesis, FloatArray]) -> None:
        self._prepared = prepared
        self._deadline = deadline
        self._boxes = boxes
        self._ahead: dict[Hypothesis, FloatArray] = {}

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
                self._ahead |= self._decoded(subset, likely)
        if subset not in self._boxes:
            self._boxes[subset] = self._ahead.pop(subset)
        return self._boxes[subset]

    def _decoded(self, subset: Hypothesis, likely: Iterable[Hypothesis]) -> dict[Hypothesis, FloatArray]:
        prepared, at_once = self._prepared, [subset]
        # most are worth 1, and to see whether something has the form of a protocol takes far longer than this
        if getattr(prepared, "worth", 1) > 1 and isinstance(prepared, Batching):
            others = (other for other in likely if self.takes(other) and other not in at_once)
            for other in islice(others, self._deadline.room(prepared.worth - 1)):
                at_once.append(other)  # one by one, so that none comes twice
            if len(at_once) > 1:
                return dict(zip(at_once, map(check_boxes, prepared.detect_all(at_once)), strict=True))
        return {subset: check_boxes(prepared.detect(subset))}
