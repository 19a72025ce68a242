"""Preprocessed V2X-Sim samples, brought along by the user, as scenes.

A sample is ``<root>/agent{i}/{scene}_{frame}/0.npy``: a pickled dict, or the number 0 where the agent is absent. Agent
0 is the roadside unit. Nothing but arrays is unpickled, see `robosac.scenes.plain_pickle`.

No sample was at hand when this was written. It follows the published implementation's description of the format
(coperception/ROBOSAC, revision 4642aa2); what was assumed about true boxes stands in `V2XSimSample`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.detectors.v2xsim.anchors import anchor_boxes, decode, to_lidar
from robosac.detectors.v2xsim.network import ANCHORS, CODE, GRID, LAYERS
from robosac.detectors.v2xsim.voxels import BOTTOM_M, ROADSIDE_BOTTOM_M, centres
from robosac.scenes.base import SceneError, Split, View
from robosac.scenes.plain_pickle import PlainArray, UnsafePickle, load_npy

AGENTS = 6
ROADSIDE_UNIT = "agent0"
FRAME_PERIOD_S = 0.2
_VOXELS = "voxel_indices_0"
_MAPS = (GRID, GRID, ANCHORS)
_FOLDER = re.compile(r"(\d+)_(\d+)")
_SPLITS: Mapping[Split, str] = {"test": "test", "validation": "val"}

_Array = np.ndarray[tuple[Any, ...], np.dtype[Any]]
_Indices = np.ndarray[Any, np.dtype[np.int64]]


class SampleError(SceneError):
    """A file that is not a V2X-Sim sample."""


@dataclass(frozen=True)
class V2XSimSample:
    """What one agent senses and should find in one frame."""

    voxels: _Indices
    """(K, 3) int64: occupied cells along +x, +y, +z of the sensor, see `robosac.detectors.v2xsim.voxels`."""
    trans_matrices: FloatArray
    """(6, 4, 4) float64: [k] maps agent k's points into this agent's frame; zero for absent agents."""
    truth: FloatArray
    """(G, 5) float64: x, y, length, width, yaw; this agent's LiDAR frame. A true box is listed (``gt_max_iou``) by the
    anchor that fits it best. Its code is taken from ``reg_target_sparse``, assuming that this holds the codes of the
    anchors of ``allocation_mask`` in C order, and that an anchor outside that mask or ``reg_loss_mask`` stands for the
    box itself.
    """
    category: _Indices
    """(G,) int64: of each true box."""


@dataclass(frozen=True)
class V2XSimFrame:
    """One instant of a scene; the world is the frame of the first agent present."""

    index: int
    """Its place among the frames that are listed; the folder may have another number."""
    views: Mapping[str, View]
    """By agent id: those present. Points are the centres of occupied voxels. The roadside unit's are moved down with
    its pose, by 5 m, so that its voxels are as high above its sensor as a vehicle's.
    """
    boxes: Mapping[str, FloatArray]
    """By agent id: true boxes (G, 5), in that agent's frame."""

    def truth(self, ego: str) -> FloatArray:
        """True boxes (G, 5) for an ego, in its LiDAR frame."""
        return self.boxes[ego]


@dataclass(frozen=True)
class V2XSimScene:
    """A scene at 5 Hz; its agents are those present in its first frame, ``agent1`` to ``agent5`` and ``agent0``.

    From frame to frame the world stays where it is only if the roadside unit is present.
    """

    root: Path
    """The folder that holds ``agent0`` to ``agent5``."""
    number: int
    frame_period_s = FRAME_PERIOD_S

    @cached_property
    def _folders(self) -> list[str]:
        return _listed(self.root)[self.number]

    @property
    def length(self) -> int:
        """Number of frames that are listed."""
        return len(self._folders)

    @cached_property
    def agents(self) -> tuple[str, ...]:
        """Those present in the first frame, the roadside unit last."""
        return tuple(sorted(self._samples(self._folders[0]), key=lambda name: (name == ROADSIDE_UNIT, name)))

    @property
    def egos(self) -> tuple[str, ...]:
        """The vehicles among them."""
        return tuple(name for name in self.agents if name != ROADSIDE_UNIT)

    def frame(self, index: int) -> V2XSimFrame:
        """The frame of a place in the list.

        Raises
        ------
        SampleError
            If a file is not a sample, or does not say where a present agent is.
        """
        folder = self._folders[index]
        samples = self._samples(folder)
        views = {}
        for name, sample in samples.items():
            pose = next(iter(samples.values())).trans_matrices[int(name.removeprefix("agent"))].copy()
            if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3):
                raise SampleError(f"{self.root}: {folder}: no pose of {name}")
            if name == ROADSIDE_UNIT:
                pose[:3, 3] += pose[:3, 2] * (ROADSIDE_BOTTOM_M - BOTTOM_M)
            views[name] = View(pose, centres(sample.voxels))
        return V2XSimFrame(index, views, {name: sample.truth for name, sample in samples.items()})

    def _samples(self, folder: str) -> dict[str, V2XSimSample]:
        paths = {f"agent{k}": self.root / f"agent{k}" / folder / "0.npy" for k in range(AGENTS)}
        read = {name: read_sample(path) for name, path in paths.items() if path.exists()}
        return {name: sample for name, sample in read.items() if sample is not None}


class V2XSim:
    """All scenes of a folder.

    Parameters
    ----------
    root : Path or str
        The folder that holds ``agent0`` to ``agent5``, not all of which need to exist: its scenes serve any purpose.
        Or one with the folders ``test`` and ``val``, that hold them.

    Raises
    ------
    SceneError
        If there is no such folder.
    """

    kind = "v2x-sim"

    def __init__(self, root: Path | str = ".") -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise SceneError(f"{self.root} is no folder")

    @property
    def name(self) -> str:
        """``v2x-sim`` and the folder."""
        return f"v2x-sim:{self.root.resolve()}"

    def scenes(self, split: Split) -> Sequence[V2XSimScene]:
        """The scenes by their numbers.

        Raises
        ------
        SceneError
            If there is none.
        """
        part = self.root / _SPLITS[split]
        root = part if part.is_dir() else self.root
        numbers = list(_listed(root))
        if not numbers:
            raise SceneError(f"no folder agent*/<scene>_<frame> in {root}")
        return [V2XSimScene(root, number) for number in numbers]


def _listed(root: Path) -> dict[int, list[str]]:
    """Numbers of scenes, and the folders of each by the numbers of their frames.

    Raises
    ------
    SceneError
        If two folders are the same frame.
    """
    listed: dict[int, dict[int, str]] = {}
    for name in sorted({folder.name for folder in root.glob(f"agent[0-{AGENTS - 1}]/*_*")}):
        if match := _FOLDER.fullmatch(name):
            scene, frame = int(match[1]), int(match[2])
            known = listed.setdefault(scene, {}).setdefault(frame, name)
            if known != name:
                raise SceneError(f"{root}: {known} and {name} are the same frame")
    return {scene: [listed[scene][frame] for frame in sorted(listed[scene])] for scene in sorted(listed)}


def read_sample(path: Path) -> V2XSimSample | None:
    """One sample; None if the file says that the agent is absent.

    Raises
    ------
    SampleError
        If the file is not a sample; for what a hostile pickle asks for, too.
    OSError
        If it cannot be read.
    """
    try:
        content = load_npy(path)
        if isinstance(content, np.ndarray) and content.shape == () and content == 0:
            return None
        if not isinstance(content, dict):
            raise SampleError("must hold a dict, or the number 0")
        return _sample(content)
    except (SampleError, UnsafePickle) as error:
        raise SampleError(f"{path}: {error}") from error


def _sample(fields: Mapping[Any, Any]) -> V2XSimSample:
    voxels = _indices(fields, _VOXELS, (GRID, GRID, LAYERS))
    matrices = _array(fields, "trans_matrices", (AGENTS, 4, 4)).astype(np.float64)
    if not np.isfinite(matrices).all():
        raise SampleError("trans_matrices holds NaN or infinity")
    best = _indices(fields, "gt_max_iou", (*_MAPS, 2**31))
    anchor = np.ravel_multi_index((best[:, 0], best[:, 1], best[:, 2]), _MAPS)
    boxes = to_lidar(decode(anchor_boxes(anchor), _codes(fields, anchor)))
    return V2XSimSample(voxels, matrices, boxes, best[:, 3])


def _codes(fields: Mapping[Any, Any], anchor: _Indices) -> FloatArray:
    """Codes (G, 6) of the true boxes at these anchors (G,); zero, the anchor itself, where there is none."""
    allocated = np.flatnonzero(_array(fields, "allocation_mask", _MAPS))
    sparse = _array(fields, "reg_target_sparse", (len(allocated), 1, CODE))[:, 0].astype(np.float64)
    counted = _array(fields, "reg_loss_mask", (*_MAPS, 1)).reshape(-1)[anchor].astype(bool)
    codes = np.zeros((len(anchor), CODE))
    codes[:, 5] = 1.0
    place = np.searchsorted(allocated, anchor)
    known = counted & np.isin(anchor, allocated)
    codes[known] = sparse[place[known]]
    if not np.isfinite(codes).all():
        raise SampleError("reg_target_sparse holds NaN or infinity")
    return codes


def _indices(fields: Mapping[Any, Any], name: str, limits: tuple[int, ...]) -> _Indices:
    """Rows of whole numbers, each at least 0 and below its column's limit."""
    value = _array(fields, name, None)
    if value.size == 0:
        return np.zeros((0, len(limits)), dtype=np.int64)
    if value.ndim != 2 or value.shape[1] != len(limits):
        raise SampleError(f"{name} must have the shape (n, {len(limits)}), got {value.shape}")
    rows = value.astype(np.int64)
    if (rows != value).any() or (rows < 0).any() or (rows >= np.array(limits)).any():
        raise SampleError(f"{name} must hold whole numbers from 0 to below {limits}")
    return rows


def _array(fields: Mapping[Any, Any], name: str, shape: tuple[int, ...] | None) -> _Array:
    if name not in fields:
        raise SampleError(f"{name} is missing")
    if not isinstance(fields[name], PlainArray):
        raise SampleError(f"{name} must be an array")
    value: _Array = fields[name].read()
    if shape is not None and value.shape != shape:
        raise SampleError(f"{name} must have the shape {shape}, got {value.shape}")
    return value
