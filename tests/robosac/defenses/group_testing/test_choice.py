import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.defenses.group_testing import choice
from robosac.defenses.group_testing.geometry import followed
from robosac.defenses.group_testing.memory import CHANGE_REPEAT, Memory, identity, keys
from robosac.defenses.group_testing.posterior import Posterior
from tests.robosac.defenses.group_testing.conversing import SEEN, TEAM, make_model

MODEL = make_model()
IDENTITIES = np.array([identity(name) for name in TEAM], dtype=np.uint64)
SINGLES = np.eye(len(TEAM), dtype=bool)
NONE = np.zeros((0, len(TEAM)), dtype=bool)


def bits(memory, subsets=SINGLES, decoded=NONE, *, ego_sees=True):
    posterior = Posterior.of(len(MODEL.kinds), 0.5, 0.25, TEAM)
    return choice.expected_information(MODEL, posterior, memory, IDENTITIES, subsets, decoded, ego_sees=ego_sees)


def test_what_was_decoded_in_the_frame_before_promises_more():
    shown = followed(SEEN, pose_matrix(0, 0, 0, 0))
    plain, known = bits(Memory(frame=5)), bits(Memory(frame=5, shown={int(IDENTITIES[2]): shown}))
    more = known - plain
    assert more[2] > 0.05
    assert np.delete(more, 2) == pytest.approx(np.zeros(4))
    (key,) = keys(IDENTITIES[2:3], np.zeros(1, dtype=np.uint64)).tolist()
    repeated = bits(Memory(frame=5, shown={int(IDENTITIES[2]): shown}, tests={key: (4, 1)}))
    assert (repeated - plain)[2] == pytest.approx((1 - CHANGE_REPEAT) * more[2])


def test_comparisons_within_a_frame_promise_less_than_if_they_were_independent(monkeypatch):
    pairs = SINGLES | SINGLES[0]
    apart = [bits(Memory()), bits(Memory(), pairs[1:], SINGLES[:1], ego_sees=False)]
    monkeypatch.setattr(choice, "DEPENDENCE", 1.0)
    together = [bits(Memory()), bits(Memory(), pairs[1:], SINGLES[:1], ego_sees=False)]
    for less, more in zip(apart, together, strict=True):
        assert less.max() > 0.05
        assert less / more == pytest.approx(np.full(len(less), 0.85))
