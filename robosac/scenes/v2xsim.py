"""Reader for preprocessed V2X-Sim samples, brought along by the user.

A sample is ``<root>/agent{i}/{scene}_{frame}/0.npy``: a pickled dict, or the number 0 where the agent is absent. Agent
0 is the roadside unit. Nothing but arrays is unpickled, see `robosac.scenes.plain_pickle`.

No sample was at hand when this was written. It follows the published implementation's description of the format
(coperception/ROBOSAC, revision 4642aa2); what was assumed about true boxes stands in `V2XSimSample`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.detectors.v2xsim.anchors import anchor_boxes, decode, to_lidar
from robosac.detectors.v2xsim.network import ANCHORS, CODE, GRID, LAYERS
from robosac.detectors.v2xsim.voxels import BoolArray, from_indices
from robosac.scenes.plain_pickle import PlainArray, UnsafePickle, load_npy

AGENTS = 6
ROADSIDE_UNIT = "agent0"
_VOXELS = "voxel_indices_0"
_MAPS = (GRID, GRID, ANCHORS)
_FOLDER = re.compile(r"(\d+)_(\d+)")

_Array = np.ndarray[tuple[Any, ...], np.dtype[Any]]


class SampleError(ValueError):
    """A file that is not a V2X-Sim sample."""


@dataclass(frozen=True)
class V2XSimSample:
    """What one agent senses and should find in one frame.

    Attributes
    ----------
    grid : (256, 256, 13) bool ndarray
        Occupancy, as `robosac.detectors.v2xsim.V2XSimDetector.encode_grid` takes it.
    trans_matrices : (6, 4, 4) float64 ndarray
        [k] maps agent k's points into this agent's frame; zero for absent agents.
    truth : (G, 5) float64 ndarray
        x, y, length, width, yaw; this agent's LiDAR frame. A true box is listed (``gt_max_iou``) by the anchor that
        fits it best. Its code is taken from ``reg_target_sparse``, assuming that this holds the codes of the anchors of
        ``allocation_mask`` in C order, and that an anchor outside that mask or ``reg_loss_mask`` stands for the box
        itself.
    category : (G,) int64 ndarray
        Of each true box.
    """

    grid: BoolArray
    trans_matrices: FloatArray
    truth: FloatArray
    category: np.ndarray[Any, np.dtype[np.int64]]


@dataclass(frozen=True)
class V2XSimFrame:
    """One instant of a scene.

    Attributes
    ----------
    scene, index : int
    samples : mapping of agent id to V2XSimSample
        Those present; ids are ``agent0`` to ``agent5``.
    """

    scene: int
    index: int
    samples: Mapping[str, V2XSimSample]

    def pose(self, agent: str) -> FloatArray:
        """world_from_sensor (4, 4) of an agent; the world is the frame of the first agent present.

        Raises
        ------
        SampleError
            If that agent's sample does not say where this one is.
        """
        first = next(iter(self.samples.values()))
        pose: FloatArray = first.trans_matrices[int(agent.removeprefix("agent"))]
        if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3):
            raise SampleError(f"scene {self.scene}, frame {self.index}: no pose of {agent}")
        return pose

    def truth(self, ego: str) -> FloatArray:
        """True boxes (G, 5) for an ego, in its LiDAR frame."""
        return self.samples[ego].truth


def scenes(root: Path) -> dict[int, list[int]]:
    """The scenes in a folder, and the indices of the frames of each, in order.

    Parameters
    ----------
    root : Path
        The folder that holds ``agent0`` to ``agent5``; not all need to exist.
    """
    found = [_FOLDER.fullmatch(folder.name) for folder in root.glob(f"agent[0-{AGENTS - 1}]/*_*")]
    listed: dict[int, set[int]] = {}
    for match in found:
        if match:
            listed.setdefault(int(match[1]), set()).add(int(match[2]))
    return {scene: sorted(listed[scene]) for scene in sorted(listed)}


def frames(root: Path, scene: int, count: int | None = None, stride: int = 1) -> Iterator[V2XSimFrame]:
    """Frames of a scene, in order, that at least one agent is present in.

    Parameters
    ----------
    root : Path
        As for `scenes`.
    scene : int
    count : int, optional
        At most so many, by default all.
    stride : int
        Every so many of the frames listed.

    Raises
    ------
    SampleError
        If a file is not a sample.
    FileNotFoundError
        If there is no frame of that scene.
    """
    listed = scenes(root)
    if scene not in listed:
        raise FileNotFoundError(f"no frame of scene {scene} in {root}")
    for index in listed[scene][::stride][:count]:
        samples = {}
        for agent in range(AGENTS):
            path = root / f"agent{agent}" / f"{scene}_{index}" / "0.npy"
            sample = read_sample(path) if path.exists() else None
            if sample is not None:
                samples[f"agent{agent}"] = sample
        if samples:
            yield V2XSimFrame(scene, index, samples)


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
    return V2XSimSample(from_indices(voxels), matrices, boxes, best[:, 3])


def _codes(fields: Mapping[Any, Any], anchor: np.ndarray[Any, np.dtype[np.int64]]) -> FloatArray:
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


def _indices(fields: Mapping[Any, Any], name: str, limits: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.int64]]:
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
