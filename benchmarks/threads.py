"""Frames a second by threads: one that decides frame after frame, against two at a time, or two inside a pass."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

import robosac

FRAMES = 24
TURNS = 9
WAYS = {"one frame at a time, one torch thread": (1, 1), "one, two torch threads": (1, 2), "two, one each": (2, 1)}


def main() -> None:
    detector = robosac.load_detector()
    views = robosac.IntersectionScene(seed=8).frame(0).views
    messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    ego = messages.pop("car-1")

    def decide(seed: int) -> None:
        robosac.fuse(detector, robosac.SampleConsensus(), ego, messages, rng=np.random.default_rng(seed))

    rates: dict[str, list[float]] = {way: [] for way in WAYS}
    for _ in range(TURNS):
        for way, (frames, threads) in WAYS.items():
            with ThreadPoolExecutor(frames, initializer=torch.set_num_threads, initargs=(threads,)) as pool:
                list(pool.map(decide, range(frames * 2)))  # threads and kernels are warm
                started = time.perf_counter()
                list(pool.map(decide, range(FRAMES)))
                rates[way].append(FRAMES / (time.perf_counter() - started))
    first = next(iter(WAYS))
    for way, measured in rates.items():
        print(f"{way}: {np.median(np.array(measured) / rates[first]):.2f} times the frames a second of the first")


if __name__ == "__main__":
    main()
