import pytest

from robosac.answers import Reason, Source, Verdict
from robosac.defenses import StaticTeam
from tests.robosac.defenses.conversation import converse

TEAM = ["a", "b", "c", "d", "e"]
DEFENSE = StaticTeam(sampling_budget=7, collaborators=3, recheck_every=4)
TRUSTING = {"trusted": ["a", "b", "c"], "frames_since_check": 0}


def good(subset):
    return Verdict.DISSENSUS if "e" in subset else Verdict.CONSENSUS


def test_it_samples_until_somebody_can_be_trusted(rng):
    decision, tested = converse(DEFENSE, good, rng, TEAM)
    assert decision.source is Source.CONSENSUS
    assert decision.accepted == tested[-1].teammates
    assert decision.state == {"trusted": list(decision.accepted), "frames_since_check": 0}
    decision, _ = converse(DEFENSE, [Verdict.DISSENSUS] * 9, rng, TEAM)
    assert (decision.source, decision.state["trusted"]) == (Source.EGO_ONLY, [])


def test_the_trusted_are_used_without_a_test(rng):
    decision, tested = converse(DEFENSE, good, rng, TEAM, TRUSTING)
    assert tested == []
    assert (decision.source, decision.accepted) == (Source.TRUSTED, ("a", "b", "c"))
    assert {t: r.reason for t, r in decision.rejected.items()} == {"d": Reason.DISTRUSTED, "e": Reason.DISTRUSTED}
    assert decision.state["frames_since_check"] == 1


def test_they_are_looked_at_again_every_so_many_frames(rng):
    state, checks = TRUSTING, []
    for _ in range(9):
        decision, tested = converse(DEFENSE, good, rng, TEAM, state)
        checks.append(len(tested))
        assert decision.source is (Source.CONSENSUS if tested else Source.TRUSTED)
        state = decision.state
    assert checks == [0, 0, 0, 1, 0, 0, 0, 1, 0]


def test_without_a_recheck_it_never_looks_again(rng):
    never = StaticTeam(collaborators=3, recheck_every=None)
    decision, tested = converse(never, good, rng, TEAM, {"trusted": ["e"], "frames_since_check": 10**6})
    assert (tested, decision.accepted) == ([], ("e",))


def test_a_hijacked_teammate_loses_everybody_their_trust_and_the_frame_goes_on(rng):
    hijacked = {"trusted": ["a", "b", "e"], "frames_since_check": 3}
    decision, tested = converse(DEFENSE, good, rng, TEAM, hijacked)
    assert tested[0].teammates == ("a", "b", "e")
    assert len(tested) <= 7
    assert decision.source is Source.CONSENSUS
    assert "e" not in decision.state["trusted"]
    assert decision.state["trusted"] == list(decision.accepted)


def test_the_budget_holds_for_recheck_and_search_together(rng):
    due = {"trusted": ["a"], "frames_since_check": 3}
    decision, tested = converse(DEFENSE, [Verdict.DISSENSUS] * 20, rng, TEAM, due)
    assert len(tested) == 7
    assert (decision.source, decision.state["trusted"]) == (Source.EGO_ONLY, [])


@pytest.mark.parametrize("verdicts", [[], [Verdict.NO_EVIDENCE]])
def test_without_time_or_evidence_the_list_stays_and_the_next_frame_tries_again(verdicts, rng):
    due = {"trusted": ["a", "b"], "frames_since_check": 3}
    decision, _ = converse(DEFENSE, verdicts, rng, TEAM, due)
    assert (decision.source, decision.accepted) == (Source.TRUSTED, ("a", "b"))
    assert decision.state == {"trusted": ["a", "b"], "frames_since_check": 4}
    _, tested = converse(DEFENSE, good, rng, TEAM, decision.state)
    assert len(tested) == 1


def test_the_list_survives_missing_teammates(rng):
    decision, _ = converse(DEFENSE, good, rng, ["b", "d"], TRUSTING)
    assert (decision.source, decision.accepted) == (Source.TRUSTED, ("b",))
    assert decision.state["trusted"] == ["a", "b", "c"]
    decision, _ = converse(DEFENSE, good, rng, [], TRUSTING)
    assert (decision.source, decision.state["trusted"]) == (Source.EGO_ONLY, ["a", "b", "c"])


def test_with_none_of_the_trusted_there_the_others_are_sampled_and_added(rng):
    decision, tested = converse(DEFENSE, good, rng, ["d"], TRUSTING)
    assert len(tested) == 1
    assert (decision.source, decision.accepted) == (Source.CONSENSUS, ("d",))
    assert decision.state["trusted"] == ["a", "b", "c", "d"]


def test_those_who_leave_are_no_longer_trusted():
    state = DEFENSE.change_team({"trusted": ["a", "b"], "frames_since_check": 2}, ["b", "x"])
    assert state == {"trusted": ["b"], "frames_since_check": 2}


def test_a_recheck_interval_must_be_positive():
    with pytest.raises(ValueError, match="recheck_every"):
        StaticTeam(recheck_every=0)
