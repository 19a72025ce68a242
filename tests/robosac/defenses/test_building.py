import json

import pytest

from robosac.budget import DomainError
from robosac.defenses import A2CP, Reference, SampleConsensus, StaticTeam, Undefended, build


@pytest.mark.parametrize(
    ("settings", "defense"),
    [
        ({"kind": "none"}, Undefended()),
        ({"kind": "sample_consensus", "reference": "previous"}, SampleConsensus(reference=Reference.PREVIOUS)),
        ({"kind": "static_team", "recheck_every": None}, StaticTeam(recheck_every=None)),
        ({"kind": "a2cp", "ratios": [0, 0.5]}, A2CP(ratios=(0.0, 0.5))),
        ({"kind": "a2cp", "ratios": None, "sampling_budget": 3}, A2CP(sampling_budget=3)),
    ],
)
def test_a_defence_is_built_from_json(settings, defense):
    assert build(json.loads(json.dumps(settings))) == defense


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, "no defence of kind None; known: sample_consensus"),
        ({"kind": "nonesuch"}, "no defence of kind 'nonesuch'"),
        ({"kind": "none", "ratios": [0.5]}, "none: .*ratios"),
        ({"kind": "sample_consensus", "reference": "next"}, "'next' is not a valid Reference"),
        ({"kind": "sample_consensus", "attacker_ratio": 2}, "^attacker_ratio must lie"),
        ({"kind": "a2cp", "ratios": 3}, "a2cp: .*int"),
    ],
)
def test_settings_that_make_no_defence_are_refused(settings, complaint):
    with pytest.raises(DomainError, match=complaint):
        build(settings)
