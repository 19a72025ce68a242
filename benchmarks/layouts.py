"""The mean of maps that have the same layout in memory, and of maps that have not."""

import time

import numpy as np
import torch

from robosac.detectors import load
from robosac.scenes import IntersectionScene

REPEATS = 200


def main() -> None:
    torch.set_num_threads(1)
    detector = load()
    views = IntersectionScene(3).frame(0).views
    messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    prepared = detector.prepare(messages.pop("car-1"), messages)
    alike = [prepared.own, *prepared.warped.values()]
    in_c_order = prepared.own.contiguous()
    times: dict[str, list[float]] = {"alike": [], "mixed": []}
    for _ in range(REPEATS):
        for name, maps in (("alike", alike), ("mixed", [in_c_order, *alike[1:]])):
            started = time.perf_counter()
            torch.div(sum(maps[1:], maps[0]), len(maps))
            times[name].append(time.perf_counter() - started)
    ratio = np.median(times["mixed"]) / np.median(times["alike"])
    print(f"the ego's map in another layout / all channels last, as `prepare` gives them: {ratio:.1f}")


if __name__ == "__main__":
    main()
