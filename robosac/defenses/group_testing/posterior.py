"""Who attacks, and how: a probability for every set of attackers with every kind of attack, and for nobody."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.defenses.group_testing import sets
from robosac.defenses.group_testing.model import CELLS

EXACT = 8
"""Teammates up to which all sets are held together: 2 ** 8 of them for each kind of attack."""
BLOCK = 6
"""Most teammates of a block in larger teams."""
BoolArray = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
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
    """Probabilities over (set of attackers A, kind of attack k) and "nobody attacks".

    ``P(nobody) = q_0`` and ``P(A, k) = q_k * prod over blocks b of P_b(A within b | k)``. A team of up to `EXACT`
    teammates is one block, and nothing is approximated. A larger team is cut into blocks of up to `BLOCK`: inside a
    block all sets are held, between blocks (given the kind) independence is assumed, and after each piece of evidence
    the exact posterior is projected onto that form by its marginals on blocks and kind (assumed-density filtering).
    Which teammates share a block may change with what is in doubt; see `regroup`.

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
        self._tables: list[FloatArray] = []  # (K, 2 ** n) each
        self._clean: list[FloatArray | None] = []
        self._stale = True  # some of the clean tables are to be computed
        self._marginals: FloatArray | None = None
        self._powers: FloatArray | None = None

    @classmethod
    def of(cls, kinds: int, attack_prior: float, attacker_prior: float, team: Sequence[str]) -> Posterior:
        """The prior of a team."""
        posterior = cls(kinds, attack_prior, attacker_prior)
        count = 1 if len(team) <= EXACT else -(-len(team) // BLOCK)
        for part in np.array_split(np.arange(len(team)), count):
            members = [team[i] for i in part]
            posterior._blocks.append(members)
            attacking = sets.bits(len(members)).sum(axis=0)
            table = attacker_prior**attacking * (1 - attacker_prior) ** (len(members) - attacking)
            posterior._tables.append(np.repeat(table[None], kinds, axis=0))
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

    @property
    def kinds(self) -> FloatArray:
        """Probability of each kind of attack (K,)."""
        return self._weights[1:].copy()

    def blocks(self) -> list[list[str]]:
        """The team as it is cut into blocks."""
        return [list(block) for block in self._blocks]

    def marginals(self) -> FloatArray:
        """Probability (S,) of each member to attack."""
        if self._marginals is None:
            attacking = [
                sets.bits(len(block)) @ (self._weights[1:] @ table)
                for block, table in zip(self._blocks, self._tables, strict=True)
            ]
            self._marginals = np.minimum(np.maximum(np.concatenate([*attacking, np.empty(0)]), 0.0), 1.0)
        return self._marginals

    def clean_within(self, block: int) -> FloatArray:
        """Probability (2 ** n,) that nobody of each subset of a block attacks, by its mask there."""
        clean: FloatArray = self._weights[0] + self._weights[1:] @ self._clean_tables()[block]
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
        chance: FloatArray = self._weights[0] + self._weights[1:] @ self.clean(masks)
        return chance

    def clean(self, masks: IntArray) -> FloatArray:
        """Probability (K, n) that nobody of each subset attacks, given the kind."""
        touched = np.flatnonzero(masks.any(axis=1)).tolist()
        if not touched:
            return np.ones((self._kinds, masks.shape[1]))
        clean = self._clean_tables()
        product: FloatArray = clean[touched[0]].take(masks[touched[0]], axis=1)
        for b in touched[1:]:
            product *= clean[b].take(masks[b], axis=1)
        return product

    def cells(self, a: IntArray, d: IntArray) -> FloatArray:
        """Joint probabilities (n, 1 + 3 K) of what pairs of disjoint subsets hold, by rows of an `EvidenceModel`.

        Column 0: no attacker in either; then for each kind: one in d only, in a only, in both.
        """
        in_a, in_d = self.clean(a), self.clean(d)
        return self.joint(in_a, in_d, self.clean(a | d) if d.any() else in_a)

    def joint(self, in_a: FloatArray, in_d: FloatArray, in_both: FloatArray) -> FloatArray:
        """The same, from the probabilities (K, n) that nobody of ``a``, of ``d`` and of both attacks (see `clean`)."""
        q = self._weights[1:, None]
        joint = np.empty((in_both.shape[1], 1 + CELLS * self._kinds))
        joint[:, 0] = self._weights[0] + (q * in_both).sum(axis=0)
        attacked = (in_a - in_both, in_d - in_both, 1 - in_a - in_d + in_both)
        for cell, chance in enumerate(attacked):
            joint[:, 1 + cell :: CELLS] = (chance * q).T
        return np.maximum(joint, 0.0)

    def update(self, a: BoolArray, d: BoolArray, log_likelihood: FloatArray) -> None:
        """Learn the outcome of a test of disjoint subsets ``a`` and ``d``.

        Parameters
        ----------
        a, d : (S,) bool ndarray
            In the order of `members`.
        log_likelihood : (1 + 3 K,) ndarray
            Of the outcome, by columns of `cells`.
        """
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        by_kind = likelihood[1:].reshape(self._kinds, CELLS)
        nothing, d_only, a_only, in_both = likelihood[0], by_kind[:, 0], by_kind[:, 1], by_kind[:, 2]
        of_a, of_d = self.masks(np.stack([a, d])).T.tolist()
        touched = [b for b, (x, y) in enumerate(zip(of_a, of_d, strict=True)) if x | y]
        clean = self._clean_tables()
        a_else = sets.products_but([clean[b][:, of_a[b]] for b in touched])
        d_else = sets.products_but([clean[b][:, of_d[b]] for b in touched])
        both_else = sets.products_but([clean[b][:, of_a[b] | of_d[b]] for b in touched])
        neither = nothing * both_else + d_only * (a_else - both_else) + a_only * (d_else - both_else)
        neither = neither + in_both * (1 - a_else - d_else + both_else)
        expected = np.empty((len(touched), self._kinds, 4))  # by whether a and d hold attackers of the block
        expected[..., sets.NEITHER] = neither
        expected[..., sets.IN_A] = a_only * d_else + in_both * (1 - d_else)
        expected[..., sets.IN_D] = d_only * a_else + in_both * (1 - a_else)
        expected[..., sets.IN_BOTH] = in_both
        evidence = np.ones(self._kinds)
        tables = list(self._tables)
        for b, by_state in zip(touched, expected, strict=True):
            where = sets.touching(len(self._blocks[b]), of_a[b], of_d[b])
            updated = tables[b] * by_state.take(where, axis=1)
            evidence = updated.sum(axis=1)
            tables[b] = updated / np.maximum(evidence, _TINY)[:, None]
        weights = self._weights * np.concatenate([[nothing], evidence])
        self._replace(weights, tables)

    def step(self, hazards: Hazards) -> None:
        """Go to the next frame: teammates are hijacked or recover, and the kind of attack may change."""
        h, r = hazards.hijack, hazards.recovery
        kernel = sets.transition(h, r)
        team = len(self.members)
        sizes = {len(block) for block in self._blocks}
        after = list(self._tables)
        for size in sizes:  # blocks of one size at once
            alike = [b for b, block in enumerate(self._blocks) if len(block) == size]
            moved = sets.through(np.concatenate([after[b] for b in alike]), kernel)
            for b, table in zip(alike, np.split(moved, len(alike)), strict=True):
                after[b] = table
        awakened = {n: sets.awakened(n, team, h, r, self._attacker_prior) for n in sizes}
        self._mix(after, [awakened[len(block)] for block in self._blocks])
        attacked = self._weights[1:]
        change = hazards.change if self._kinds > 1 else 0.0
        tables = []
        for table in self._tables:
            flow = (1 - change) * attacked[:, None] * table + change * (attacked @ table)[None] / self._kinds
            tables.append(flow / np.maximum(flow.sum(axis=1), _TINY)[:, None])
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
            self._blocks, self._tables = [[]], [np.ones((self._kinds, 1))]
        size = len(self.members) + 1
        limit = EXACT if size <= EXACT else BLOCK
        self._cut(limit)
        smallest = min(range(len(self._blocks)), key=lambda b: len(self._blocks[b]))
        if len(self._blocks[smallest]) >= limit:
            self._blocks.append([])
            self._tables.append(np.ones((self._kinds, 1)))
            smallest = len(self._blocks) - 1
        table = self._tables[smallest]
        after = list(self._tables)
        after[smallest] = np.concatenate([table * (1 - among_attackers), table * among_attackers], axis=1)
        self._blocks[smallest] = [*self._blocks[smallest], name]
        awakened: list[FloatArray] = []
        for b, block in enumerate(self._blocks):
            start = np.zeros((1, 1 << len(block)))
            start[0, 0] = 1 - alone if b == smallest else 1.0
            if b == smallest:
                start[0, 1 << (len(block) - 1)] = alone
            awakened.append(start)
        self._mix(after, awakened)

    def remove(self, name: str) -> None:
        """Let a teammate leave: what is known of the others stays."""
        block, bit = next((b, m.index(name)) for b, m in enumerate(self._blocks) if name in m)
        table = self._tables[block]
        n = len(self._blocks[block])
        split = table.reshape(self._kinds, 1 << (n - 1 - bit), 2, 1 << bit)
        self._tables[block] = split.sum(axis=2).reshape(self._kinds, -1)
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
            "weights": sets.short(self._weights),
            "blocks": [
                {"members": list(block), "tables": [sets.short(row) for row in table]}
                for block, table in zip(self._blocks, self._tables, strict=True)
            ],
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], attack_prior: float, attacker_prior: float) -> Posterior:
        """What `to_state` wrote."""
        weights = np.array(state["weights"], dtype=np.float64)
        posterior = cls(len(weights) - 1, attack_prior, attacker_prior)
        posterior._blocks = [list(block["members"]) for block in state["blocks"]]
        tables = [np.array(block["tables"], dtype=np.float64) for block in state["blocks"]]
        posterior._replace(weights, [t / np.maximum(t.sum(axis=1, keepdims=True), _TINY) for t in tables])
        return posterior

    def _clean_tables(self) -> list[FloatArray]:
        """For each block and kind, the probability of no attacker within each of its subsets: sums over all sets of
        attackers outside the subset, by the zeta transform.
        """
        for index, known in enumerate(self._clean) if self._stale else ():
            if known is None:
                sums = self._tables[index].copy()
                for bit in range(len(self._blocks[index])):
                    view = sums.reshape(self._kinds, -1, 2, 1 << bit)
                    view[:, :, 1] += view[:, :, 0]
                self._clean[index] = sums[:, ::-1]
        self._stale = False
        return self._clean  # type: ignore[return-value]

    def _mix(self, after: list[FloatArray], awakened: list[FloatArray]) -> None:
        """Add to each kind the share of "nobody" that turns into attackers as in ``awakened``."""
        new = self._weights[0] / self._kinds
        old = self._weights[1:]
        total = np.maximum(old + new, _TINY)[:, None]
        tables = [(old[:, None] * t + new * w) / total for t, w in zip(after, awakened, strict=True)]
        self._replace(np.concatenate([[0.0], old + new]), tables)
        self._settle()

    def _settle(self) -> None:
        """An attack without attackers is none: move that probability to "nobody". To be called once blocks changed."""
        self._powers = None
        none = np.prod([table[:, 0] for table in self._tables], axis=0) if self._tables else np.ones(self._kinds)
        rest = np.maximum(1 - none, _TINY)
        tables = []
        for table in self._tables:
            kept = table.copy()
            kept[:, 0] = np.maximum(table[:, 0] - none, 0.0)
            tables.append(kept / rest[:, None])
        moved = self._weights[1:] * none
        weights = np.concatenate([[self._weights[0] + moved.sum()], self._weights[1:] - moved])
        self._replace(weights, [t / np.maximum(t.sum(axis=1, keepdims=True), _TINY) for t in tables])

    def _replace(self, weights: FloatArray, tables: list[FloatArray]) -> None:
        self._weights = weights / weights.sum()
        same = len(tables) == len(self._clean) == len(self._tables)
        self._clean = [self._clean[b] if same and table is self._tables[b] else None for b, table in enumerate(tables)]
        self._tables = tables
        self._stale, self._marginals = True, None

    def _cut(self, limit: int) -> None:
        """Halve the blocks that are larger than the limit."""
        while any(len(block) > limit for block in self._blocks):
            b = next(i for i, block in enumerate(self._blocks) if len(block) > limit)
            half = len(self._blocks[b]) // 2
            table = self._tables[b].reshape(self._kinds, -1, 1 << half)
            self._tables[b : b + 1] = [table.sum(axis=1), table.sum(axis=2)]
            self._blocks[b : b + 1] = [self._blocks[b][:half], self._blocks[b][half:]]

    def _join(self) -> None:
        """One block where the team is small enough."""
        while len(self._blocks) > 1 and len(self.members) <= EXACT:
            self._tables[:2] = [sets.joint(*self._tables[:2])]
            self._blocks[:2] = [self._blocks[0] + self._blocks[1]]
