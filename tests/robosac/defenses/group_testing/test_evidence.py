"""What several findings of one frame count together."""

from dataclasses import replace

import numpy as np
import pytest

from robosac.defenses.group_testing.evidence import SAID_AGAIN, Evidence
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.posterior import Posterior
from tests.robosac.defenses.group_testing.conversing import TEAM, make_model, outcome

MODEL = make_model()


class Watched(Evidence):
    """Notes what each comparison with the ego counts, by who joins it."""

    def _weight(self, finding, cells, likelihood):
        weight = super()._weight(finding, cells, likelihood)
        if finding.test == "ego":
            self.counted = {**getattr(self, "counted", {}), finding.d: weight}
        return weight


def counted(*subsets, attackers=("car-2", "rsu")):
    """Weights of the comparisons of these subsets with the ego, all of one frame."""
    known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), Memory(frame=1))
    evidence = Watched(known, compare_frames=False)
    for subset in subsets:
        evidence.learn(outcome(subset, attackers))
    return evidence.counted


def test_what_speaks_against_the_same_teammates_again_in_a_frame_counts_less():
    both = ("car-2", "rsu")
    full = counted(both)[both]
    again = counted(("car-2",), ("rsu",), both)
    assert again["car-2",] == again["rsu",]
    assert again[both] == pytest.approx(full / (1 + SAID_AGAIN * again["rsu",]))


@pytest.mark.parametrize("other", ["car-3", "car-2"])
def test_it_counts_in_full_as_long_as_it_may_be_somebody_else(other):
    both = (other, "rsu")
    assert counted(("rsu",), both)[both] == pytest.approx(counted(both)[both])


def test_what_speaks_for_them_counts_in_full():
    both = ("car-2", "rsu")
    honest = counted(("car-2",), ("rsu",), both, attackers=())
    assert honest[both] == pytest.approx(counted(both, attackers=())[both])


@pytest.mark.parametrize(("compared", "shown_in", "before"), [(True, 2, True), (True, 1, False), (False, 2, False)])
def test_a_frame_is_compared_with_the_one_just_before_alone_and_vehicles_stay_known(compared, shown_in, before):
    whole = tuple(TEAM)
    known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), Memory(frame=1, shown_in=shown_in))
    boxes = np.array([[number * 8.0, 0.0, 0.0, 0.9] for number in range(4)])
    known.memory.shown = shown = {known.key(whole): boxes}
    evidence = Evidence(known, compare_frames=compared)
    assert bool(known.memory.shown) == compared  # a comparison may be promised until the frame's number is known
    evidence.learn(replace(outcome(whole, ()), frame=3))
    assert known.frames_since == 3 - shown_in
    assert (known.memory.shown, known.shown_before) == ((shown, {}) if before else ({}, shown))
