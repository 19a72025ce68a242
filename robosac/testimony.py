"""What each agent's own message says of places: testimony that no other agent can forge.

A witness network reads one agent's message alone and says for every place how much better it fits a vehicle than none
(`robosac.detectors.witness`). Here is what came of it in one frame, in numpy, for whoever judges boxes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray

LIKELIHOOD, X, Y, ALONG, ACROSS = range(5)
"""Layers of a map: L, the vehicle's centre seen from the place's centre (x and y, metres), and logarithms of how far it
may be off along and across the vehicle (metres).
"""
LAYERS = 5
KNOWS = 3.0
"""An agent knows of a place whether a vehicle is there if its L is so far from 0."""
AGREED_M = 0.6
"""All see a vehicle in one place if none is so far off from their mean, along either axis."""
MOST = 7.0
"""L is clipped to +- this: beyond it the network has seen too little to know."""


@dataclass(frozen=True)
class Sighting:
    """Where each of some agents sees the vehicle that is nearest to each of n places; ego frame."""

    centre: FloatArray
    """(agents, n, 2): metres."""
    along: FloatArray
    across: FloatArray
    """(agents, n): how far it may be off, along and across the vehicle: mean absolute error, metres."""


@dataclass(frozen=True)
class Testimony:
    """What all messages of a frame say, each by itself."""

    __test__ = False  # no test of pytest's, whatever its name

    agents: tuple[str, ...]
    """Who sent them; the ego is ``robosac.defenses.EGO``."""
    maps: FloatArray
    """(agents, LAYERS, H, W): each in its sender's frame, rows along +y, columns along +x. `LIKELIHOOD` is L = ln p(map
    | a vehicle is centred here) / p(map | none is here), 0 where nothing was observed.
    """
    from_ego: FloatArray
    """(agents, 3, 3): the plane of the ego's frame in each sender's."""
    over_ego: FloatArray
    """(agents, H, W): `LIKELIHOOD` laid over the ego's map, 0 outside the sender's."""
    half_extent_m: float
    """Maps cover +- this in both directions."""
    unread: tuple[str, ...] = ()
    """Agents whose messages there was no time to read: they say nothing."""
    empty: Callable[[str, FloatArray], BoolArray] | None = None
    """Of an agent, and places (n, 2) in its frame, where its message is the same all around: it shows nothing there,
    whether there is nothing or it could not see. None where messages are not at hand.
    """

    def ego_places(self) -> FloatArray:
        """Centres (H, W, 2) of the places of the ego's map, ego frame, metres."""
        return _centres(*self.over_ego.shape[-2:], self.half_extent_m)

    def places(self, points: FloatArray) -> FloatArray:
        """Places (n, 2), ego frame, in each sender's frame: (agents, n, 2), metres."""
        turned: FloatArray = points @ self.from_ego[:, :2, :2].swapaxes(1, 2) + self.from_ego[:, None, :2, 2]
        return turned

    def is_empty(self, agent: str, points: FloatArray) -> BoolArray:
        """Whether an agent's message shows nothing around places (n, 2), ego frame; nowhere if that is not known."""
        if self.empty is None:
            return np.zeros(len(points), dtype=bool)
        return self.empty(agent, self.places(points)[self.agents.index(agent)])

    def known_to(self, agent: str, points: FloatArray) -> BoolArray:
        """Of which places (n, 2), ego frame, an agent's own message tells whether a vehicle is there."""
        known: BoolArray = np.abs(self.of({agent}).likelihood(points)[0]) >= KNOWS
        return known

    def likelihood(self, points: FloatArray) -> FloatArray:
        """L at places (n, 2), ego frame: (agents, n), bilinear, within +- `MOST`, 0 outside a map."""
        turn, move = self._to_cells
        # rows and columns of the padded maps
        place = (turn @ points.T).reshape(2, len(self.agents), len(points)) + move
        first = np.minimum(np.maximum(np.floor(place), 0.0), self._last)
        y, x = np.minimum(np.maximum(place - first, 0.0), 1.0)
        (row, column), wide = first.astype(np.int64), self._padded.shape[2]
        corner = (row + self._starts) * wide + column
        left, right = self._padded.take(np.add.outer([[0, 1], [wide, wide + 1]], corner)).swapaxes(0, 1)
        top, bottom = left * (1 - x) + right * x
        value: FloatArray = top * (1 - y) + bottom * y
        return value

    @cached_property
    def _to_cells(self) -> tuple[FloatArray, FloatArray]:
        """From places (2,) of the ego's frame to rows, then columns, of each padded map: a turn (2 agents, 2) and a
        move (2, agents, 1), in cells.
        """
        cells = np.array(self.maps.shape[-2:])[:, None] / (2 * self.half_extent_m)
        turn = self.from_ego[:, 1::-1, :2].swapaxes(0, 1) * cells[..., None]
        move = (self.from_ego[:, 1::-1, 2].T + self.half_extent_m) * cells + 0.5
        return turn.reshape(-1, 2), move[..., None]

    @cached_property
    def _last(self) -> IntArray:
        """The last row and column (2, 1, 1) of a padded map between which and the next something can lie."""
        return np.array(self.maps.shape[-2:])[:, None, None]

    @cached_property
    def _starts(self) -> IntArray:
        """The first row (agents, 1) of each of the padded maps, one below the other."""
        starts: IntArray = np.arange(len(self.agents))[:, None] * self._padded.shape[1]
        return starts

    @cached_property
    def _padded(self) -> FloatArray:
        """L within its bounds, zeros around each map: (agents, H + 3, W + 3)."""
        agents, _, height, width = self.maps.shape
        padded = np.zeros((agents, height + 3, width + 3), dtype=self.maps.dtype)
        inside = padded[:, 1:-2, 1:-2]
        np.clip(self.maps[:, LIKELIHOOD], -MOST, MOST, out=inside)
        return padded

    @cached_property
    def _to_ego(self) -> FloatArray:
        return np.linalg.inv(self.from_ego)

    @property
    def origins(self) -> FloatArray:
        """Where each sender says it is: (agents, 2), ego frame, metres."""
        origins: FloatArray = -np.einsum("nji,nj->ni", self.from_ego[:, :2, :2], self.from_ego[:, :2, 2])
        return origins

    def sighting(self, points: FloatArray, asked: BoolArray | None = None) -> Sighting:
        """Where each agent sees the vehicles at places (n, 2), ego frame. It means something where L is high.

        With ``asked`` (agents, n) only those agents are asked, each of its places; of the others it is not a number.
        """
        shape = len(self.agents), len(points)
        who, where = np.nonzero(np.ones(shape, dtype=bool) if asked is None else asked)
        seen, off_by = self._nearest(who, points[where], slice(X, LAYERS))
        centre, off = np.full((*shape, 2), np.nan), np.full((2, *shape), np.nan, dtype=self.maps.dtype)
        centre[who, where] = seen.T
        off[:, who, where] = np.exp(off_by)
        return Sighting(centre, *off)

    def agreed(self, points: FloatArray, asked: BoolArray) -> tuple[FloatArray, BoolArray]:
        """The mean (n, 2) of where those asked (agents, n) see the vehicles at places (n, 2), ego frame; and which (n,)
        all of them see in one place. Somebody is asked of each.
        """
        centres = self.centres(points, asked)
        off = np.abs(self.sighting(points, asked).centre - centres)
        farthest = np.fmax.reduce(off, axis=(0, 2))  # it is not a number for those who are not asked
        agreed: BoolArray = farthest <= AGREED_M
        return centres, agreed

    def centres(self, points: FloatArray, asked: BoolArray) -> FloatArray:
        """The mean (n, 2) of where those asked (agents, n) see the vehicles at places (n, 2), ego frame; somebody is
        asked of each.
        """
        who, where = np.nonzero(asked)
        (x, y), _ = self._nearest(who, points[where], slice(X, ALONG))
        total = [np.bincount(where, weights=of, minlength=len(points)) for of in (x, y)]
        mean: FloatArray = np.stack(total, axis=1) / asked.sum(axis=0)[:, None]
        return mean

    def _nearest(self, who: IntArray, points: FloatArray, layers: slice) -> tuple[FloatArray, FloatArray]:
        """What the agents (n,), by their numbers, have in the places of their maps nearest to each its point (n, 2): of
        the layers, of which the first two are `X` and `Y`, the centre (2, n), ego frame, and the others (k, n) as they
        are.
        """
        size = np.array(self.maps.shape[:-3:-1])[:, None]
        cell = 2 * self.half_extent_m / size
        place = (_moved(self.from_ego, who, points.T) + self.half_extent_m) / cell
        nearest = np.minimum(np.maximum(place.astype(np.int64), 0), size - 1)
        (width,), (height,) = size
        at = (who * LAYERS * height + nearest[1]) * width + nearest[0]  # in the first layers of maps in a row
        found = self.maps.take(at + np.arange(LAYERS)[layers, None] * height * width)
        seen = (nearest + 0.5) * cell - self.half_extent_m + found[:2]
        return _moved(self._to_ego, who, seen), found[2:]

    def silenced(self, agent: str) -> Testimony:
        """The same, of which one says nothing, as if it had observed nothing."""
        index, maps, over_ego = self.agents.index(agent), self.maps.copy(), self.over_ego.copy()
        maps[index, LIKELIHOOD] = over_ego[index] = 0.0
        return replace(self, maps=maps, over_ego=over_ego, unread=(*self.unread, agent))

    def of(self, agents: Collection[str]) -> Testimony:
        """That of some of them alone."""
        kept = [i for i, name in enumerate(self.agents) if name in agents]
        if len(kept) == len(self.agents):
            return self
        return Testimony(
            tuple(self.agents[i] for i in kept),
            self.maps[kept],
            self.from_ego[kept],
            self.over_ego[kept],
            self.half_extent_m,
            tuple(name for name in self.unread if name in agents),
            self.empty,
        )


def _moved(planes: FloatArray, which: IntArray, points: FloatArray) -> FloatArray:
    """Points (2, n), each moved as its plane is: which (n,) of some (m, 3, 3)."""
    turn = planes[:, :2].T.take(which, axis=2)
    moved: FloatArray = turn[0] * points[0] + turn[1] * points[1] + turn[2]
    return moved


@lru_cache(maxsize=16)
def _centres(height: int, width: int, half_extent_m: float) -> FloatArray:
    """Centres (H, W, 2) of the places of a map; nobody may write to them."""
    x = (np.arange(width) + 0.5) * (2 * half_extent_m / width) - half_extent_m
    y = (np.arange(height) + 0.5) * (2 * half_extent_m / height) - half_extent_m
    centres = np.stack(np.meshgrid(x, y), axis=-1)
    centres.flags.writeable = False
    return centres


def planar(ego_pose: FloatArray, poses: Sequence[FloatArray]) -> FloatArray:
    """The ego's plane in each sender's frame (n, 3, 3), of their poses world_from_sensor (4, 4). How high they say they
    are does not count, as in `robosac.detectors.warp.sampling_matrix`.
    """
    senders = np.array(poses)
    level = np.repeat(ego_pose[None], len(poses), axis=0)
    level[:, 2, 3] = senders[:, 2, 3]
    relative = np.linalg.inv(senders) @ level
    found = np.repeat(np.eye(3)[None], len(poses), axis=0)
    found[:, :2, :2], found[:, :2, 2] = relative[:, :2, :2], relative[:, :2, 3]
    return found
