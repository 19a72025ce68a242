"""Trains the witness network of a detector: what one message says of places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray
from robosac.calibration.places import JITTER_M, OBSERVED_HITS, Places, places
from robosac.detectors.base import Encoder, for_role
from robosac.detectors.witness import Witness
from robosac.detectors.witness_network import Layout, WitnessNetwork
from robosac.scenes import DEFAULT_DATA, Scene, SceneError, SceneSource, View, encoded, seconds_apart
from robosac.testimony import ACROSS, ALONG, LIKELIHOOD, X, Y

_PLACES, _BATCHES = 61, 62
BLOCKED_SHARE = 0.12
"""Share of scans that lack a sector. What a witness could not see there it must not take for empty."""
BLOCKED = (np.pi / 6, 2 * np.pi)
"""Such a sector is between so wide, radians."""
SIGHTED_M = (1.3, 1.0)
"""Vehicles are located from places up to so far along and across from their centres, metres."""
SMALLEST, LARGEST = -3.0, 1.0
"""Logarithms of the errors that a witness may claim, metres."""
SIGHTING_WEIGHT = 0.3
"""Of the location of vehicles, where the likelihoods weigh 1."""


@dataclass(frozen=True)
class WitnessRecipe:
    """What a witness is trained on, and how."""

    data: tuple[str, ...] = (DEFAULT_DATA,)
    """As `robosac.scenes.load_source` takes each; all count alike."""
    scenes: int = 200
    """Of each."""
    frames_per_scene: int = 3
    """Frames 1 s apart of each scene, all agents of each."""
    check_scenes: int = 6
    """Further ones of each, to check on."""
    epochs: int = 8
    batch: int = 32
    learning_rate: float = 4e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.data or min(self.scenes, self.frames_per_scene, self.epochs, self.batch) < 1:
            raise ValueError("data must not be empty; scenes, frames, epochs and batch must be at least 1")

    @property
    def frames(self) -> int:
        """Frames that are encoded."""
        return len(self.data) * (self.scenes + self.check_scenes) * self.frames_per_scene


@dataclass(frozen=True)
class Lesson:
    """One message, and places of which it is known what is there."""

    map: torch.Tensor
    """(C, H, W) float16, as sent."""
    height_m: float
    places: Places


def training_scenes(source: SceneSource, count: int) -> Sequence[Scene]:
    """Scenes to train on: those that a source keeps for it, else its last validation scenes.

    Raises
    ------
    robosac.scenes.SceneError
        If there are fewer.
    """
    keep = getattr(source, "training_scenes", None)
    scenes = source.scenes("validation") if keep is None else keep()
    if len(scenes) < count:
        raise SceneError(f"{source.name} has too few scenes to train on: {len(scenes)}, and {count} are wanted")
    return list(scenes[:count]) if keep is not None else list(scenes[len(scenes) - count :])


def lessons(
    detector: Encoder, layout: Layout, scenes: Sequence[Scene], recipe: WitnessRecipe, tick: Callable[[], None]
) -> list[Lesson]:
    """Encode scans and draw places. ``tick`` is called after each frame.

    Raises
    ------
    robosac.scenes.SceneError
        If no vehicle was observed in any scan: nothing could be learned from them, nor checked.
    """
    rng = np.random.default_rng([recipe.seed, _PLACES])
    learned = []
    for scene in scenes:
        for frame in seconds_apart(scene, recipe.frames_per_scene):
            for agent, whole in frame.views.items():
                view = _partly_blocked(whole, rng) if rng.random() < BLOCKED_SHARE else whole
                message = for_role(encoded(view, detector), detector.info, "teammate")
                sent = torch.from_numpy(np.asarray(message.tensors[layout.tensor], dtype=np.float16))
                known = places(view, frame.truth(agent)[:, :5], layout.half_extent_m, rng)
                learned.append(Lesson(sent, float(view.pose[2, 3]), known))
            tick()
    if not any(each.places.observed_vehicles.any() for each in learned):
        raise SceneError(f"no vehicle has {OBSERVED_HITS} returns in any of {len(learned)} scans: a witness needs some")
    return learned


def _partly_blocked(view: View, rng: np.random.Generator) -> View:
    """A scan without the returns of a sector, as if something stood there just before the sensor; a recorded message as
    it is.
    """
    if getattr(view, "message", None) is not None:
        return view
    azimuth = np.arctan2(view.points[:, 1], view.points[:, 0])
    middle, half = rng.uniform(-np.pi, np.pi), rng.uniform(*BLOCKED) / 2
    left = np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi) > half
    return replace(view, points=view.points[left])


def usual_size(detector: Encoder, scene: Scene) -> float:
    """Root mean square of the values in the messages of a scene's first frame: a witness reads maps divided by it."""
    layout = Layout.of(detector.info, 1.0)
    messages = [encoded(view, detector) for view in scene.frame(0).views.values()]
    size = float(layout.maps(messages).pow(2).mean().sqrt())
    return size or 1.0


def train(
    layout: Layout, learned: Sequence[Lesson], recipe: WitnessRecipe, tell: Callable[[int, int, float], None]
) -> Witness:
    """Fit a network to lessons.

    1. L is a logistic regression of "vehicle" against "none". Both weigh the same in total among the places that were
       observed, and among those that were not. So L is a log-likelihood ratio, and 0 where nothing was observed.
    2. Centres are located from places around them: Laplace's negative log-likelihood ``|e| / s + ln s`` of the error
       along and across the vehicle.

    Parameters
    ----------
    tell : callable
        Told the step, the steps in all, and the loss.
    """
    torch.manual_seed(recipe.seed)
    witness = Witness(WitnessNetwork(layout.channels, layout.upsampling), layout)
    network = witness.network.train().requires_grad_(True)
    rng = np.random.default_rng([recipe.seed, _BATCHES])
    batches = max(1, len(learned) // recipe.batch)
    steps = recipe.epochs * batches
    optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, recipe.learning_rate, total_steps=max(steps, 2))
    weights = _weights(learned)
    for step in range(steps):
        if step % batches == 0:
            order = rng.permutation(len(learned))
        start = step % batches * recipe.batch
        chosen = [learned[i] for i in order[start : start + recipe.batch]]
        maps = layout.scaled(torch.stack([lesson.map for lesson in chosen]).float())
        testimony = witness.read(maps, [lesson.height_m for lesson in chosen])
        loss = _loss(testimony, chosen, weights, layout.half_extent_m, rng)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        tell(step + 1, steps, float(loss.detach()))
    return Witness(network, layout)


def _weights(learned: Sequence[Lesson]) -> FloatArray:
    """Weights (2, 2) of places by "observed" and "vehicle", so that both kinds weigh the same among either."""
    counts = np.ones((2, 2))
    for lesson in learned:
        known = lesson.places
        np.add.at(counts, ((known.hits >= OBSERVED_HITS).astype(int), known.vehicle.astype(int)), 1)
    weights: FloatArray = counts.sum(axis=1, keepdims=True) / counts / 2
    return weights


def _loss(
    testimony: torch.Tensor,
    chosen: Sequence[Lesson],
    weights: FloatArray,
    half_extent_m: float,
    rng: np.random.Generator,
) -> torch.Tensor:
    at, which, vehicle, weight, near, box = [], [], [], [], [], []
    for number, lesson in enumerate(chosen):
        known = lesson.places
        at.append(known.at + rng.normal(0.0, JITTER_M, known.at.shape))
        which.append(np.full(len(known.at), number))
        vehicle.append(known.vehicle)
        weight.append(weights[(known.hits >= OBSERVED_HITS).astype(int), known.vehicle.astype(int)])
        seen = known.box[known.observed_vehicles]
        aside = rng.uniform(-1, 1, (len(seen), 2)) * SIGHTED_M
        cos, sin = np.cos(seen[:, 4]), np.sin(seen[:, 4])
        x = seen[:, 0] + aside[:, 0] * cos - aside[:, 1] * sin
        y = seen[:, 1] + aside[:, 0] * sin + aside[:, 1] * cos
        near.append(np.column_stack([np.full(len(seen), number), x, y]))
        box.append(seen)
    likelihood = _sampled(testimony[:, LIKELIHOOD], np.concatenate(which), np.concatenate(at), half_extent_m)
    wanted, w = (torch.from_numpy(np.concatenate(each)).float() for each in (vehicle, weight))
    entropy = functional.binary_cross_entropy_with_logits(likelihood, wanted, weight=w)
    sighted = _sighting_loss(testimony, np.concatenate(near), np.concatenate(box), half_extent_m)
    return entropy + SIGHTING_WEIGHT * sighted


def _sampled(maps: torch.Tensor, which: FloatArray, at: FloatArray, half_extent_m: float) -> torch.Tensor:
    """Values (n,) of maps (b, H, W) at places (n, 2) of the maps of these numbers (n,), bilinear."""
    height, width = maps.shape[-2:]
    column = torch.from_numpy((at[:, 0] + half_extent_m) * width / (2 * half_extent_m) - 0.5).float()
    row = torch.from_numpy((at[:, 1] + half_extent_m) * height / (2 * half_extent_m) - 0.5).float()
    c, r = column.floor().long().clamp(0, width - 2), row.floor().long().clamp(0, height - 2)
    x, y, b = column - c, row - r, torch.from_numpy(which).long()
    top = maps[b, r, c] * (1 - x) + maps[b, r, c + 1] * x
    bottom = maps[b, r + 1, c] * (1 - x) + maps[b, r + 1, c + 1] * x
    return top * (1 - y) + bottom * y


def _sighting_loss(testimony: torch.Tensor, near: FloatArray, box: FloatArray, half_extent_m: float) -> torch.Tensor:
    height, width = testimony.shape[-2:]
    cell_x, cell_y = 2 * half_extent_m / width, 2 * half_extent_m / height
    column = np.clip(((near[:, 1] + half_extent_m) / cell_x).astype(np.int64), 0, width - 1)
    row = np.clip(((near[:, 2] + half_extent_m) / cell_y).astype(np.int64), 0, height - 1)
    found = testimony[near[:, 0].astype(np.int64), :, row, column]
    dx = torch.from_numpy((column + 0.5) * cell_x - half_extent_m - box[:, 0]).float() + found[:, X]
    dy = torch.from_numpy((row + 0.5) * cell_y - half_extent_m - box[:, 1]).float() + found[:, Y]
    cos, sin = torch.from_numpy(np.cos(box[:, 4])).float(), torch.from_numpy(np.sin(box[:, 4])).float()
    total = testimony.new_zeros(())
    for error, layer in ((dx * cos + dy * sin, ALONG), (dy * cos - dx * sin, ACROSS)):
        size = found[:, layer].clamp(SMALLEST, LARGEST)
        total = total + (error.abs() * (-size).exp() + size).mean()
    return total
