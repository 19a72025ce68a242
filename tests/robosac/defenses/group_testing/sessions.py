"""Sessions of group testing on made-up evidence."""

import json

from robosac.answers import Reason
from robosac.defenses import GroupTesting
from robosac.defenses.group_testing import GroupTestingSettings
from tests.robosac.defenses.group_testing.conversing import TEAM, make_model, run_frame

MODEL = make_model()
DEFENSE = GroupTesting(MODEL)


def with_settings(**settings):
    return GroupTesting(MODEL, GroupTestingSettings(**settings))


def run(defense, attackers, frames, rng, state=None, team=TEAM, **options):
    state = defense.initial_state(team) if state is None else state
    decision, tested = None, []
    for _ in range(frames):
        decision, outcomes = run_frame(defense, state, team, attackers, rng, **options)
        state = json.loads(json.dumps(decision.state))
        tested.append(outcomes)
    return decision, tested


def named(decision):
    return {name for name, r in decision.rejected.items() if r.reason is Reason.DISTRUSTED}
