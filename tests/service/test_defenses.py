from dataclasses import replace

import pytest

from robosac import wire
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from tests.service.conftest import TEAM, problem, serve


async def run(served, session, ego_message, teammates, frames, start=0):
    ego = served.ego(session)
    return [await ego.post_frame(start + i, ego_message, teammates) for i in range(frames)]


async def test_a_static_team_is_found_once_and_then_trusted(served, ego_message, attacked):
    defense = {"kind": "static_team", "sampling_budget": 7, "collaborators": 3, "recheck_every": 3}
    session = await served.open(defense=defense)
    answers = await run(served, session, ego_message, attacked, 7)
    assert [answer.source for answer in answers] == [
        "consensus", "trusted", "trusted", "consensus", "trusted", "trusted", "consensus",
    ]  # fmt: skip
    state = (await served.ego(session).state())["state"]
    assert state["trusted"] == list(answers[0].accepted)
    assert all(answer.accepted == answers[0].accepted for answer in answers)
    assert "car-2" not in state["trusted"]
    assert [answer.sampling_steps for answer in answers[1:]] == [0, 0, 1, 0, 0, 1]
    assert {(why.reason, why.distrust) for why in answers[1].rejected.values()} == {("distrusted", "untrusted")}
    assert answers[1].named == ()
    assert answers[1].timings_ms["ego_only"] == 0


async def test_a_hijacked_teammate_is_found_at_the_next_recheck(served, ego_message, benign, attacked):
    defense = {"kind": "static_team", "attacker_ratio": 0.2, "collaborators": 4, "recheck_every": 3}
    session = await served.open(defense=defense)
    answers, frame = [], 0
    while not (answers and "car-2" in answers[-1].accepted):
        if frame:
            await served.ego(session).close()
            session = await served.open(defense=defense)
        answers = await run(served, session, ego_message, benign, 1)
        frame += 1
    struck = await run(served, session, ego_message, attacked, 3, start=1)
    assert [answer.source for answer in struck[:2]] == ["trusted", "trusted"]
    assert struck[2].hypotheses[0].verdict == "dissensus"
    assert "car-2" not in struck[2].accepted
    assert "car-2" not in (await served.ego(session).state())["state"]["trusted"]


async def test_a2cp_estimates_the_ratio_in_the_session(ego_message, attacked):
    async with serve(range(100)) as served:
        session = await served.open(defense={"kind": "a2cp"})
        answers = await run(served, session, ego_message, attacked, 8)
        state = (await served.ego(session).state())["state"]
    assert state["estimate"] == 0.2
    assert all(t >= u for t, u in zip(state["attempts"], state["bounds"], strict=True))
    assert all(answer.sampling_steps <= 5 for answer in answers)
    assert answers[-1].source == "consensus"
    assert len(answers[-1].accepted) == 4
    assert "car-2" not in answers[-1].accepted


async def test_the_previous_answer_can_be_the_reference(served, ego_message, attacked):
    defense = {"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3, "reference": "previous"}
    session = await served.open(defense=defense)
    answers = await run(served, session, ego_message, attacked, 3)
    assert answers[0].timings_ms["ego_only"] > 0
    assert all(answer.timings_ms["ego_only"] == 0 for answer in answers[1:])
    assert all("car-2" not in answer.accepted for answer in answers)
    (after_a_gap,) = await run(served, session, ego_message, attacked, 1, start=9)
    assert after_a_gap.timings_ms["ego_only"] > 0


async def test_without_a_defence_everybody_is_fused(served, ego_message, attacked):
    session = await served.open(defense={"kind": "none"})
    (answer,) = await run(served, session, ego_message, attacked, 1)
    assert (answer.source, set(answer.accepted), answer.sampling_steps) == ("trusted", set(TEAM), 0)


@pytest.mark.parametrize(
    ("defense", "field", "slug"),
    [
        ({"kind": "static_team", "recheck_every": 0}, "defense.recheck_every", "invalid-request"),
        ({"kind": "a2cp", "attacker_ratio": 0.2}, "defense.attacker_ratio", "invalid-request"),
        ({"kind": "a2cp", "ratios": []}, "defense.ratios", "invalid-request"),
        ({"kind": "a2cp", "ratios": [0.4, 0.2]}, "defense", "impossible-defense"),
        ({"kind": "a2cp", "ratios": [0.33]}, "defense", "impossible-defense"),
        ({"kind": "none", "sampling_budget": 3}, "defense.sampling_budget", "invalid-request"),
        ({"kind": "sample_consensus", "reference": "next"}, "defense.reference", "invalid-request"),
        ({"attacker_ratio": 0.2}, "defense.kind", "invalid-request"),
        ({"kind": "group_testing", "sampling_budget": 3}, "defense.sampling_budget", "invalid-request"),
        ({"kind": "group_testing", "naming_bound": 1.0}, "defense.naming_bound", "invalid-request"),
        ({"kind": "group_testing", "hijack": 0.6}, "defense.hijack", "invalid-request"),
        ({"kind": "group_testing", "pose_error_m": 9.0}, "defense", "impossible-defense"),
    ],
)
async def test_settings_of_a_defence_are_checked(served, defense, field, slug):
    request = {"ego_id": "a", "teammates": list("bcdef"), "defense": defense}
    assert problem(await served.http.post("/v1/sessions", json=request), 422, slug)["field"] == field


async def enrol(served, session, *names):
    path = f"/v1/sessions/{session.session_id}/teammates"
    bearer = {"Authorization": f"Bearer {session.ego_token}"}
    return await served.http.post(path, json={"teammates": names}, headers=bearer)


async def dismiss(served, session, name, token=None):
    path = f"/v1/sessions/{session.session_id}/teammates/{name}"
    return await served.http.delete(path, headers={"Authorization": f"Bearer {token or session.ego_token}"})


async def test_teammates_join_and_leave_between_frames(served, messages):
    session = await served.client.open_session(
        "car-1", ["car-2", "car-3"], defense={"kind": "static_team"}, gather_ms=20, latency_budget_ms=20_000
    )
    ego = served.ego(session)
    await served.teammate(session, "car-2").send(0, messages["car-2"])
    await served.teammate(session, "car-3").send(0, messages["car-3"])
    await ego.ask(0, messages["car-1"])

    joined = await enrol(served, session, "rsu", "car-4")
    assert joined.status_code == 201
    assert joined.json()["teammates"] == ["car-2", "car-3", "rsu", "car-4"]
    tokens = joined.json()["teammate_tokens"]
    assert set(tokens) == {"rsu", "car-4"}
    assert (await dismiss(served, session, "car-2")).status_code == 204

    assert "car-2" not in (await ego.state())["state"]["trusted"]
    gone = wire.pack_message(1, "car-2", messages["car-2"])
    problem(await served.post(session, "messages", gone, session.teammate_tokens["car-2"]), 401, "unauthenticated")
    await served.client.vehicle(session.session_id, "rsu", tokens["rsu"]).send(1, messages["rsu"])
    answer = await ego.ask(1, messages["car-1"])
    assert set(answer.accepted) | set(answer.rejected) == {"car-3", "rsu", "car-4"}
    assert answer.rejected["car-4"].reason == "missing"
    events = [record for record in await ego.audit() if record["event"] == "team_changed"]
    assert [(event["joined"], event["left"]) for event in events] == [(["rsu", "car-4"], []), ([], ["car-2"])]


async def test_a_frame_is_fused_with_the_team_of_its_moment(served, ego_message, benign):
    session = await served.open(defense={"kind": "none"})
    await dismiss(served, session, "car-3")
    answer = await served.ego(session).post_frame(0, ego_message, benign)
    assert set(answer.accepted) == set(TEAM) - {"car-3"}
    assert answer.rejected["car-3"].reason == "unauthenticated"


async def test_a2cp_begins_again_with_a_new_team(served, ego_message, benign):
    session = await served.open(defense={"kind": "a2cp"})
    await run(served, session, ego_message, benign, 1)
    assert (await served.ego(session).state())["state"]["estimate"] == 0.0
    await dismiss(served, session, "rsu")
    state = (await served.ego(session).state())["state"]
    assert (state["team_size"], state["estimate"], state["attempts"]) == (4, 1.0, [0, 0, 0, 0])


async def test_impossible_changes_of_the_team_are_refused_and_change_nothing(served, messages):
    session = await served.open(defense={"kind": "a2cp", "ratios": [0.2]})
    fields = problem(await enrol(served, session, "car-2"), 409, "already-enrolled")
    assert fields["field"] == "teammates"
    problem(await enrol(served, session, "car-1"), 409, "already-enrolled")
    problem(await enrol(served, session, "x", "x"), 422, "invalid-request")
    problem(await enrol(served, session), 422, "invalid-request")
    problem(await enrol(served, session, "a b"), 422, "invalid-request")
    refused = problem(await enrol(served, session, *(f"v{i}" for i in range(64))), 422, "too-many-teammates")
    assert refused["detail"] == "ROBOSAC_MAX_TEAMMATES allows at most 63 teammates, got 69"
    problem(await enrol(served, session, "x"), 422, "impossible-defense")
    problem(await dismiss(served, session, "nobody"), 404, "unknown-teammate")
    problem(await dismiss(served, session, "rsu", session.teammate_tokens["car-2"]), 403, "ego-only")
    assert (await served.ego(session).state())["teammates"] == list(TEAM)


async def test_group_testing_names_the_attacker_and_tells_its_suspicion(served, ego_message, attacked):
    session = await served.open(defense={"kind": "group_testing"})
    ego = served.ego(session)
    path = f"/v1/sessions/{session.session_id}"
    bearer = {"Authorization": f"Bearer {session.ego_token}"}
    answers = await run(served, session, ego_message, attacked, 4)
    assert all("car-2" not in answer.accepted for answer in answers)
    last = answers[-1].rejected["car-2"]
    assert (last.reason, last.distrust, answers[-1].named) == ("distrusted", "named", ("car-2",))
    assert {item["test"] for item in last["evidence"]} <= {"ego", "pair", "change", "objects"}
    body = wire.pack_frame(9, ego_message, attacked)
    result = (await served.post(session, "frames", body)).json()
    state = (await served.http.get(path, headers=bearer)).json()
    assert set(result["suspicion"]) == set(TEAM)
    assert result["suspicion"]["car-2"] > 0.99
    assert state["suspicion"] == pytest.approx(result["suspicion"], abs=1e-5)
    assert state["state"]["named"] == ["car-2"]
    assert (await ego.state())["defense"]["budget"] == 4


@pytest.mark.parametrize(
    ("period_ms", "asked", "compared"), [(200.0, {}, True), (251.0, {}, False), (500.0, {"compare_frames": True}, True)]
)
async def test_frames_far_apart_are_compared_only_if_asked_for(served, ego_message, benign, period_ms, asked, compared):
    session = await served.open(defense={"kind": "group_testing", **asked}, frame_period_ms=period_ms)
    await run(served, session, ego_message, benign, 2)
    state = await served.ego(session).state()
    assert state["defense"]["compare_frames"] is compared
    assert state["defense"]["frame_period_ms"] == period_ms


@pytest.mark.parametrize(("period_ms", "compared"), [(200.0, True), (500.0, False)])
async def test_a_session_stored_before_frames_were_compared_is_served_by_its_period(served, period_ms, compared):
    session = await served.open(defense={"kind": "group_testing"}, frame_period_ms=period_ms)
    sessions = served.gateway.sessions
    record = await served.gateway.store.get(session.session_id)
    older = {name: value for name, value in record.defense.items() if name != "compare_frames"}
    assert sessions._revive(replace(record, defense=older)).session.defense.settings.compare_frames is compared


async def test_other_defences_have_no_suspicion(served, ego_message, benign):
    session = await served.open(defense={"kind": "sample_consensus"})
    result = (await served.post(session, "frames", wire.pack_frame(0, ego_message, benign))).json()
    assert result["suspicion"] is None


async def test_a_detector_without_calibration_cannot_test_groups(tmp_path):
    weights = tmp_path / "bare.safetensors"
    weights.write_bytes(SHIPPED_WEIGHTS.read_bytes())
    async with serve(extra_detectors=str(weights)) as served:
        request = {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "group_testing"}}
        fields = problem(await served.http.post("/v1/sessions", json=request), 422, "impossible-defense")
    assert "not calibrated" in fields["detail"]
    assert fields["field"] == "defense"


async def test_a_session_that_asks_for_no_defence_gets_group_testing_where_it_is_calibrated(served, tmp_path):
    body = {"ego_id": "a", "teammates": ["b"]}
    opened = (await served.http.post("/v1/sessions", json=body)).json()
    assert opened["defense"]["kind"] == "group_testing"
    weights = tmp_path / "bare.safetensors"
    weights.write_bytes(SHIPPED_WEIGHTS.read_bytes())
    async with serve(extra_detectors=str(weights)) as bare:
        opened = (await bare.http.post("/v1/sessions", json=body)).json()
    assert opened["defense"]["kind"] == "sample_consensus"
