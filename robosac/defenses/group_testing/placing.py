"""Whose messages lie in a wrong place as a whole: their senders are not where they say, or they are late.

One vehicle tells little about that, all together much: where a sender sees vehicles, and where all others do, differs
by a shift and a turn about the sender that are known to some .1 m and .2 degrees in each frame. Whoever is some metres
off sees none of them where the others do; then both are searched for.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing.claims import DENIES, SUPPORTS
from robosac.testimony import Testimony

FEWEST = 4
"""A sender is placed by so many vehicles that others see, too."""
VEHICLE_M = 0.3
"""How far off from one another two may see a vehicle."""
SHIFT_M, TURN = 0.5, 0.035
"""How wrong a pose may be beforehand: metres along each axis, radians."""
ROUNDS = 4
"""In so many rounds those vehicles lose weight that do not fit the others."""
EXPECTED_M = 0.25
"""A sender is expected so far off before it was ever placed; in teams of one or two, always."""
RATE = 0.2
"""A frame's share of the running mean of how far a sender is off."""
MEAN, ONCE = 1.6, 2.75
"""A sender is out of place if it is so many times farther off than usual in the team: in the running mean, in a single
frame.
"""
MEAN_M, ONCE_M = 0.4, 0.6
"""Nobody is out of place who is off by less. Boxes suffer from about .4 m on, across the vehicles."""
EGO_MEAN_M, EGO_ONCE_M = 0.5, 0.75
"""The ego itself is not where it says if it is so far off from where others agree: in the running mean, in a single
frame. Teams that err by .6 m each make it seem .3 m off, seldom .6 m.
"""
DOUBTED_M = 0.2
"""Where the middle one of the team is so far off, the ego is placed, too."""
FARTHEST_M, TURNS, MOST_TURNS = 30.0, np.deg2rad(np.arange(-20, 21, 4)), 4
"""A message is searched for within so many metres along each axis, and by these turns, of which so many are tried."""
BIN_M = 2.0
"""Vehicles are off alike if they are within so much."""
COPY_M = 1.5
"""A message comes from where another sender is if it comes from so near."""


def misplaced(centres: FloatArray, supporting: BoolArray, origins: FloatArray, heard: BoolArray) -> FloatArray:
    """How far each agent shows vehicles from where others see them, as far as a shift and a turn of it explain that.

    With c_v where an agent sees a vehicle, o where it is itself, and q_v where the ego sees it, or else the median of
    where the others do, ``c_v - q_v = t + w J (q_v - o)`` is solved for the shift t and the turn w (J turns by 90
    degrees), by reweighted least squares (Holland and Welsch, Robust Regression Using Iteratively Reweighted
    Least-Squares, Communications in Statistics 6, 1977; weights of Cauchy's distribution), and ridges as both are about
    0 beforehand. No two that are out of place together outweigh the ego.

    Parameters
    ----------
    centres : (agents, n, 2) ndarray
        Where each sees n vehicles, the ego first; ego frame, metres.
    supporting : (agents, n) bool ndarray
        Who sees which.
    origins : (agents, 2) ndarray
        Where each agent says it is.
    heard : (agents,) bool ndarray
        Whose word counts about others.

    Returns
    -------
    (agents,) ndarray
        Root mean square of the right side over the vehicles that the agent sees, and the ego or two others do, metres.
        Not a number with fewer than four of them, and for the ego.
    """
    witnesses = supporting & heard[:, None]
    others = witnesses.sum(axis=0) - witnesses
    shared = supporting & (witnesses[0] | (others >= 2))
    shared[0] = False
    seen = _by_others(np.where(witnesses[..., None], centres, np.nan), others)
    seen = np.where(witnesses[0, :, None], centres[0], seen)
    return _off(centres - seen, seen - origins[:, None], shared)


def ego_misplaced(seen: FloatArray, centres: FloatArray) -> float:
    """How far the ego shows vehicles from where teammates agree that they are, as in `misplaced`.

    Parameters
    ----------
    seen, centres : (n, 2) ndarray
        Where the ego sees vehicles, and where they are by the others; ego frame, metres.

    Returns
    -------
    float
        Metres; not a number with fewer than four vehicles.
    """
    return float(_off((seen - centres)[None], centres[None], np.ones((1, len(seen)), dtype=bool))[0])


def elsewhere(said: Testimony, vehicles: FloatArray, seen: FloatArray, taken: FloatArray) -> float:
    """How far a message lies from where its sender says it is, if it lies elsewhere as a whole.

    For each turn that shift is taken by which most of the vehicles that the sender sees come to lie where others see
    one (a generalised Hough transform: Ballard, Generalizing the Hough Transform to Detect Arbitrary Shapes,
    Pattern Recognition 13, 1981), and corrected by the rigid motion of those (Kabsch, A Solution for the Best Rotation
    to Relate Two Sets of Vectors, Acta Crystallographica A32, 1976). Of the turns that counts which the sender's own
    testimony fits best.

    Parameters
    ----------
    said : Testimony
        The sender's alone.
    vehicles : (n, 2) ndarray
        Where the ego sees vehicles, or two others do; ego frame, metres.
    seen : (m, 2) ndarray
        Where the sender does.
    taken : (k, 2) ndarray
        Where the others are. A message that would come from there is a copy of theirs: two cannot be in one place.

    Returns
    -------
    float
        Root mean square over the vehicles that the sender then supports, metres. Not a number unless those are, less
        the vehicles that it then denies, more than half of all, or of what the sender sees; and four more than where
        it says that it is, and at least four.
    """
    if min(len(vehicles), len(seen)) < FEWEST:
        return np.nan
    in_place, (origin,) = _agreeing(said.likelihood(vehicles)[0]), said.origins
    best, far = 0.0, np.nan
    for of, to in _alike((vehicles - origin) @ _turning(TURNS) + origin, seen):
        moved = _rigidly(vehicles, vehicles[of], seen[to])
        comes_from = _rigidly(origin, seen[to], vehicles[of])
        if np.hypot(*(taken - comes_from).T).min(initial=np.inf) <= COPY_M:
            return np.nan
        likelihood = said.likelihood(moved)[0]
        agreeing = _agreeing(likelihood)
        fits = agreeing >= max(FEWEST, in_place + FEWEST) and 2 * agreeing > min(len(vehicles), len(seen))
        if fits and likelihood.sum() > best:
            best, off = float(likelihood.sum()), moved - vehicles
            far = float(np.sqrt((off[likelihood >= SUPPORTS] ** 2).sum(axis=1).mean()))
    return far


def _agreeing(likelihood: FloatArray) -> int:
    """How many more vehicles are supported than denied, by L (n,) of each."""
    return int((likelihood >= SUPPORTS).sum() - (likelihood <= DENIES).sum())


def _turning(angles: FloatArray) -> FloatArray:
    """By these (..., 2, 2), rows of coordinates are turned by angles (...,), radians."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)


def _alike(places: FloatArray, seen: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Which of places go with which others (m, 2) by the shift that most of them have in common: of those (turns, n, 2)
    by which most do, at least four, the `MOST_TURNS` first.
    """
    apart = (seen - places[:, :, None]).reshape(len(places), -1, 2)
    size = int(2 * FARTHEST_M / BIN_M)
    x, y = np.floor((apart + FARTHEST_M) / BIN_M).astype(np.int64).transpose(2, 0, 1)
    cells = (np.arange(len(places))[:, None] * size + x) * size + y
    inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
    votes = np.bincount(cells[inside], minlength=len(places) * size * size).reshape(-1, size, size)
    four = votes[:, :-1, :-1] + votes[:, 1:, :-1] + votes[:, :-1, 1:] + votes[:, 1:, 1:]
    most = four.max(axis=(1, 2))
    for turn in np.argsort(-most, kind="stable")[:MOST_TURNS]:
        corner = np.array(np.unravel_index(four[turn].argmax(), four[turn].shape)) + 1
        near = np.flatnonzero(np.hypot(*(apart[turn] - corner * BIN_M + FARTHEST_M).T) <= BIN_M)
        if len(near) >= FEWEST:
            yield near // len(seen), near % len(seen)


def _rigidly(places: FloatArray, of: FloatArray, to: FloatArray) -> FloatArray:
    """Places (..., 2), moved as points (k, 2) are to others (k, 2), as far as a shift and a turn can do that."""
    middle, aim = of.mean(axis=0), to.mean(axis=0)
    (xx, xy), (yx, yy) = (of - middle).T @ (to - aim)
    moved: FloatArray = (places - middle) @ _turning(np.arctan2(xy - yx, xx + yy)) + aim
    return moved


def _off(apart: FloatArray, arms: FloatArray, shared: BoolArray) -> FloatArray:
    """How far senders (k,) are off who see vehicles ``apart`` (k, n, 2) from where those are, at the ends of ``arms``
    (k, n, 2) from the sender, so far as shared (k, n); not a number with fewer than four of them.
    """
    apart = np.where(shared[..., None], apart, 0.0).reshape(len(shared), -1, 1)
    x, y = np.where(shared[..., None], arms, 0.0).transpose(2, 0, 1)
    one, none = np.ones_like(x), np.zeros_like(x)
    design = np.stack([one, none, -y, none, one, x], axis=-1).reshape(len(shared), -1, 3)  # rows of x and y in turn
    ridge = VEHICLE_M**2 / np.array([SHIFT_M, SHIFT_M, TURN]) ** 2 * np.eye(3)
    weights, moved = shared.astype(np.float64), apart
    for _ in range(ROUNDS):
        weighted = design.swapaxes(1, 2) * np.repeat(weights, 2, axis=1)[:, None]
        moved = design @ np.linalg.solve(weighted @ design + ridge, weighted @ apart)
        rest = (apart - moved).reshape(*shared.shape, 2)
        weights = shared / (1 + (rest**2).sum(axis=2) / VEHICLE_M**2)
    count = shared.sum(axis=1)
    squares = (moved.reshape(*shared.shape, 2) ** 2).sum(axis=2)
    far = np.sqrt((squares * shared).sum(axis=1) / np.maximum(count, 1))
    return np.where(count >= FEWEST, far, np.nan)


def _by_others(seen: FloatArray, others: IntArray) -> FloatArray:
    """The median (agents, n, 2) of what all others say, for each agent: ``seen`` (agents, n, 2), not a number where one
    says nothing, and how many (agents, n) do beside it. Where there are none it means nothing.
    """
    order = np.argsort(seen, axis=0)  # what is not a number comes last
    ranked, own = np.take_along_axis(seen, order, axis=0), np.argsort(order, axis=0)
    middle = [np.maximum((others - 1) // 2, 0), np.minimum(others // 2, len(seen) - 1)]
    low, high = (
        np.take_along_axis(ranked, np.minimum(at + (at >= own), len(seen) - 1), axis=0)
        for at in (each[..., None] for each in middle)
    )
    median: FloatArray = (low + high) / 2
    return median


@dataclass
class Placing:
    """Mutable while a frame is judged."""

    off: dict[str, float] = field(default_factory=dict)
    """By teammate: a running mean of how far it is `misplaced`, metres."""
    out: frozenset[str] = frozenset()
    """Who is out of place."""
    lost: dict[str, int] = field(default_factory=dict)
    """By teammate whose message lies `elsewhere`: for how many frames more nothing is held against it. A frame in which
    that cannot be told may lie between two in which it can.
    """
    ego_off: float = EXPECTED_M
    """The running mean of the ego itself."""
    ego_astray: bool = False
    """Whether the ego itself is not where it says: then nobody fits its map, and nobody is to blame for that."""

    def learn_ego(self, far: float, *, differs: bool) -> None:
        """Take in how far the ego is off (`ego_misplaced`), or not a number, and whether it differs from all others."""
        far = EXPECTED_M if np.isnan(far) else far
        self.ego_off = round(self.ego_off + RATE * (far - self.ego_off), 4)
        self.ego_astray = differs or far > EGO_ONCE_M or self.ego_off > EGO_MEAN_M

    def lose(self, found: Collection[str], frames: int) -> None:
        """Take in whose messages lie `elsewhere` in a frame, and for how many frames that counts."""
        left = {name: more - 1 for name, more in self.lost.items() if more > 1}
        self.lost = {**left, **dict.fromkeys(sorted(found), frames)}

    def learn(self, placed: Mapping[str, float], team: Collection[str] = ()) -> None:
        """Take in how far teammates are `misplaced` in a frame.

        With a how far a sender is off, m its running mean, and u the lower median of those of the team, it is out of
        place if a is more than ``max(.6, 2.75 u)`` or m more than ``max(.4, 1.6 u)``. Where the ego is not where it
        says, the whole team is.
        """
        # whoever cannot be placed any longer is believed again, in time
        placed = {**dict.fromkeys(sorted(self.out), EXPECTED_M), **placed}
        for name, far in placed.items():
            before = self.off.get(name, EXPECTED_M)
            self.off[name] = round(before + RATE * (far - before), 4)
        if self.ego_astray:
            self.out = frozenset(team)
            return
        usual = self._usual()
        mean, once = max(MEAN_M, MEAN * usual), max(ONCE_M, ONCE * usual)
        out = {name for name, far in placed.items() if self.off[name] > mean or far > once}
        self.out = frozenset(out.union(self.lost))

    def _usual(self) -> float:
        ranked = sorted(self.off.values())
        return ranked[(len(ranked) - 1) // 2] if len(ranked) > 2 else EXPECTED_M

    def forget(self, teammate: str) -> None:
        """It left."""
        self.off.pop(teammate, None)
        self.lost.pop(teammate, None)
        self.out -= {teammate}

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        ego = {"ego_off": self.ego_off, "ego_astray": self.ego_astray}
        return {"off": self.off, "out": sorted(self.out), "lost": self.lost, **ego}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Placing:
        """What `to_state` wrote; of nothing, as in the states of older versions, nothing is learned yet."""
        off = {str(name): float(far) for name, far in state.get("off", {}).items()}
        out = frozenset(str(name) for name in state.get("out", ()))
        lost = {str(name): int(more) for name, more in state.get("lost", {}).items()}
        return cls(off, out, lost, float(state.get("ego_off", EXPECTED_M)), bool(state.get("ego_astray", False)))
