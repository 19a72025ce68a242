"""Encode once, decode many: what preparing a frame once saves over doing it for each hypothesis."""

from __future__ import annotations

from itertools import combinations

from speed.embedded import EGO, frame
from speed.turns import Part, in_turns, rows

from robosac.scenes import IntersectionScene

ONCE = "prepared once"
TEXT = "One frame of the embedded detector with seven hypotheses of three of five teammates."


def part(turns: int) -> Part:
    """Measure it."""
    detector, ego, messages = frame()
    views = IntersectionScene(3).frame(0).views
    subsets = list(combinations(messages, 3))[:7]

    def once() -> None:
        prepared = detector.prepare(ego, messages)
        prepared.detect()
        for subset in subsets:
            prepared.detect(subset)

    def each() -> None:
        detector.prepare(ego, {}).detect()
        for subset in subsets:
            detector.prepare(ego, {name: messages[name] for name in subset}).detect(subset)

    def published() -> None:
        """As the published procedure: encoder, warps, fusion and decoder again for every hypothesis."""
        for subset in ((), *subsets):
            fresh = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
            own = fresh.pop(EGO)
            detector.prepare(own, fresh).detect(subset)

    work = {ONCE: once, "messages warped for each hypothesis": each, "encoded and warped for each": published}
    return Part("Prepared once, decoded for every hypothesis", TEXT, rows(in_turns(work, turns), ONCE))
