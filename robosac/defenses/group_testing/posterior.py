"""Who attacks, and how: a probability for every state of the whole team under every kind of attack, and under none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.defenses.group_testing import sets
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.sets import ATTACKS, BENIGN, PLAIN

EXACT = 6
"""Teammates up to which all states are held together: 3 ** 6 of them for each kind of attack."""
BLOCK = 5
"""Most teammates of a block in larger teams."""
BoolArray = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
VIEWS_CHANGE = 0.02
"""Share of what is known of whose view is complementary that is forgotten from frame to frame."""
_LEVELS = np.arange(sets.STATES)
_GREATER = np.maximum.outer(_LEVELS, _LEVELS)
_LIMITS = ((BENIGN, BENIGN), (BENIGN, ATTACKS), (ATTACKS, BENIGN), (PLAIN, PLAIN), (PLAIN, BENIGN), (BENIGN, PLAIN))
_TINY = 1e-300


@dataclass(frozen=True)
class Hazards:
    """How the truth changes from one frame to the next.

    Attributes
    ----------
    hijack : float
        Probability that a benign teammate becomes an attacker.
    recovery : float
        Probability that an attacker becomes benign.
    change : float
        Probability that the kind of attack changes.
    """

    hijack: float
    recovery: float
    change: float


class Posterior:
    """Probabilities over kinds of attack k, "nobody attacks" being k = 0, and states z of the teammates: plain,
    complementary (benign, and it sees much of what the others do not) or attacking.

    ``P(z, k) = q_k * prod over blocks b of P_b(z within b | k)``. A team of up to `EXACT` teammates is one block, and
    nothing is approximated. A larger team is cut into blocks of up to `BLOCK`: inside a block all states are held,
    between blocks (given the kind) independence is assumed, and after each piece of evidence the exact posterior is
    projected onto that form by its marginals on blocks and kind (assumed-density filtering). Which teammates share a
    block may change with what is in doubt; see `regroup`.

    Parameters
    ----------
    kinds : int
        K, at least 1.
    attack_prior : float
        Probability that anybody attacks.
    attacker_prior : float
        Probability of each teammate to attack if anybody does.
    """

    def __init__(self, kinds: int, attack_prior: float, attacker_prior: float) -> None:
        self._kinds = kinds
        self._attack_prior = attack_prior
        self._attacker_prior = attacker_prior
        self._weights = np.array([1 - attack_prior, *[attack_prior / kinds] * kinds])
        self._blocks: list[list[str]] = []
        self._tables: list[FloatArray] = []  # (1 + K, 3 ** n) each
        self._below: list[FloatArray | None] = []
        self._stale = True  # some of the tables below are to be computed
        self._marginals: FloatArray | None = None
        self._powers: FloatArray | None = None

    @classmethod
    def of(cls, kinds: int, attack_prior: float, attacker_prior: float, team: Sequence[str]) -> Posterior:
        """The prior of a team."""
        posterior = cls(kinds, attack_prior, attacker_prior)
        count = 1 if len(team) <= EXACT else -(-len(team) // BLOCK)
        for part in np.array_split(np.arange(len(team)), count):
            posterior._blocks.append([team[i] for i in part])
            attacked = np.repeat(sets.prior(len(part), attacker_prior), kinds, axis=0)
            posterior._tables.append(np.concatenate([sets.prior(len(part), 0.0), attacked]))
        posterior._settle()
        if team:
            posterior._weights = np.array([1 - attack_prior, *[attack_prior / kinds] * kinds])
        return posterior

    @property
    def members(self) -> list[str]:
        """The team, block by block: the order of every array over teammates."""
        return [name for block in self._blocks for name in block]

    @property
    def nobody(self) -> float:
        """Probability that nobody attacks."""
        return float(self._weights[0])

    def blocks(self) -> list[list[str]]:
        """The team as it is cut into blocks."""
        return [list(block) for block in self._blocks]

    def marginals(self) -> FloatArray:
        """Probability (S,) of each member to attack."""
        if self._marginals is None:
            attacking = [
                sets.attacking(len(block)) @ (self._weights[1:] @ table[1:])
                for block, table in zip(self._blocks, self._tables, strict=True)
            ]
            self._marginals = np.minimum(np.maximum(np.concatenate([*attacking, np.empty(0)]), 0.0), 1.0)
        return self._marginals

    def clean_within(self, block: int) -> FloatArray:
        """Probability (2 ** n,) that nobody of each subset of a block attacks, by its mask there."""
        codes = sets.codes(len(self._blocks[block]))
        clean: FloatArray = self._weights @ self._tables_below()[block][:, 2 * codes[-1] - codes]
        return clean

    def masks(self, subsets: BoolArray) -> IntArray:
        """Subsets (n, S), in the order of `members`, as masks (B, n): block by block, bit by bit."""
        if self._powers is None:  # of two, exact as floats, whose products are the fast ones
            self._powers = np.zeros((len(self.members), len(self._blocks)))
            start = 0
            for b, block in enumerate(self._blocks):
                self._powers[start : start + len(block), b] = 1 << np.arange(len(block))
                start += len(block)
        masks: IntArray = (subsets.astype(np.float64) @ self._powers).astype(np.int64).T
        return masks

    def rows(self, blocks: IntArray, masks: IntArray) -> BoolArray:
        """Subsets (n, S) each within one block, of the blocks (n,) and their masks there (n,)."""
        starts = np.cumsum([0, *[len(block) for block in self._blocks]])
        place = np.arange(starts[-1]) - starts[blocks, None]
        inside = (place >= 0) & (place < EXACT)
        rows: BoolArray = inside & ((masks[:, None] >> np.where(inside, place, 0)) & 1).astype(bool)
        return rows

    def unattacked(self, masks: IntArray) -> FloatArray:
        """Probability (n,) that nobody of each subset attacks."""
        chance: FloatArray = self._weights @ self._at_most(masks, np.zeros_like(masks), ((BENIGN, ATTACKS),))[:, 0]
        return chance

    def cells(self, a: IntArray, d: IntArray) -> FloatArray:
        """Joint probabilities (n, CLEAN + 3 K) of what pairs of disjoint subsets hold, by rows of an `EvidenceModel`.

        Columns 0 to 3: no attacker in either; nobody complementary, somebody in d, in a, in both. Then for each kind:
        attackers in d only, in a only, in both.
        """
        q = self._weights
        below = self._at_most(a, d, _LIMITS)
        both, in_a, in_d = below[:, 0], below[:, 1], below[:, 2]
        benign, neither, only_d, only_a = np.tensordot(q, below[:, (0, 3, 4, 5)], 1)
        only_d, only_a = only_d - neither, only_a - neither
        cells = np.empty((a.shape[1], CLEAN + CELLS * self._kinds))
        cells[:, 0], cells[:, 1], cells[:, 2] = neither, only_d, only_a
        cells[:, 3] = benign - neither - only_d - only_a
        for cell, chance in enumerate((in_a - both, in_d - both, 1 - in_a - in_d + both)):
            cells[:, CLEAN + cell :: CELLS] = (chance[1:] * q[1:, None]).T
        return np.maximum(cells, 0.0)

    def update(self, a: BoolArray, d: BoolArray, log_likelihood: FloatArray) -> None:
        """Learn the outcome of a test of disjoint subsets ``a`` and ``d``.

        Parameters
        ----------
        a, d : (S,) bool ndarray
            In the order of `members`.
        log_likelihood : (CLEAN + 3 K,) ndarray
            Of the outcome, by columns of `cells`.
        """
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        by_kind = likelihood[CLEAN:].reshape(self._kinds, CELLS)
        by_level = np.empty((1 + self._kinds, sets.STATES, sets.STATES))  # the greatest states in a and in d
        by_level[:, :2, :2] = likelihood[:CLEAN].reshape(2, 2)
        by_level[0, 2], by_level[0, :, 2] = 0.0, 0.0
        by_level[1:, :2, 2], by_level[1:, 2, :2], by_level[1:, 2, 2] = by_kind[:, :1], by_kind[:, 1:2], by_kind[:, 2]
        of_a, of_d = self.masks(np.stack([a, d])).T.tolist()
        touched = [b for b, (x, y) in enumerate(zip(of_a, of_d, strict=True)) if x | y]
        if len(touched) > 1:
            expected = self._expected(by_level, [(b, of_a[b], of_d[b]) for b in touched])
        else:
            expected = by_level.reshape(1, 1 + self._kinds, -1)
        evidence = np.ones(1 + self._kinds)
        tables = list(self._tables)
        for b, likely in zip(touched, expected, strict=True):
            where = sets.levels(len(self._blocks[b]), of_a[b], of_d[b])
            updated = tables[b] * likely.take(where, axis=1)
            evidence = updated.sum(axis=1)
            tables[b] = updated / np.maximum(evidence, _TINY)[:, None]
        self._replace(self._weights * evidence, tables)

    def _expected(self, by_level: FloatArray, touched: Sequence[tuple[int, int, int]]) -> FloatArray:
        """For each touched block (number, mask of a, mask of d), the likelihood (1 + K, 9) by the levels in it alone,
        expected over what the other blocks hold.
        """
        below = self._tables_below()
        each = np.empty((len(touched), *by_level.shape))
        for known, (b, a, d) in zip(each, touched, strict=True):
            codes = sets.codes(len(self._blocks[b]))
            limits = 2 * codes[-1] - (2 - _LEVELS[:, None]) * codes[a] - (2 - _LEVELS) * codes[d]
            below[b].take(limits, axis=1, out=known)
        chance = sets.products_but(each)
        chance[..., 1:, :] -= chance[..., :-1, :].copy()
        chance[..., 1:] -= chance[..., :-1].copy()
        greater = by_level[:, _GREATER[:, None, :, None], _GREATER[None, :, None, :]]
        expected: FloatArray = np.einsum("kopxy,tkxy->tkop", greater, chance)
        return expected.reshape(len(touched), len(by_level), -1)

    def step(self, hazards: Hazards) -> None:
        """Go to the next frame: teammates are hijacked or recover, and the kind of attack may change."""
        h, r = hazards.hijack, hazards.recovery
        kernel = sets.transition(h, r)
        team = len(self.members)
        after, awakened = list(self._tables), list(self._tables)
        for size in {len(block) for block in self._blocks}:  # blocks of one size at once
            alike = [b for b, block in enumerate(self._blocks) if len(block) == size]
            attacked = sets.through(np.concatenate([self._tables[b][1:] for b in alike]), kernel)
            benign = sets.awakened(np.stack([self._tables[b][0] for b in alike]), team, h, self._attacker_prior)
            for i, (b, table) in enumerate(zip(alike, np.split(attacked, len(alike)), strict=True)):
                after[b], awakened[b] = table, benign[i : i + 1]
        self._mix(after, awakened)
        change = hazards.change if self._kinds > 1 else 0.0
        attacked = self._weights[1:]
        tables = []
        for table in self._tables:
            flow = (1 - change) * attacked[:, None] * table[1:] + change * (attacked @ table[1:])[None] / self._kinds
            flow = np.concatenate([table[:1], flow / np.maximum(flow.sum(axis=1), _TINY)[:, None]])
            tables.append((1 - VIEWS_CHANGE) * flow + VIEWS_CHANGE * sets.forgotten_views(flow))
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
        if not self._blocks:
            self._blocks, self._tables = [[]], [np.ones((1 + self._kinds, 1))]
        size = len(self.members) + 1
        limit = EXACT if size <= EXACT else BLOCK
        self._cut(limit)
        smallest = min(range(len(self._blocks)), key=lambda b: len(self._blocks[b]))
        if len(self._blocks[smallest]) >= limit:
            self._blocks.append([])
            self._tables.append(np.ones((1 + self._kinds, 1)))
            smallest = len(self._blocks) - 1
        benign = [table[:1] for table in self._tables]
        benign[smallest] = sets.joint(benign[smallest], sets.prior(1, 0.0))
        awakened, after = list(benign), [table[1:] for table in self._tables]
        after[smallest] = sets.joint(after[smallest], np.repeat(sets.prior(1, among_attackers), self._kinds, axis=0))
        awakened[smallest] = sets.joint(self._tables[smallest][:1], sets.prior(1, alone))
        self._tables = [np.concatenate(parts) for parts in zip(benign, after, strict=True)]
        self._blocks[smallest] = [*self._blocks[smallest], name]
        self._mix(after, awakened)

    def remove(self, name: str) -> None:
        """Let a teammate leave: what is known of the others stays."""
        block, bit = next((b, m.index(name)) for b, m in enumerate(self._blocks) if name in m)
        table = self._tables[block]
        n = len(self._blocks[block])
        self._tables[block] = sets.marginal(table, [i for i in range(n) if i != bit])
        self._blocks[block] = [other for other in self._blocks[block] if other != name]
        if not self._blocks[block] and len(self._blocks) > 1:
            del self._blocks[block], self._tables[block]
        self._join()
        self._settle()

    def regroup(self, together: BoolArray) -> None:
        """Bring those (S,) that are to be tested together into as few blocks as can hold them.

        Those of one block stay in one: what is known of them together is kept. The others are taken to be independent,
        given the kind. Does nothing where no block is saved.
        """
        masks = self.masks(together[None])[:, 0].tolist()
        crowded = [mask.bit_count() for mask in masks if mask]
        if len(sets.packed(crowded, BLOCK)) >= len(crowded):
            return
        chosen: list[tuple[list[str], FloatArray]] = []
        others: list[tuple[list[str], FloatArray]] = []
        for block, table, mask in zip(self._blocks, self._tables, masks, strict=True):
            for pile, wanted in ((chosen, 1), (others, 0)):
                kept = [i for i in range(len(block)) if mask >> i & 1 == wanted]
                if kept:
                    pile.append(([block[i] for i in kept], sets.marginal(table, kept)))
        self._blocks, self._tables = [], []
        for pile in (chosen, others):
            for group in sets.packed([len(names) for names, _ in pile], BLOCK):
                self._blocks.append([name for i in group for name in pile[i][0]])
                self._tables.append(reduce(sets.joint, [pile[i][1] for i in group]))
        self._settle()

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        return {
            "weights": self._weights.round(7).tolist(),
            "blocks": [
                {"members": list(block), "table": sets.short(table.ravel())}
                for block, table in zip(self._blocks, self._tables, strict=True)
            ],
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], attack_prior: float, attacker_prior: float) -> Posterior:
        """What `to_state` wrote."""
        weights = np.array(state["weights"], dtype=np.float64)
        posterior = cls(len(weights) - 1, attack_prior, attacker_prior)
        posterior._blocks = [list(block["members"]) for block in state["blocks"]]
        tables = [
            sets.long(block["table"], len(weights) * sets.STATES ** len(block["members"])).reshape(len(weights), -1)
            for block in state["blocks"]
        ]
        posterior._replace(weights, [t / np.maximum(t.sum(axis=1, keepdims=True), _TINY) for t in tables])
        return posterior

    def _at_most(self, a: IntArray, d: IntArray, limits: Sequence[tuple[int, int]]) -> FloatArray:
        """Probability (1 + K, L, n), given the kind, that no state in subsets ``a`` is above the first of each pair of
        limits (L,), and none in ``d`` above the second.
        """
        of_a, of_d = 2 - np.array(limits).T[:, :, None]
        product = np.ones((1 + self._kinds, len(limits), a.shape[1]))
        below = self._tables_below()
        for b in np.flatnonzero((a | d).any(axis=1)).tolist():
            codes = sets.codes(len(self._blocks[b]))
            product *= below[b].take(2 * codes[-1] - of_a * codes[a[b]] - of_d * codes[d[b]], axis=1)
        return product

    def _tables_below(self) -> list[FloatArray]:
        """For each block and kind, the probability that no state is above given ones."""
        stale = [b for b, known in enumerate(self._below) if known is None] if self._stale else []
        for size in {len(self._blocks[b]) for b in stale}:  # blocks of one size at once
            alike = [b for b in stale if len(self._blocks[b]) == size]
            below = sets.at_most(np.concatenate([self._tables[b] for b in alike]))
            for b, table in zip(alike, np.split(below, len(alike)), strict=True):
                self._below[b] = table
        self._stale = False
        return self._below  # type: ignore[return-value]

    def _mix(self, after: list[FloatArray], awakened: list[FloatArray]) -> None:
        """Attacked teams go on as in ``after`` (K, 3 ** n), and "nobody attacks" turns into what is in ``awakened``
        (1, 3 ** n), some of which is still nobody.
        """
        new = self._weights[0] / self._kinds
        old = self._weights[1:]
        total = np.maximum(old + new, _TINY)[:, None]
        tables = [
            np.concatenate([table[:1], (old[:, None] * t + new * w) / total])
            for table, t, w in zip(self._tables, after, awakened, strict=True)
        ]
        self._replace(np.concatenate([[0.0], old + new]), tables)
        self._settle()

    def _settle(self) -> None:
        """An attack without attackers is none: move that probability to "nobody". To be called once blocks changed."""
        self._powers = None
        without = [sets.unattacked(len(block)) for block in self._blocks]
        quiet = [table[1:] @ still for table, still in zip(self._tables, without, strict=True)]
        none = np.prod(quiet, axis=0) if quiet else np.ones(self._kinds)
        moved = self._weights[1:] * none
        nobody = self._weights[0] + moved.sum()
        tables = []
        for table, still, chance in zip(self._tables, without, quiet, strict=True):
            share = 1.0 / np.maximum(chance, _TINY)
            lost = 1.0 - np.maximum(chance - none, 0.0) * share
            kept = np.empty_like(table)
            kept[0] = self._weights[0] * table[0] + ((moved * share) @ table[1:]) * still
            kept[1:] = table[1:] * (1.0 - lost[:, None] * still)
            tables.append(kept / np.maximum(kept.sum(axis=1, keepdims=True), _TINY))
        self._replace(np.concatenate([[nobody], self._weights[1:] - moved]), tables)

    def _replace(self, weights: FloatArray, tables: list[FloatArray]) -> None:
        self._weights = weights / weights.sum()
        same = len(tables) == len(self._below) == len(self._tables)
        self._below = [self._below[b] if same and table is self._tables[b] else None for b, table in enumerate(tables)]
        self._tables = tables
        self._stale, self._marginals = True, None

    def _cut(self, limit: int) -> None:
        """Halve the blocks that are larger than the limit."""
        while any(len(block) > limit for block in self._blocks):
            b = next(i for i, block in enumerate(self._blocks) if len(block) > limit)
            half = len(self._blocks[b]) // 2
            table = self._tables[b].reshape(1 + self._kinds, -1, sets.STATES**half)
            self._tables[b : b + 1] = [table.sum(axis=1), table.sum(axis=2)]
            self._blocks[b : b + 1] = [self._blocks[b][:half], self._blocks[b][half:]]

    def _join(self) -> None:
        """One block where the team is small enough."""
        while len(self._blocks) > 1 and len(self.members) <= EXACT:
            self._tables[:2] = [sets.joint(*self._tables[:2])]
            self._blocks[:2] = [self._blocks[0] + self._blocks[1]]
