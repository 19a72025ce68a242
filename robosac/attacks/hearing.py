"""What an adversary hears: every message by itself, as the ego's witness reads it.

The witness is part of what ships, so an adversary has it, too. It is differentiable: an attacker can choose what its
own message says. Nobody can change what another one's says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray
from robosac.calibrated import witness_of
from robosac.defenses import EGO
from robosac.defenses.group_testing.claims import AROUND_M
from robosac.detectors.base import DetectorInfo, Message
from robosac.detectors.witness import Witness, as_testimony
from robosac.testimony import LIKELIHOOD, MOST, Testimony, X, Y, planar

_STEPS = ((0.0, 0.0), (AROUND_M, 0.0), (-AROUND_M, 0.0), (0.0, AROUND_M), (0.0, -AROUND_M))
"""Along and across, metres: where `robosac.defenses.group_testing.claims.Claims` looks L of a box up."""


class NoWitness(ValueError):
    """An attack reads testimony, and there is no witness that gives it."""


class Hearing:
    """All messages of a frame, each read by itself.

    Parameters
    ----------
    witness : Witness
    ego : (C, H, W) tensor
        The ego's map, as it is sent.
    ego_pose : (4, 4) ndarray
        world_from_sensor.
    messages : mapping of teammate to (C, H, W) tensor
        Everybody's benign map, as it is sent.
    poses : mapping of teammate to (4, 4) ndarray
        As they are claimed.
    """

    def __init__(
        self,
        witness: Witness,
        ego: torch.Tensor,
        ego_pose: FloatArray,
        messages: Mapping[str, torch.Tensor],
        poses: Mapping[str, FloatArray],
    ) -> None:
        self._witness = witness
        self._maps = {EGO: ego, **messages}
        self._poses = {name: poses.get(name, ego_pose) for name in self._maps} | {EGO: ego_pose}
        self._ego_pose = ego_pose

    @classmethod
    def of(
        cls,
        info: DetectorInfo,
        ego: Message,
        messages: Mapping[str, torch.Tensor],
        poses: Mapping[str, FloatArray],
    ) -> Hearing | None:
        """With the witness beside a detector's weights.

        None if there is none, or if it reads something else of a message than what an attacker perturbs.

        Raises
        ------
        robosac.detectors.weights_file.WeightsError
            If the witness is damaged, or belongs to other weights.
        OSError
            If it cannot be read.
        """
        witness = witness_of(replace(info, device="cpu"))  # where surfaces and what attackers perturb are
        if witness is None:
            return None
        layout = witness.layout
        read = (layout.channels, layout.height, layout.width)
        if any(tuple(tensor.shape) != read for tensor in messages.values()):
            return None
        own = torch.from_numpy(np.ascontiguousarray(ego.tensors[layout.tensor])).float()
        return cls(witness, own, ego.pose, messages, poses)

    @cached_property
    def benign(self) -> Testimony:
        """What all say if everybody is honest, the ego as `robosac.defenses.EGO`."""
        with torch.no_grad():
            read = self._read(self._maps)
        poses = [self._poses[name] for name in self._maps]
        maps = read.half().numpy()
        return as_testimony(tuple(self._maps), maps, planar(self._ego_pose, poses), self._half_extent_m)

    def hear(self, sent: Mapping[str, torch.Tensor]) -> Heard:
        """What some teammates say with these maps (C, H, W), in the order in which they are given; differentiable."""
        from_ego = planar(self._ego_pose, [self._poses[name] for name in sent])
        return Heard(self._read(sent), torch.from_numpy(from_ego).float(), self._half_extent_m)

    @property
    def _half_extent_m(self) -> float:
        return self._witness.layout.half_extent_m

    def _read(self, sent: Mapping[str, torch.Tensor]) -> torch.Tensor:
        maps = self._witness.layout.scaled(torch.stack(list(sent.values())))
        return self._witness.read(maps, [float(self._poses[name][2, 3]) for name in sent])


class Heard:
    """What some messages say, as tensors; see `robosac.testimony.Testimony`.

    Parameters
    ----------
    maps : (agents, LAYERS, H, W) tensor
        Each in its sender's frame.
    from_ego : (agents, 3, 3) tensor
    half_extent_m : float
    """

    def __init__(self, maps: torch.Tensor, from_ego: torch.Tensor, half_extent_m: float) -> None:
        self._maps = maps
        self._from_ego = from_ego
        self._half_extent_m = half_extent_m

    def likelihood(self, boxes: torch.Tensor) -> torch.Tensor:
        """L (agents, n) of boxes (n, 5+), ego frame, as `robosac.defenses.group_testing.claims.Claims` looks it up.

        Its value is within +- `MOST`, as it counts. Its gradient is that of L as it was read, or what is clipped could
        not be changed.
        """
        read = self._maps[:, LIKELIHOOD : LIKELIHOOD + 1]
        clipped = read + (read.clamp(-MOST, MOST) - read).detach()
        cos, sin = boxes[:, 4].cos()[:, None], boxes[:, 4].sin()[:, None]
        along, across = torch.tensor(_STEPS).T
        x, y = boxes[:, :1] + along * cos - across * sin, boxes[:, 1:2] + along * sin + across * cos
        places = self._local(torch.stack([x, y], dim=-1).reshape(-1, 2)) / self._half_extent_m
        found = functional.grid_sample(clipped, places[:, None], padding_mode="zeros", align_corners=False)
        likelihood: torch.Tensor = found.reshape(len(read), len(boxes), len(_STEPS)).amax(dim=2)
        return likelihood

    def centres(self, points: torch.Tensor) -> torch.Tensor:
        """Where each sees the vehicles at places (n, 2), ego frame: (agents, n, 2), ego frame, metres."""
        height, width = self._maps.shape[-2:]
        local = self._local(points)
        size = 2 * self._half_extent_m / torch.tensor([width, height])
        last = torch.tensor([width - 1, height - 1])
        cell = ((local + self._half_extent_m) / size).long().clamp(min=torch.zeros_like(last), max=last)
        agents = torch.arange(len(self._maps))[:, None]
        seen = self._maps[agents, :, cell[..., 1], cell[..., 0]][..., [X, Y]]
        there = (cell + 0.5) * size - self._half_extent_m + seen
        back = torch.linalg.inv(self._from_ego)
        centres: torch.Tensor = there @ back[:, :2, :2].mT + back[:, None, :2, 2]
        return centres

    def reaches(self, points: torch.Tensor) -> torch.Tensor:
        """Whether places (n, 2), ego frame, lie on each one's map: (agents, n)."""
        on: torch.Tensor = self._local(points).abs().amax(dim=-1) <= self._half_extent_m - AROUND_M
        return on

    def _local(self, points: torch.Tensor) -> torch.Tensor:
        """Places (n, 2), ego frame, in each one's: (agents, n, 2)."""
        return points @ self._from_ego[:, :2, :2].mT + self._from_ego[:, None, :2, 2]
