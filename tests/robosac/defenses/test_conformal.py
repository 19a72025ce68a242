import json

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.answers import Reason, Source, Verdict
from robosac.cli import app
from robosac.defenses import Conformal, Outcome
from robosac.defenses.benign_scores import SINGLE_TEAMMATE
from robosac.defenses.conformal import discoveries
from robosac.evaluation.benign_scores import single_teammate_indices
from robosac.evaluation.oracle import converse_with_oracle
from robosac.scenes.intersection import Synthetic

TEAM = list("abcde")


def answer(defense, indices, rng, together=0.6):
    """One frame in which the single teammates have these Jaccard indices, by name."""

    def outcome(subset):
        index = indices[subset[0]] if len(subset) == 1 else together
        if index is None:
            return Outcome(subset, 1.0, Verdict.NO_EVIDENCE)
        return Outcome(subset, index, Verdict.CONSENSUS if index >= 0.3 else Verdict.DISSENSUS)

    conversation = defense.converse(sorted(indices), {}, rng)
    tested = []
    try:
        batch = next(conversation)
        while True:
            tested += [outcome(subset) for subset in batch]
            batch = conversation.send(tested[-len(batch) :])
    except StopIteration as stop:
        return stop.value, tested


def test_the_procedure_of_benjamini_and_hochberg_on_its_own_example():
    """Benjamini and Hochberg (1995), section 3.2: fifteen p-values, of which four are rejected at 0.05."""
    p = np.array([0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.3240])
    p = np.concatenate([p, [0.4262, 0.5719, 0.6528, 0.7590, 1.0]])
    shuffled = np.random.default_rng(0).permutation(15)
    assert discoveries(p[shuffled], 0.05).sum() == 4
    assert set(np.flatnonzero(discoveries(p[shuffled], 0.05))) == {
        int(np.flatnonzero(shuffled == i)[0]) for i in range(4)
    }
    assert discoveries(np.empty(0), 0.05).shape == (0,)


def test_a_larger_p_value_is_rejected_with_the_smaller_ones_that_carry_it():
    assert discoveries(np.array([0.04, 0.045, 0.05]), 0.05).all()
    assert not discoveries(np.array([0.04, 0.06, 0.9]), 0.05).any()


def test_p_values_count_those_that_are_as_bad():
    defense = Conformal(calibration=(0.5, 0.7, 0.6, 0.8))
    np.testing.assert_allclose(defense.p_values(np.array([0.4, 0.5, 0.65, 1.0])), [0.2, 0.4, 0.6, 1.0])


def test_p_values_of_honest_teammates_are_no_less_than_uniform(rng):
    p = []
    for _ in range(400):
        *calibration, new = rng.random(50)
        p.append(Conformal(calibration=tuple(calibration)).p_values(np.array([new]))[0])
    for level in (0.1, 0.3, 0.6):
        assert np.mean(np.array(p) <= level) <= level + 3 * np.sqrt(level * (1 - level) / 400)


def test_the_share_of_honest_ones_among_the_accused_is_controlled(rng):
    shares = []
    for _ in range(400):
        defense = Conformal(false_discovery_rate=0.2, calibration=tuple(rng.uniform(0.4, 1.0, 199)))
        indices = {name: rng.uniform(0.4, 1.0) for name in "abcd"} | {"e": rng.uniform(0.0, 0.4)}
        decision, _ = answer(defense, indices, rng)
        accused = {name for name, r in decision.rejected.items() if "p_value" in r.evidence}
        shares.append(len(accused - {"e"}) / max(len(accused), 1))
        assert "e" in accused
    assert 0.02 < np.mean(shares) < 0.2


def test_the_accused_are_left_out_with_their_p_value_and_the_rest_is_verified(rng):
    decision, tested = answer(Conformal(), {"a": 0.8, "b": 0.05, "c": 0.7, "d": 0.9, "e": 0.6}, rng)
    assert decision.accepted == tested[-1].teammates == ("a", "c", "d", "e")
    assert decision.source is Source.CONSENSUS
    assert decision.rejected["b"].reason is Reason.DISSENSUS
    assert decision.rejected["b"].evidence["p_value"] == pytest.approx(1 / (1 + len(SINGLE_TEAMMATE)))
    assert tested[decision.rejected["b"].evidence["hypotheses"][0]].teammates == ("b",)


def test_if_the_rest_does_not_agree_the_best_of_them_is_the_answer_and_never_an_accused_one(rng):
    generous = Conformal(calibration=(0.95,) * 199)
    decision, _ = answer(generous, {"a": 0.94, "b": 0.96, "c": 0.97}, rng, together=0.2)
    assert decision.accepted == ("c",)
    assert decision.rejected["a"].evidence["p_value"] == 1 / 200
    everybody, tested = answer(generous, {"a": 0.5, "b": 0.5}, rng)
    assert (everybody.accepted, everybody.source, len(tested)) == ((), Source.EGO_ONLY, 2)


def test_those_without_evidence_are_neither_accused_nor_fused(rng):
    decision, tested = answer(Conformal(), {"a": None, "b": 0.8, "c": 0.8}, rng)
    assert decision.accepted == ("b", "c")
    assert decision.rejected["a"].reason is Reason.NOT_SAMPLED
    decision, tested = answer(Conformal(), {"a": None}, rng)
    assert (decision.source, len(tested)) == (Source.EGO_ONLY, 1)
    assert answer(Conformal(), {}, rng)[0].rejected == {}


def test_with_a_perfect_oracle_the_attackers_are_left_out(rng):
    for attackers in (["a"], ["a", "b", "c"], TEAM, []):
        decision, _ = converse_with_oracle(Conformal(), TEAM, attackers, {}, rng)
        assert decision.accepted == tuple(name for name in TEAM if name not in attackers)
        assert sorted([*decision.accepted, *decision.rejected]) == TEAM


def test_it_runs_against_a_detector(detector, ego_message, attacked):
    import robosac

    result = robosac.fuse(detector, Conformal(), ego_message, attacked, rng=np.random.default_rng(0))
    assert result.fault is None
    assert "car-2" not in result.accepted
    assert len(result.accepted) >= 3


@pytest.mark.parametrize(
    "settings",
    [{"false_discovery_rate": 0.0}, {"false_discovery_rate": 1.0}, {"calibration": ()}, {"calibration": (0.5, 1.1)}],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        Conformal(**settings)


def test_the_default_calibration_is_what_the_command_measures(detector, tmp_path):
    measured = single_teammate_indices(detector, Synthetic().scenes("validation")[:3])
    assert len(measured) == 15
    assert measured == sorted(measured)
    known = np.array(SINGLE_TEAMMATE)
    assert max(np.abs(known - index).min() for index in measured) <= 5e-4 + 1e-9
    out = tmp_path / "[red]indices[1].json"
    result = CliRunner().invoke(app, ["benign-scores", "--scenes", "3", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert f"{out}: 15 Jaccard indices" in result.output
    assert json.loads(out.read_text()) == [round(index, 3) for index in measured]
