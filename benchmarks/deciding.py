"""What a frame of group testing spends beside the decoder, in decoder passes: testimony, tests of messages, deciding.

One thread; validation scenes, five teammates, nobody attacks, after the first frames of each session.
"""

import argparse
import time

import numpy as np
import torch

from robosac.defenses.group_testing import GroupTestingSettings
from robosac.detectors import load
from robosac.evaluation.frames import encode_all
from robosac.scenes import IntersectionScene
from robosac.session import Session, defense_for

FIRST_SCENE = 1600
LEARNING = 5
"""Frames of a session before it is measured."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--frames", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    detector = load()
    defense = defense_for(GroupTestingSettings(), detector.info)
    parts: dict[str, list[float]] = {}
    for number in range(FIRST_SCENE, FIRST_SCENE + options.scenes):
        scene = IntersectionScene(number)
        ego_id, team = scene.egos[0], sorted(set(scene.agents) - {scene.egos[0]})
        session = Session(detector, team, defense, rng=np.random.default_rng(number))
        for index in range(options.frames):
            messages = encode_all(detector, scene.frame(index))
            ego = messages.pop(ego_id)
            prepared = detector.prepare(ego, messages)
            started = time.perf_counter()
            prepared.detect(team)
            decode = time.perf_counter() - started
            started = time.perf_counter()
            result = session.answer(index, ego, messages)
            whole = (time.perf_counter() - started) * 1e3
            if index >= LEARNING:
                spent = dict(result.timings_ms)
                spent["deciding"] = whole - sum(spent.values())
                for name, milliseconds in {"one decoder pass": decode * 1e3, **spent}.items():
                    parts.setdefault(name, []).append(milliseconds)
    unit = float(np.median(parts["one decoder pass"]))
    for name, values in parts.items():
        median = float(np.median(values))
        print(f"{name}: {median:.2f} ms, {median / unit:.2f} passes")


if __name__ == "__main__":
    main()
