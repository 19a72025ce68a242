from robosac.answers import Source
from robosac.defenses import Undefended
from tests.robosac.defenses.conversation import converse


def test_everybody_is_fused_and_nothing_is_tested(rng):
    decision, tested = converse(Undefended(), [], rng, ["a", "b"])
    assert (tested, decision.accepted, decision.source) == ([], ("a", "b"), Source.TRUSTED)
    assert decision.rejected == {}
    assert Undefended().change_team(decision.state, ["b", "c"]) == {"trusted": ["b", "c"]}


def test_with_nobody_there_the_ego_answers_alone(rng):
    decision, _ = converse(Undefended(), [], rng, [])
    assert (decision.accepted, decision.source) == ((), Source.EGO_ONLY)
