"""Frames for training and validation: generated, bit-packed and kept in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.detectors.voxels import GRID, LAYERS, occupancy
from robosac.scenes import FRAME_PERIOD_S, IntersectionScene, SceneFrame


@dataclass(frozen=True)
class TrainingFrame:
    """One frame of a scene, ready for training."""

    packed: np.ndarray[Any, np.dtype[np.uint8]]
    """(A, 12288) uint8: occupancy grids of all agents, eight cells a byte."""
    poses: FloatArray
    """(A, 4, 4)."""
    near: list[FloatArray]
    """(K, 5) for each agent as ego: the vehicles within its area, in its frame."""
    hits: list[IntArray]
    """(A, K) for each agent as ego: how often each agent hit each of these vehicles."""

    def grids(self) -> np.ndarray[Any, np.dtype[np.uint8]]:
        """Occupancy (A, 6, 128, 128)."""
        return np.unpackbits(self.packed, axis=1).reshape(-1, LAYERS, GRID, GRID)

    @classmethod
    def from_scene(cls, frame: SceneFrame) -> TrainingFrame:
        """Voxelise and pack a frame."""
        views = list(frame.views.values())
        grids = np.stack([occupancy(view.points, float(view.pose[2, 3])) for view in views])
        all_hits = np.stack([view.hits for view in views])
        near, hits = [], []
        for agent in frame.views:
            boxes, index = frame.nearby(agent)
            near.append(boxes)
            hits.append(all_hits[:, index])
        poses = np.stack([view.pose for view in views])
        return cls(np.packbits(grids.reshape(len(views), -1), axis=1), poses, near, hits)


def generate(seeds: Sequence[int], frames_per_scene: int, tick: Callable[[], None]) -> list[TrainingFrame]:
    """Frames 1 s apart of every scene; ``tick`` is called after each."""
    frames = []
    for seed in seeds:
        scene = IntersectionScene(seed)
        for second in range(frames_per_scene):
            frames.append(TrainingFrame.from_scene(scene.frame(second * round(1 / FRAME_PERIOD_S))))
            tick()
    return frames
