"""How alike honest maps are, by how far their sender has driven; and what the tests of messages cost a frame.

python benchmarks/likeness.py --scenes 12
"""

import argparse
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from robosac import load_detector
from robosac.boxes import pose_matrix
from robosac.calibrated import screening_for
from robosac.detectors import Message
from robosac.scenes import IntersectionScene
from robosac.scenes.lidar import Lidar
from robosac.screening.fingerprints import fingerprints

FRAMES = 12
BACK = 5
EDGES = (0.01, 1.0, 2.0, 3.0, 5.0, np.inf)
FIRST_SEED = 1000


def correlation(a, b):
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def encoded(detector, points, pose):
    """The centred map, its sketch, and the message as it comes from the wire."""
    message = detector.encode(points, pose)
    features = np.ascontiguousarray(message.tensors["features"])
    centred = features.astype(np.float64).ravel()
    sketch = fingerprints({"": {"features": features}})[""].sketch
    return centred - centred.mean(), sketch, Message(message.pose, {"features": features})


def parked(scene):
    """The same scene with the sensors on vehicles that are parked near the middle."""
    traffic = scene._traffic
    places = traffic.vehicles_at(0.0)
    standing = np.flatnonzero(traffic.speed == 0)
    nearest = standing[np.argsort(np.hypot(*places[standing, :2].T))][:5]
    scene.__dict__["_traffic"] = replace(traffic, agent_vehicles=nearest)
    return scene


def of_scene(detector, scene, found):
    before = {}
    for index in range(FRAMES):
        views = scene.frame(index).views
        now = {name: (view.pose[:2, 3], *encoded(detector, view.points, view.pose)) for name, view in views.items()}
        names = list(now)
        for i, name in enumerate(names):
            for other in names[:i]:
                found.setdefault("two vehicles, same frame", []).append(pair(now[name], now[other]))
            for age, past in enumerate(reversed(before.get(name, []))):
                moved = float(np.hypot(*(now[name][0] - past[0])))
                where = int(np.searchsorted(EDGES, moved))
                if where or not age:
                    kind = "unmoved" if not where else f"moved {EDGES[where - 1]:g} to {EDGES[where]:g} m"
                    found.setdefault(kind, []).append(pair(now[name], past))
            before[name] = [*before.get(name, []), now[name]][-BACK:]


def of_road(detector, what, around, found):
    """A vehicle that drives 4 m a frame; ``around`` gives what is there, (B, 6), when it is at x."""
    maps = []
    for index in range(FRAMES):
        x = 4.0 * index
        rng = np.random.default_rng([5, index])
        points, _ = Lidar().scan(around(x), (x, 0.0, 1.9, 0.0), rng)
        maps.append((None, *encoded(detector, points, pose_matrix(x, 0.0, 1.9, 0.0))))
    found[what] = [pair(now, then) for then, now in pairwise(maps)]


def pair(now, then):
    return correlation(now[1], then[1]), float(now[2] @ then[2])


def cost_ms(detector):
    frame = IntersectionScene(FIRST_SEED).frame(0)
    sent = {name: encoded(detector, view.points, view.pose)[2] for name, view in frame.views.items()}
    ego, tests, best = sent.pop("car-1"), screening_for(detector.info), np.inf
    memory = tests.screen({}, 0, ego, sent).memory
    for _ in range(40):
        started = time.perf_counter()
        for _ in range(10):
            tests.screen(memory, 1, ego, sent)
        best = min(best, (time.perf_counter() - started) / 10)
    return best * 1e3


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=12)
    torch.set_num_threads(1)
    detector, found = load_detector(), {}
    for seed in range(FIRST_SEED, FIRST_SEED + parser.parse_args().scenes):
        of_scene(detector, IntersectionScene(seed), found)
        of_scene(detector, parked(IntersectionScene(seed)), found)
    walls = np.array([[0.0, 15.0, 1000.0, 1.0, 0.0, 3.0], [0.0, -15.0, 1000.0, 1.0, 0.0, 3.0]])
    platoon = np.array([[d, 0.0, 4.5, 1.9, 0.0, 1.5] for d in (-14.0, 15.0)])
    of_road(detector, "driving on an empty road", lambda _: np.array([[500.0, 500.0, 1.0, 1.0, 0.0, 2.0]]), found)
    of_road(detector, "driving between walls", lambda _: walls, found)
    of_road(detector, "driving in a platoon", lambda x: platoon + np.eye(6)[0] * x, found)
    print(f"{'':26} {'pairs':>6} {'median':>7} {'most':>6} {'most, by sketch':>16}")
    for kind, pairs in sorted(found.items()):
        maps, sketches = np.array(pairs).T
        print(f"{kind:26} {len(pairs):6} {np.median(maps):7.3f} {maps.max():6.3f} {sketches.max():16.3f}")
    print(f"tests of a frame with five teammates: {cost_ms(detector):.2f} ms")


if __name__ == "__main__":
    main()
