"""Encode once, decode many: what preparing a frame once saves over doing it for each hypothesis."""

import time
from itertools import combinations

import numpy as np
import torch

from robosac.detectors import load
from robosac.scenes import IntersectionScene

REPEATS = 40


def main() -> None:
    torch.set_num_threads(1)
    detector = load()
    frame = IntersectionScene(3).frame(0)
    views = frame.views
    messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    ego = messages.pop("car-1")
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
            own = fresh.pop("car-1")
            detector.prepare(own, fresh).detect(subset)

    times: dict[str, list[float]] = {"once": [], "each": [], "published": []}
    for function in (once, each, published):
        function()
    for _ in range(REPEATS):
        for name, function in (("once", once), ("each", each), ("published", published)):
            started = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - started)
    base = np.median(times["once"])
    print(f"one frame, {len(subsets)} hypotheses of 3 of 5 teammates, one thread; ratios of medians of {REPEATS} turns")
    print(f"  warp again for each hypothesis / prepare once          {np.median(times['each']) / base:.2f}")
    print(f"  encode and warp again for each hypothesis / prepare once {np.median(times['published']) / base:.2f}")


if __name__ == "__main__":
    main()
