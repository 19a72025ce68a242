import json
from itertools import product

import numpy as np
import pytest

from robosac.defenses.group_testing import Hazards, sets
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.posterior import BLOCK, EXACT, VIEWS_CHANGE, Posterior
from robosac.defenses.group_testing.sets import ATTACKS, COMPLEMENTARY, PLAIN

TEAM = list("abcd")
KINDS = 3
HAZARDS = Hazards(0.02, 0.01, 0.1)


class BruteForce:
    """Every (states of all, kind) in a dictionary, by the definitions; kind None is no attack."""

    def __init__(self, team, attack_prior=0.5, attacker_prior=0.25):
        self.team, self.attacker_prior = team, attacker_prior
        worlds = list(product(range(3), repeat=len(team)))
        drawn = {z: self.chance_of_attackers(z) * self.view(z) for z in worlds if ATTACKS in z}
        total = sum(drawn.values())
        self.p = {(z, k): attack_prior / KINDS * p / total for z, p in drawn.items() for k in range(KINDS)}
        self.p |= {(z, None): (1 - attack_prior) * self.view(z) for z in worlds if ATTACKS not in z}

    def chance_of_attackers(self, z):
        return self.attacker_prior ** z.count(ATTACKS) * (1 - self.attacker_prior) ** (len(z) - z.count(ATTACKS))

    @staticmethod
    def view(z):
        complementary, plain = z.count(COMPLEMENTARY), z.count(PLAIN)
        drawn = sets.COMPLEMENTARY_MEMBERS**complementary * (1 - sets.COMPLEMENTARY_MEMBERS) ** plain
        return sets.COMPLEMENTARY_TEAMS * drawn + (1 - sets.COMPLEMENTARY_TEAMS) * (complementary == 0)

    def row(self, z, kind, a, d):
        in_a, in_d = (max((z[self.team.index(name)] for name in subset), default=PLAIN) for subset in (a, d))
        if ATTACKS in (in_a, in_d):
            return CLEAN + CELLS * kind + 2 * (in_a == ATTACKS) + (in_d == ATTACKS) - 1
        return 2 * in_a + in_d

    def update(self, a, d, log_likelihood):
        self.p = {(z, k): p * np.exp(log_likelihood[self.row(z, k, a, d)]) for (z, k), p in self.p.items()}
        total = sum(self.p.values())
        self.p = {key: p / total for key, p in self.p.items()}

    def step(self, h):
        after = dict.fromkeys(self.p, 0.0)
        for (before, kind), p in self.p.items():
            for now in product(range(3), repeat=len(self.team)):
                chance = self.alone(before, now, h)
                if kind is None:
                    chance = (chance + self.together(before, now, h)) / 2
                if ATTACKS not in now:
                    after[now, None] += p * chance
                elif kind is None:
                    for k in range(KINDS):
                        after[now, k] += p * chance / KINDS
                else:
                    for k in range(KINDS):
                        after[now, k] += p * chance * ((1 - h.change) * (k == kind) + h.change / KINDS)
        self.p = dict.fromkeys(after, 0.0)
        for (z, k), p in after.items():
            self.p[z, k] += (1 - VIEWS_CHANGE) * p
            for other, kind in after:
                if k == kind and all((x == ATTACKS) == (y == ATTACKS) for x, y in zip(z, other, strict=True)):
                    self.p[other, k] += VIEWS_CHANGE * p * self.view(other)

    @staticmethod
    def alone(before, now, h):
        chance = 1.0
        for old, new in zip(before, now, strict=True):
            if old == ATTACKS:
                chance *= {PLAIN: h.recovery, COMPLEMENTARY: 0.0, ATTACKS: 1 - h.recovery}[new]
            else:
                chance *= h.hijack if new == ATTACKS else (1 - h.hijack) * (new == old)
        return chance

    def together(self, before, now, h):
        nobody = (1 - h.hijack) ** len(self.team)
        if ATTACKS not in now:
            return nobody * (now == before)
        if any(new not in (old, ATTACKS) for old, new in zip(before, now, strict=True)):
            return 0.0
        return (1 - nobody) * self.chance_of_attackers(now) / (1 - (1 - self.attacker_prior) ** len(self.team))

    def marginals(self, members):
        return [sum(p for (z, _), p in self.p.items() if z[self.team.index(n)] == ATTACKS) for n in members]

    def cells(self, a, d):
        found = np.zeros(CLEAN + CELLS * KINDS)
        for (z, k), p in self.p.items():
            found[self.row(z, k, a, d)] += p
        return found

    @property
    def nobody(self):
        return sum(p for (_, k), p in self.p.items() if k is None)


def rows(posterior, *subsets):
    return np.array([[name in subset for name in posterior.members] for subset in subsets])


def cells(posterior, a, d):
    return posterior.cells(posterior.masks(rows(posterior, a)), posterior.masks(rows(posterior, d)))[0]


def random_tests(rng, team, count):
    for _ in range(count):
        order = [str(name) for name in rng.permutation(team)]
        split = rng.integers(1, len(team))
        yield order[:split], order[split : split + rng.integers(0, 3)], rng.normal(0, 1.5, CLEAN + CELLS * KINDS)


def test_a_small_team_is_exact(rng):
    posterior, brute = Posterior(KINDS, 0.5, 0.25, TEAM), BruteForce(TEAM)
    np.testing.assert_allclose(posterior.marginals(), brute.marginals(TEAM))
    for a, d, log_likelihood in random_tests(rng, TEAM, 8):
        np.testing.assert_allclose(cells(posterior, a, d), brute.cells(a, d), atol=1e-12)
        posterior.update(*rows(posterior, a, d), log_likelihood)
        brute.update(a, d, log_likelihood)
        np.testing.assert_allclose(posterior.marginals(), brute.marginals(TEAM), atol=1e-12)
        posterior.step(HAZARDS)
        brute.step(HAZARDS)
        np.testing.assert_allclose(posterior.marginals(), brute.marginals(TEAM), atol=1e-12)
        assert posterior.nobody == pytest.approx(brute.nobody)


def spelled_out(posterior):
    """The distribution that a posterior stands for, whatever its blocks, from its state."""
    state = posterior.to_state()
    brute = BruteForce(posterior.members)
    tables = [
        sets.long(block["table"], (1 + KINDS) * 3 ** len(block["members"])).reshape(1 + KINDS, -1)
        for block in state["blocks"]
    ]
    brute.p = {}
    for z in product(range(3), repeat=len(brute.team)):
        parts, start = [], 0
        for block in state["blocks"]:
            part = z[start : start + len(block["members"])]
            parts.append(sum(s * 3**i for i, s in enumerate(part)))
            start += len(part)
        for k, weight in enumerate(state["weights"]):
            chance = weight * np.prod([table[k, part] for table, part in zip(tables, parts, strict=True)])
            if k or ATTACKS not in z:
                brute.p[z, k - 1 if k else None] = chance
    return brute


def test_learning_across_blocks_keeps_the_marginals_exact(rng):
    posterior = Posterior(KINDS, 0.5, 0.25, TEAM, limits=(3, 2))
    assert len(posterior.blocks()) == 2
    for a, d, log_likelihood in random_tests(rng, TEAM, 12):
        brute = spelled_out(posterior)
        np.testing.assert_allclose(cells(posterior, a, d), brute.cells(a, d), atol=1e-5)
        posterior.update(*rows(posterior, a, d), log_likelihood)
        brute.update(a, d, log_likelihood)
        np.testing.assert_allclose(posterior.marginals(), brute.marginals(posterior.members), atol=1e-4)
        assert posterior.nobody == pytest.approx(brute.nobody, abs=1e-4)


@pytest.mark.parametrize("size", [4, 12, 50])
def test_an_attack_begins_as_often_whatever_the_blocks(size):
    posterior = Posterior(KINDS, 1e-9, 0.25, [f"v{i:02d}" for i in range(size)])
    posterior.step(HAZARDS)
    assert 1 - posterior.nobody == pytest.approx(1 - (1 - HAZARDS.hijack) ** size, rel=0.12)


def test_state_survives_json(rng):
    posterior = Posterior(KINDS, 0.5, 0.25, TEAM)
    for a, d, log_likelihood in random_tests(rng, TEAM, 4):
        posterior.update(*rows(posterior, a, d), log_likelihood)
    again = Posterior.from_state(json.loads(json.dumps(posterior.to_state())), 0.5, 0.25)
    assert again.members == posterior.members
    np.testing.assert_allclose(again.marginals(), posterior.marginals(), rtol=1e-3, atol=1e-6)


def test_one_who_leaves_takes_only_its_own_part(rng):
    posterior, brute = Posterior(KINDS, 0.5, 0.25, TEAM), BruteForce(TEAM)
    for a, d, log_likelihood in random_tests(rng, TEAM, 4):
        posterior.update(*rows(posterior, a, d), log_likelihood)
        brute.update(a, d, log_likelihood)
    posterior.remove("c")
    assert posterior.members == list("abd")
    np.testing.assert_allclose(posterior.marginals(), brute.marginals("abd"), atol=1e-12)
    posterior.add("z", 0.7)
    np.testing.assert_allclose(posterior.marginals(), [*brute.marginals("abd"), 0.7], atol=1e-12)


def test_a_team_comes_and_goes():
    posterior = Posterior(KINDS, 0.5, 0.25, [])
    for number in range(12):
        posterior.add(f"v{number}")
        assert max(map(len, posterior.blocks())) <= (EXACT if number < EXACT else BLOCK)
        assert cells(posterior, posterior.members[:1], posterior.members[1:]).sum() == pytest.approx(1)
    for number in range(12):
        posterior.remove(f"v{number}")
        if len(posterior.members) <= EXACT:
            assert len(posterior.blocks()) == 1
    assert posterior.members == []


@pytest.mark.parametrize("size", [5, 6])
def test_blocks_come_near_the_exact_posterior(size):
    team = [f"v{i}" for i in range(size)]
    rng = np.random.default_rng(size)
    apart = []
    for _ in range(20):
        bad = set(rng.choice(team, 2, replace=False))
        exact = Posterior(1, 0.5, 0.25, team)
        cut = Posterior(1, 0.5, 0.25, team, limits=(3, 4))
        assert len(cut.blocks()) > 1
        for _ in range(12):
            subset = rng.choice(team, rng.integers(1, 4), replace=False)
            says = 1.5 if bad & set(subset) else -1.5
            for posterior in (exact, cut):
                posterior.update(*rows(posterior, subset, ()), np.array([0.0] * CLEAN + [says] * CELLS))
        apart.append(np.abs(exact.marginals() - cut.marginals()))
    assert np.mean(apart) < 0.05
    assert np.quantile(apart, 0.95) < 0.3


def test_regrouping_saves_blocks_and_keeps_what_is_known(rng):
    team = [f"v{i:02d}" for i in range(20)]
    posterior = Posterior(KINDS, 0.5, 0.25, team)
    for first in range(0, 20, 5):  # what is known of two of a block hangs together
        pair = team[first : first + 2]
        posterior.update(*rows(posterior, pair, ()), rng.normal(1.0, 1.0, CLEAN + CELLS * KINDS))
    doubtful = [name for first in range(0, 20, 5) for name in team[first : first + 2]]
    assert len(posterior.blocks()) == 4
    before = dict(zip(posterior.members, posterior.marginals(), strict=True))
    pairs = [cells(posterior, doubtful[i : i + 1], doubtful[i + 1 : i + 2]) for i in range(0, 8, 2)]
    posterior.regroup(np.isin(posterior.members, doubtful))
    holding = [set(block) for block in posterior.blocks() if not set(block).isdisjoint(doubtful)]
    assert sorted(map(len, holding)) == [4, 4]
    assert set.union(*holding) == set(doubtful)
    assert sorted(posterior.members) == team
    assert max(map(len, posterior.blocks())) <= BLOCK
    for name, p in zip(posterior.members, posterior.marginals(), strict=True):
        assert p == pytest.approx(before[name], abs=2e-3)
    for i, known in enumerate(pairs):
        a, d = doubtful[2 * i : 2 * i + 1], doubtful[2 * i + 1 : 2 * i + 2]
        np.testing.assert_allclose(cells(posterior, a, d), known, atol=2e-3)


def test_regrouping_that_saves_no_block_changes_nothing():
    posterior = Posterior(KINDS, 0.5, 0.25, [f"v{i:02d}" for i in range(20)])
    before = posterior.to_state()
    posterior.regroup(np.ones(20, dtype=bool))
    posterior.regroup(np.arange(20) < 5)
    posterior.regroup(np.zeros(20, dtype=bool))
    assert posterior.to_state() == before


def test_rows_are_the_subsets_of_their_masks():
    posterior = Posterior(KINDS, 0.5, 0.25, [f"v{i:02d}" for i in range(13)])
    subsets = posterior.rows(np.array([0, 2]), np.array([0b101, 0b10]))
    sizes = [len(block) for block in posterior.blocks()]
    assert [np.flatnonzero(row).tolist() for row in subsets] == [[0, 2], [sizes[0] + sizes[1] + 1]]
    np.testing.assert_array_equal(posterior.masks(subsets), [[0b101, 0], [0, 0], [0, 0b10]])
    np.testing.assert_allclose(posterior.clean_within(2)[0b10], posterior.unattacked(posterior.masks(subsets))[1])
