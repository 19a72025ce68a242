import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.boxes import pose_matrix
from robosac.calibrated import calibration_of
from robosac.defenses import Outcome
from robosac.defenses.group_testing.choice import (
    DEPENDENCE,
    GAIN,
    GAIN_SCALE,
    HARM,
    expected_information,
    gain,
    most_promised,
    utility,
)
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.geometry import followed
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.memory import CHANGE_REPEAT, Memory, identity, keys
from robosac.defenses.group_testing.model import CELLS, CLEAN, LIE, OPEN
from robosac.defenses.group_testing.posterior import EXACT, Posterior
from tests.robosac.defenses.group_testing.conversing import SEEN, TEAM, make_model

MODEL = make_model()
POSTERIOR = Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM)
IDENTITIES = np.array([identity(name) for name in TEAM], dtype=np.uint64)
SINGLES = np.eye(len(TEAM), dtype=bool)
NONE = np.zeros((0, len(TEAM)), dtype=bool)


def bits(memory, subsets=SINGLES, decoded=NONE, *, ego_sees=True):
    known = Knowledge(MODEL, POSTERIOR, memory)
    return expected_information(known, subsets, decoded, ego_sees=ego_sees)


def told_of(model, kind):
    """Evidence that somebody attacks, and in which way."""
    told = np.full(CLEAN + CELLS * len(model.kinds), -30.0)
    first = CLEAN + CELLS * model.kinds.index(kind)
    told[first : first + CELLS] = 0.0
    return told


def test_larger_answers_are_worth_more_also_beyond_the_calibrated_teams():
    sizes = np.arange(64)
    worth = gain(sizes)
    assert (np.diff(worth) > 0).all()
    few = sizes <= EXACT
    np.testing.assert_allclose(worth[few], GAIN * (1 - np.exp(-sizes[few] / GAIN_SCALE)))
    assert worth[20] - worth[EXACT] == pytest.approx(0.09, abs=0.02)


@pytest.mark.parametrize("kind", [LIE, OPEN])
def test_in_a_small_team_a_liar_takes_as_much_as_anybody_who_attacks(kind):
    model, liar = MODEL.with_lies, SINGLES[0]
    posterior = Posterior(len(model.kinds), 0.5, 0.15, TEAM)
    posterior.update(np.zeros(len(TEAM), dtype=bool), liar, told_of(model, kind))
    clean = posterior.unattacked(posterior.masks(np.stack([~liar])))
    expected = clean * gain(np.array([4])) - (1 - clean) * HARM
    assert utility(Knowledge(model, posterior, Memory()), np.stack([~liar])) == pytest.approx(expected)


@pytest.mark.parametrize("kind", [LIE, OPEN])
def test_who_lies_about_objects_takes_nothing_from_what_the_others_add(kind):
    """Once one is known to lie, somebody else may, too: by that alone the answer of a large team does not shrink."""
    model, size = MODEL.with_lies, 14
    posterior = Posterior(len(model.kinds), 0.5, 0.15, [f"v{i:02d}" for i in range(size)])
    liar = np.arange(size) == 13
    posterior.update(np.zeros(size, dtype=bool), liar, told_of(model, kind))
    known = Knowledge(model, posterior, Memory())
    few, others, everybody = np.arange(size) < 4, ~liar, liar | True
    clean = posterior.unattacked(posterior.masks(np.stack([few, others, everybody])))
    assert (clean[0] > 0.4, clean[1] < 0.1, clean[2]) == (True, True, pytest.approx(0.0, abs=1e-6))
    sizes = np.array([4, 13, 14])
    stays, harm = (1.0, HARM * np.minimum(1.0, EXACT / sizes)) if kind == LIE else (clean, HARM)
    worth = utility(known, np.stack([few, others, everybody]))
    assert worth == pytest.approx(stays * gain(np.array([4, 13, 13])) - (1 - clean) * harm)
    assert np.argmax(worth) == (1 if kind == LIE else 0)


def test_what_was_decoded_in_the_frame_before_promises_more():
    shown = followed(SEEN, pose_matrix(0, 0, 0, 0))
    plain, known = bits(Memory(frame=5)), bits(Memory(frame=5, shown={int(IDENTITIES[2]): shown}))
    more = known - plain
    assert more[2] > 0.05
    assert np.delete(more, 2) == pytest.approx(np.zeros(4))
    (key,) = keys(IDENTITIES[2:3], np.zeros(1, dtype=np.uint64)).tolist()
    repeated = bits(Memory(frame=5, shown={int(IDENTITIES[2]): shown}, tests={key: (4, 1)}))
    assert (repeated - plain)[2] == pytest.approx((1 - CHANGE_REPEAT) * more[2])


def test_comparisons_within_a_frame_promise_less_than_if_they_were_independent():
    first, others = np.repeat(SINGLES[:1], 4, axis=0), SINGLES[1:]
    for promised, a, d in (
        (bits(Memory(), others), np.zeros_like(first), others),
        (bits(Memory(), first | others, SINGLES[:1], ego_sees=False), first, others),
    ):
        cells = POSTERIOR.cells(POSTERIOR.masks(a), POSTERIOR.masks(d))
        independent = MODEL.information(a.sum(axis=1), d.sum(axis=1), cells)
        assert independent.min() > 0.05
        assert promised == pytest.approx(DEPENDENCE * independent)
        assert DEPENDENCE == 0.85


def test_beside_an_ego_that_is_no_witness_only_subsets_of_each_other_tell():
    first = SINGLES[:1]
    assert bits(Memory(), SINGLES[1:], first).min() > 0.05
    assert bits(Memory(), SINGLES[1:], first, ego_sees=False) == pytest.approx(np.zeros(len(SINGLES) - 1))


@pytest.mark.parametrize("seed", range(20))
def test_no_subset_promises_more_than_the_most(detector, seed):
    model, rng = calibration_of(detector.info).levels[1].with_lies, np.random.default_rng(seed)
    posterior = Posterior(len(model.kinds), 10 ** -rng.uniform(0.1, 4), 0.25, TEAM)
    for _ in range(seed % 4):
        a, d = SINGLES[rng.permutation(len(TEAM))[:2]]
        posterior.update(a & (rng.random() < 0.5), d, rng.normal(size=4 + 3 * len(model.kinds)))
    options = rng.random((30, len(TEAM))) < 0.5
    options = options[options.any(axis=1)]
    shown = {int(IDENTITIES[i]): followed(SEEN, np.eye(4)) for i in range(len(TEAM))}
    known = Knowledge(model, posterior, Memory(frame=5, shown=shown))
    for decoded in (NONE, SINGLES[:2], np.ones((1, len(TEAM)), dtype=bool)):
        promised = expected_information(known, options, decoded, ego_sees=True)
        assert 0 < promised.max() <= most_promised(known)


@pytest.mark.parametrize(("score", "witnesses"), [(0.9, True), (0.3, False)])
def test_an_ego_without_confident_boxes_is_no_witness(score, witnesses):
    seen = np.copy(SEEN)
    seen[:, 5] = score
    evidence = Evidence(Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), Memory()))
    evidence.learn(Outcome(TEAM[:1], 0.9, Verdict.CONSENSUS, SEEN, seen, np.eye(4), 0, alone=seen))
    assert evidence.ego_witnesses == witnesses
