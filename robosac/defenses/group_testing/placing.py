"""Whose messages lie in a wrong place as a whole: their senders are not where they say, or they are late.

One vehicle tells little about that, all together much: where a sender sees vehicles, and where all others do, differs
by a shift and a turn about the sender that are known to some .1 m and .2 degrees in each frame.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray

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
    ego_off: float = EXPECTED_M
    """The running mean of the ego itself."""
    ego_astray: bool = False
    """Whether the ego itself is not where it says: then nobody fits its map, and nobody is to blame for that."""

    def learn_ego(self, far: float, *, differs: bool) -> None:
        """Take in how far the ego is off (`ego_misplaced`), or not a number, and whether it differs from all others."""
        far = EXPECTED_M if np.isnan(far) else far
        self.ego_off = round(self.ego_off + RATE * (far - self.ego_off), 4)
        self.ego_astray = differs or far > EGO_ONCE_M or self.ego_off > EGO_MEAN_M

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
        self.out = frozenset(name for name, far in placed.items() if self.off[name] > mean or far > once)

    def _usual(self) -> float:
        ranked = sorted(self.off.values())
        return ranked[(len(ranked) - 1) // 2] if len(ranked) > 2 else EXPECTED_M

    def forget(self, teammate: str) -> None:
        """It left."""
        self.off.pop(teammate, None)
        self.out -= {teammate}

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        ego = {"ego_off": self.ego_off, "ego_astray": self.ego_astray}
        return {"off": self.off, "out": sorted(self.out), **ego}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Placing:
        """What `to_state` wrote; of nothing, as in the states of older versions, nothing is learned yet."""
        off = {str(name): float(far) for name, far in state.get("off", {}).items()}
        out = frozenset(str(name) for name in state.get("out", ()))
        return cls(off, out, float(state.get("ego_off", EXPECTED_M)), bool(state.get("ego_astray", False)))
