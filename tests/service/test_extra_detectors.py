import contextlib
import json
import shutil
import sys
import types
from collections import Counter

import pytest

from clients.simulation import Fleet
from robosac import attacks, detectors
from robosac.attacks import GaussianNoise
from robosac.audit import replay, verify
from robosac.detectors import EmbeddedDetector
from robosac.detectors.embedded import ADVERSARIAL_WEIGHTS, SHIPPED_WEIGHTS
from robosac.detectors.v2xsim import write_weights
from robosac.scenes import IntersectionScene
from service.settings import Settings
from tests.robosac.detectors.v2xsim.recipe import made_up, published_keys
from tests.service.conftest import problem, serve


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("served") / "v2x-sim-max.safetensors"
    write_weights({key: made_up(key, shape) for key, shape, _ in published_keys()}, "max", path)
    return str(path)


async def test_a_v2x_sim_detector_is_served(weights):
    detector = detectors.load(weights)
    (frame,) = Fleet(IntersectionScene(3), detector, 1, 1, GaussianNoise(), seed=0).sense(0)
    assert set(frame.message.tensors) == {"features", "grid"}
    assert set(frame.sent["rsu"].tensors) == {"features"}
    async with serve(extra_detectors=(weights,)) as served:
        defense = {"kind": "sample_consensus", "sampling_budget": 2, "collaborators": 3}
        session = await served.open(detector="v2x-sim-max", latency_budget_ms=60_000, defense=defense)
        assert session.detector["weights_digest"] == detector.info.weights_digest
        answer = await served.ego(session).post_frame(0, frame.message, frame.sent)
    assert answer.degraded_by is None
    assert answer.sampling_steps >= 1


async def test_other_weights_of_a_shipped_detector_take_its_place():
    async with serve(extra_detectors=(str(ADVERSARIAL_WEIGHTS),)) as served:
        (entry,) = await served.client.detectors()
    assert entry["weights_digest"] == EmbeddedDetector(ADVERSARIAL_WEIGHTS).info.weights_digest


@pytest.mark.parametrize(
    ("extra", "complaint"),
    [
        ("/nowhere.safetensors", "there is no file /nowhere.safetensors"),
        (f"{ADVERSARIAL_WEIGHTS}, {ADVERSARIAL_WEIGHTS}", "same name"),
        ("nonesuch:build", "No module named 'nonesuch'"),
    ],
)
async def test_a_detector_that_cannot_be_loaded_keeps_the_gateway_from_starting(extra, complaint):
    with pytest.raises(ValueError, match=complaint):
        async with serve(extra_detectors=extra):
            pytest.fail("it started")


async def test_a_calibration_that_cannot_be_used_is_told_at_the_start(tmp_path, caplog):
    own = tmp_path / "own.safetensors"
    shutil.copy(ADVERSARIAL_WEIGHTS, own)
    calibration = own.with_suffix(".calibration.json")
    shutil.copy(SHIPPED_WEIGHTS.with_suffix(".calibration.json"), calibration)
    for text, why in (
        (None, "own.calibration.json belongs to weights"),
        ("{", "own.calibration.json is no calibration"),
    ):
        caplog.clear()
        if text is not None:
            calibration.write_text(text)
        async with serve(extra_detectors=str(own)) as served:
            (said,) = [r.msg for r in caplog.records if r.name == "service.engine"]
            body = {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "group_testing"}}
            refused = await served.http.post("/v1/sessions", json=body)
        assert why in refused.json()["detail"]
        assert str(tmp_path) not in refused.text
        assert (said["event"], said["detector"]) == ("group testing is refused", "intersection-mean")
        assert why in said["why"]


async def test_a_detector_without_a_witness_is_told_of(tmp_path, caplog):
    own = tmp_path / "own.safetensors"
    for path in (SHIPPED_WEIGHTS, SHIPPED_WEIGHTS.with_suffix(".calibration.json")):
        shutil.copy(path, own.with_suffix("".join(path.suffixes)))
    for extra, judged in (((), True), ((str(own),), False)):
        caplog.clear()
        async with serve(extra_detectors=extra) as served:
            said = [r.msg for r in caplog.records if r.name == "service.engine"]
            (entry,) = await served.client.detectors()
            session, other = await served.open(), await served.open(defense={"kind": "sample_consensus"})
            unasked = await served.open(defense={"kind": "group_testing", "judge_objects": False})
        assert entry["calibration"]["objects_judged"] is judged
        assert [each.lacks_witness for each in (session, other, unasked)] == [not judged, False, False]
        assert [(event["event"], event["detector"]) for event in said] == (
            [] if judged else [("single objects are not judged", "intersection-mean")]
        )
        assert all("robosac witness makes one" in event["why"] for event in said)


def test_several_extra_detectors_are_separated_by_commas(monkeypatch):
    monkeypatch.setenv("ROBOSAC_EXTRA_DETECTORS", "a.safetensors, mine:build,")
    assert Settings().extra_detectors == ("a.safetensors", "mine:build")


@pytest.mark.parametrize("load", [attacks.load, detectors.load])
@pytest.mark.parametrize(
    ("attribute", "complaint"),
    [("number", "not callable"), ("missing", "no attribute"), ("fails", "ZeroDivisionError"), ("other", "but 7")],
)
def test_what_a_reference_makes_is_checked(load, attribute, complaint, monkeypatch):
    module = types.ModuleType("own")
    module.number, module.fails, module.other = 1, lambda: 1 / 0, lambda: 7
    monkeypatch.setitem(sys.modules, "own", module)
    with pytest.raises(ValueError, match=complaint):
        load(f"own:{attribute}")


async def test_other_weights_of_the_same_name_are_recorded_and_have_to_be_allowed(tmp_path, good_frame, caplog):
    database = f"sqlite:///{tmp_path}/robosac.db"
    own = {"database_url": database, "extra_detectors": (str(ADVERSARIAL_WEIGHTS),)}
    async with serve(database_url=database) as served:
        session = await served.open(defense={"kind": "sample_consensus"})
        await served.ego(session).post_frame_body(good_frame(0))
    async with serve(**own) as served:
        for _ in range(2):
            refused = await served.post(session, "frames", good_frame(1))
            fields = problem(refused, 503, "detector-unavailable")
            assert "ROBOSAC_ALLOW_OTHER_WEIGHTS" in fields["detail"]
        assert caplog.text.count("'event': 'other weights'") == 1  # however often somebody asks
        assert [record["event"] for record in await served.ego(session).audit()][2:] == ["detector_changed"]
    async with serve(**own, allow_other_weights=True, keep_frames=9) as served:
        ego = served.ego(session)
        await ego.post_frame_body(good_frame(1))
        lines, body = [line.encode() for line in await ego.audit_lines()], await ego.kept_messages(1)
    async with serve(**own) as served:
        await served.ego(session).post_frame_body(good_frame(2))  # these are the session's by now
    records = [json.loads(line) for line in lines]
    assert [record.get("accepted") for record in records if record["event"] == "detector_changed"] == [False, True]
    assert "state" in records[-1]
    assert verify(lines) == []
    decision = replay.find(lines, 1)
    assert decision.session.weights_digest == EmbeddedDetector(ADVERSARIAL_WEIGHTS).info.weights_digest
    assert replay.replay(decision, body, EmbeddedDetector(ADVERSARIAL_WEIGHTS)) == []


@pytest.mark.parametrize("allowed", [True, False])
async def test_two_gateways_with_different_weights_decide_each_as_the_log_says(tmp_path, good_frame, allowed):
    shared = {"database_url": f"sqlite:///{tmp_path}/robosac.db", "keep_frames": 9}
    one = serve(**shared, allow_other_weights=allowed)
    other = serve(**shared, allow_other_weights=True, extra_detectors=(str(ADVERSARIAL_WEIGHTS),))
    detectors_of_both = EmbeddedDetector(), EmbeddedDetector(ADVERSARIAL_WEIGHTS)
    own = {detector.info.weights_digest: detector for detector in detectors_of_both}
    async with one as first, other as second:
        session = await first.open(defense={"kind": "sample_consensus"})
        for frame, served in enumerate((first, second, first, second)):
            answer = await served.post(session, "frames", good_frame(frame))
            if allowed or frame != 2:
                assert answer.status_code == 200
            else:
                problem(answer, 503, "detector-unavailable")
                assert await served.ego(session).audit_lines()
        lines = [line.encode() for line in await second.ego(session).audit_lines()]
        assert verify(lines) == []
        for frame in (0, 1, 2, 3) if allowed else (0, 1, 3):
            decision, body = replay.find(lines, frame), await second.ego(session).kept_messages(frame)
            assert replay.replay(decision, body, own[decision.session.weights_digest]) == []


@contextlib.asynccontextmanager
async def two_with_different_weights(tmp_path):
    shared = {"database_url": f"sqlite:///{tmp_path}/robosac.db", "allow_other_weights": True}
    async with serve(**shared) as one, serve(**shared, extra_detectors=(str(ADVERSARIAL_WEIGHTS),)) as other:
        yield one, other


def counted(records):
    return Counter(record["event"] for record in records)


async def test_only_the_ego_takes_a_session_to_other_weights(tmp_path, messages):
    async with two_with_different_weights(tmp_path) as (one, other):
        session = await one.open(defense={"kind": "none"}, gather_ms=20)
        for _ in range(20):
            for served in (one, other):
                await served.post(session, "messages", b"x", session.teammate_tokens["rsu"])
        await other.teammate(session, "car-2").send(0, messages["car-2"])
        assert counted(await one.ego(session).audit()) == {"session_opened": 1, "message_refused": 32}
        assert (await other.ego(session).ask(0, messages["car-1"])).accepted == ("car-2",)
        lines = [line.encode() for line in await other.ego(session).audit_lines()]
        assert counted(map(json.loads, lines[-2:])) == {"detector_changed": 1, "frame_answered": 1}
        assert verify(lines) == []


async def test_refusals_are_not_counted_anew_with_other_weights(tmp_path):
    async with two_with_different_weights(tmp_path) as both:
        session = await both[0].open(defense={"kind": "none"})
        for number in range(40):
            served = both[number % 2]
            await served.ego(session).state()
            await served.post(session, "messages", b"x", session.teammate_tokens["rsu"])
            await served.post(session, "messages", b"x", session.teammate_tokens["rsu"])
        assert counted(await both[0].ego(session).audit())["message_refused"] == 32


async def test_a_session_goes_on_with_no_weights_that_cannot_serve_it(tmp_path, good_frame):
    async with two_with_different_weights(tmp_path) as (one, other):
        session = await one.open(defense={"kind": "group_testing"})
        for _ in range(2):
            problem(await other.post(session, "frames", good_frame(0)), 503, "detector-unavailable")
        await one.ego(session).post_frame_body(good_frame(0))
        records = await one.ego(session).audit()
    assert counted(records) == {"session_opened": 1, "detector_changed": 1, "frame_answered": 1}
    assert next(record["accepted"] for record in records if "accepted" in record) is False


async def test_a_precision_is_served_logged_and_needed_for_replay(good_frame):
    name = "intersection-mean@bfloat16"
    async with serve(extra_detectors=name, keep_frames=9) as served:
        listed = {entry["name"]: entry["precision"] for entry in await served.client.detectors()}
        assert listed == {"intersection-mean": "float32", name: "bfloat16"}
        ego = served.ego(await served.open(detector=name, defense={"kind": "sample_consensus"}))
        await ego.post_frame_body(good_frame(0))
        lines, body = [line.encode() for line in await ego.audit_lines()], await ego.kept_messages(0)
    decision = replay.find(lines, 0)
    assert decision.session.detector == name
    assert replay.replay(decision, body, detectors.load(name)) == []
    (difference,) = replay.replay(decision, body, detectors.load())
    assert difference.what == "detector"
