"""Who attacks, and how: what is believed of it, and how evidence and time change that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing import blocks, sets
from robosac.defenses.group_testing.blocks import Block
from robosac.defenses.group_testing.distribution import Distribution
from robosac.defenses.group_testing.model import CELLS, CLEAN

EXACT = 6
"""Teammates up to which all states are held together: 3 ** 6 of them for each kind of attack."""
BLOCK = 5
"""Most teammates of a block in larger teams."""
VIEWS_CHANGE = 0.02
"""Share of what is known of whose view is complementary that is forgotten from frame to frame."""
_LEVELS = np.arange(sets.STATES)
_GREATER = np.maximum.outer(_LEVELS, _LEVELS)
_TINY = 1e-300


@lru_cache(maxsize=16)
def _by_level(kinds: int) -> IntArray:
    """Which likelihood, by columns of `Posterior.cells`, belongs to each kind and the greatest states in a and in d
    (1 + K, 3, 3); where nobody attacks no state is higher, so what comes after the last one belongs there.
    """
    which = np.empty((1 + kinds, sets.STATES, sets.STATES), dtype=np.int64)
    which[:, :2, :2] = np.arange(CLEAN).reshape(2, 2)
    which[0, 2], which[0, :, 2] = CLEAN + CELLS * kinds, CLEAN + CELLS * kinds
    only_d, only_a, both = np.arange(CLEAN, CLEAN + CELLS * kinds).reshape(kinds, CELLS).T
    which[1:, :2, 2], which[1:, 2, :2], which[1:, 2, 2] = only_d[:, None], only_a[:, None], both
    return which


@dataclass(frozen=True)
class Hazards:
    """How the truth changes from one frame to the next."""

    hijack: float
    """Probability that a benign teammate becomes an attacker."""
    recovery: float
    """Probability that an attacker becomes benign."""
    change: float
    """Probability that the kind of attack changes."""


class Posterior(Distribution):
    """What is believed of a team, from the prior on: it learns from tests, and goes from frame to frame.

    A team of up to `EXACT` teammates is one block, and nothing is approximated. A larger team is cut into blocks of up
    to `BLOCK`; after each piece of evidence the exact posterior is projected onto that form by its marginals on blocks
    and kind (assumed-density filtering). Which teammates share a block may change with what is in doubt; see `regroup`.

    Parameters
    ----------
    kinds : int
        K, at least 1.
    attack_prior : float
        Probability that anybody attacks.
    attacker_prior : float
        Probability of each teammate to attack if anybody does.
    team : sequence of str
    limits : (int, int)
        Teammates up to which a team is one block; most of a block in larger teams.
    known : ((1 + K,) ndarray, sequence of Block), optional
        Weights of the kinds and blocks to go on from, instead of the prior of a team.
    """

    def __init__(
        self,
        kinds: int,
        attack_prior: float,
        attacker_prior: float,
        team: Sequence[str] = (),
        limits: tuple[int, int] = (EXACT, BLOCK),
        known: tuple[FloatArray, Sequence[Block]] | None = None,
    ) -> None:
        self._attack_prior = attack_prior
        self._attacker_prior = attacker_prior
        self._exact, self._most = limits
        if known is not None:
            super().__init__(*known)
            return
        prior = np.array([1 - attack_prior, *[attack_prior / kinds] * kinds])
        parts, count = [], 1 if len(team) <= self._exact else -(-len(team) // self._most)
        for part in np.array_split(np.arange(len(team)), count):
            attacked = np.repeat(sets.prior(len(part), attacker_prior), kinds, axis=0)
            table = np.concatenate([sets.prior(len(part), 0.0), attacked])
            parts.append(Block([team[i] for i in part], table))
        super().__init__(prior, parts)
        self._settle()
        if team:
            self._weights = prior

    def update(self, a: BoolArray, d: BoolArray, log_likelihood: FloatArray) -> None:
        """Learn the outcome of a test of disjoint subsets ``a`` and ``d``.

        Parameters
        ----------
        a, d : (S,) bool ndarray
            In the order of `members`.
        log_likelihood : (CLEAN + 3 K,) ndarray
            Of the outcome, by columns of `cells`.
        """
        self.learn(self.masks(np.stack([a, d])), log_likelihood)

    def learn(self, masks: IntArray, log_likelihood: FloatArray) -> None:
        """As `update`, of subsets as `masks` (B, 2)."""
        of_a, of_d = masks.T.tolist()
        likelihood = np.append(np.exp(log_likelihood - log_likelihood.max()), 0.0)
        by_level = likelihood[_by_level(self._kinds)]
        touched = [b for b, (x, y) in enumerate(zip(of_a, of_d, strict=True)) if x | y]
        if not touched:
            return
        if len(touched) > 1:
            expected = self._expected(by_level, touched, [of_a[b] for b in touched], [of_d[b] for b in touched])
        else:
            expected = by_level.reshape(1, 1 + self._kinds, -1)
        updated = self._tables[touched]
        for i, b in enumerate(touched):
            updated[i] *= expected[i] @ sets.by_level(self._width, of_a[b], of_d[b])
        evidence = updated.sum(axis=2)
        updated /= np.maximum(evidence, _TINY)[:, :, None]
        tables, below = updated, None
        if len(touched) < len(self._tables):
            tables, below = self._tables.copy(), self._below.copy()
            tables[touched], below[touched] = updated, sets.at_most(updated)
        self._replace(self._weights * evidence[-1], tables, below)

    def _expected(self, by_level: FloatArray, touched: Sequence[int], a: Sequence[int], d: Sequence[int]) -> FloatArray:
        """For each touched block, with its masks of a and d, the likelihood (1 + K, 9) by the levels in it alone,
        expected over what the other blocks hold.
        """
        codes, which = sets.codes(self._width), np.array(touched)
        of_a, of_d = codes[list(a)][:, None, None], codes[list(d)][:, None, None]
        limits = 2 * codes[-1] - (2 - _LEVELS[:, None]) * of_a - (2 - _LEVELS) * of_d  # (touched, 3, 3)
        each = self._below[which[:, None, None], :, limits]
        chance = sets.products_but(np.ascontiguousarray(np.moveaxis(each, -1, 1)))
        chance[..., 1:, :] -= chance[..., :-1, :].copy()
        chance[..., 1:] -= chance[..., :-1].copy()
        greater = by_level[:, _GREATER[:, None, :, None], _GREATER[None, :, None, :]]
        flat = greater.reshape(len(by_level), sets.STATES**2, sets.STATES**2)
        expected: FloatArray = (flat * chance.reshape(*chance.shape[:2], 1, -1)).sum(axis=-1)
        return expected

    def step(self, hazards: Hazards) -> None:
        """Go to the next frame: teammates are hijacked or recover, and the kind of attack may change."""
        kernel = sets.transition(hazards.hijack, hazards.recovery)
        team = int(self._sizes.sum())
        nobody, after = self._tables[:, :1], self._tables[:, 1:]
        after = sets.through(after, kernel, self._sizes)
        awakened = sets.awakened(nobody, team, hazards.hijack, self._attacker_prior, self._sizes)
        self._mix(after, awakened, (1 - hazards.hijack) ** team)
        change = hazards.change if self._kinds > 1 else 0.0
        attacked, under_attack = self._weights[1:], self._tables[:, 1:]
        flow = (1 - change) * attacked[:, None] * under_attack
        flow += change * (attacked @ under_attack)[:, None] / self._kinds
        flow /= np.maximum(flow.sum(axis=2, keepdims=True), _TINY)
        flow = np.concatenate([self._tables[:, :1], flow], axis=1)
        tables = (1 - VIEWS_CHANGE) * flow + VIEWS_CHANGE * sets.forgotten_views(flow, self._sizes)
        kinds = (1 - change) * attacked + change * attacked.mean()
        self._replace(np.concatenate([self._weights[:1], kinds]), tables)

    def add(self, name: str, suspicion: float | None = None) -> None:
        """Let a teammate join.

        Parameters
        ----------
        name : str
        suspicion : float, optional
            Probability that it attacks; by default the prior.
        """
        among_attackers = self._attacker_prior if suspicion is None else suspicion
        alone = self._attack_prior * self._attacker_prior if suspicion is None else suspicion
        limit = self._exact if len(self.members) < self._exact else self._most
        team = blocks.halved(self._blocks, limit)
        if min(map(len, team)) >= limit:
            team.append(Block((), np.ones((1 + self._kinds, 1))))
        b = min(range(len(team)), key=lambda b: len(team[b]))
        old = team[b]
        benign = sets.joint(old.table[:1], sets.prior(1, 0.0))
        after = sets.joint(old.table[1:], np.repeat(sets.prior(1, among_attackers), self._kinds, axis=0))
        awakened = [block.table[:1] for block in team]
        awakened[b] = sets.joint(old.table[:1], sets.prior(1, alone))
        team[b] = Block([*old.names, name], np.concatenate([benign, after]))
        self._hold(self._weights, team)
        padded = np.zeros((len(team), 1, self._tables.shape[2]))
        for one, table in zip(padded, awakened, strict=True):
            one[:, : table.shape[1]] = table
        self._mix(self._tables[:, 1:], padded, 1 - alone)

    def remove(self, name: str) -> None:
        """Let a teammate leave: what is known of the others stays."""
        left = blocks.without(self._blocks, name)
        few = sum(map(len, left)) <= self._exact
        self._hold(self._weights, [blocks.together(left)] if few and len(left) > 1 else left)
        self._settle()

    def regroup(self, together: BoolArray) -> None:
        """Bring those (S,) that are to be tested together into as few blocks as can hold them.

        Those of one block stay in one: what is known of them together is kept. The others are taken to be independent,
        given the kind. Does nothing where no block is saved.
        """
        masks = self.masks(together[None])[:, 0].tolist()
        regrouped = blocks.regrouped(self._blocks, masks, self._most)
        if regrouped is not None:
            self._hold(self._weights, regrouped)
            self._settle()

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        return {
            "weights": self._weights.round(7).tolist(),
            "blocks": [
                {"members": list(block.names), "table": sets.short(block.table.ravel())} for block in self._blocks
            ],
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], attack_prior: float, attacker_prior: float) -> Posterior:
        """What `to_state` wrote."""
        weights = np.array(state["weights"], dtype=np.float64)
        team = []
        for block in state["blocks"]:
            table = sets.long(block["table"], len(weights) * sets.STATES ** len(block["members"]))
            table = table.reshape(len(weights), -1)
            table /= np.maximum(table.sum(axis=1, keepdims=True), _TINY)
            team.append(Block(block["members"], table))
        return cls(len(weights) - 1, attack_prior, attacker_prior, known=(weights, team))

    def _mix(self, after: FloatArray, awakened: FloatArray, still: float) -> None:
        """Let attacked teams go on as in ``after`` (B, K, 3 ** n), and a benign team as in ``awakened`` (B, 1, 3 ** n),
        in which attackers may have awoken, or nobody with the probability ``still``.

        Whether anybody has is one question to all blocks, so it goes into the weights: by the tables of many blocks,
        each for itself, somebody would be far likelier.
        """
        nobody = self._tables[:, :1]
        new = self._weights[0] * (1 - still) / self._kinds
        old = self._weights[1:]
        share = (new / np.maximum(old + new, _TINY))[:, None]
        attacked = np.maximum(awakened - still * nobody, 0.0) / max(1 - still, _TINY)
        tables = np.concatenate([nobody, after + share * (attacked - after)], axis=1)
        self._replace(np.concatenate([[self._weights[0] * still], old + new]), tables)
        self._settle()

    def _settle(self) -> None:
        """An attack without attackers is none: move that probability to "nobody". To be called once blocks changed."""
        still, tables = sets.unattacked(self._width), self._tables
        quiet = tables[:, 1:] @ still  # (B, K)
        none = quiet.prod(axis=0)
        moved = self._weights[1:] * none
        nobody = self._weights[0] + moved.sum()
        share = 1.0 / np.maximum(quiet, _TINY)
        lost = 1.0 - np.maximum(quiet - none, 0.0) * share
        kept = np.empty_like(tables)
        kept[:, 0] = self._weights[0] * tables[:, 0] + ((moved * share)[:, None] @ tables[:, 1:])[:, 0] * still
        kept[:, 1:] = tables[:, 1:] * (1.0 - lost[:, :, None] * still)
        kept /= np.maximum(kept.sum(axis=2, keepdims=True), _TINY)
        self._replace(np.concatenate([[nobody], self._weights[1:] - moved]), kept)
