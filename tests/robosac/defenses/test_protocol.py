import json

from robosac.answers import Source
from robosac.defenses import Decision, named_in, remembered, suspicion_in, trusted_in


def test_what_others_read_of_a_state_survives_json_beside_the_memory():
    state = json.loads(json.dumps(remembered({"n": 1}, trusted=("a",), named=(), suspicion={"a": 0.5})))
    assert (trusted_in(state), named_in(state), suspicion_in(state)) == (("a",), (), {"a": 0.5})
    assert state["n"] == 1
    decision = Decision((), Source.EGO_ONLY, {}, None, remembered(state, trusted=("b",)))
    assert (decision.trusted, decision.named) == (("b",), ())


def test_what_a_defence_does_not_say_is_not_kept():
    assert remembered({"n": 1}) == {"n": 1}
    assert (trusted_in({}), named_in({}), suspicion_in({})) == ((), None, None)


def test_the_names_that_logs_have_always_had():
    assert set(remembered({}, trusted=(), named=(), suspicion={})) == {"trusted", "named", "suspicion"}
