import pytest

from tests.service.conftest import problem


@pytest.mark.parametrize("kind", ["halving", "one_by_one", "conformal"])
async def test_they_answer_without_the_attacker(kind, served, ego_message, attacked):
    session = await served.open(defense={"kind": kind})
    answer = await served.ego(session).post_frame(0, ego_message, attacked)
    assert answer.source == "consensus"
    assert len(answer.accepted) >= 3
    assert answer.rejected["car-2"].reason == "dissensus"
    assert answer.attacker_ratio is None


@pytest.mark.parametrize(
    ("defense", "field"),
    [
        ({"kind": "halving", "attacker_ratio": 0.2}, "defense.attacker_ratio"),
        ({"kind": "one_by_one", "consensus_threshold": 0}, "defense.consensus_threshold"),
        ({"kind": "conformal", "false_discovery_rate": 1}, "defense.false_discovery_rate"),
        ({"kind": "conformal", "calibration": []}, "defense.calibration"),
        ({"kind": "conformal", "calibration": [0.5, 2]}, "defense.calibration.1"),
    ],
)
async def test_their_settings_are_checked(served, defense, field):
    request = {"ego_id": "a", "teammates": list("bcdef"), "defense": defense}
    assert problem(await served.http.post("/v1/sessions", json=request), 422, "invalid-request")["field"] == field
