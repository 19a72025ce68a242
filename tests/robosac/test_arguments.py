"""Mistakes of a caller are told by the argument's name, and not answered as faults."""

import json
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pytest
import torch

import robosac
from robosac.audit import verify
from robosac.budget import DomainError
from robosac.deadline import Deadline
from robosac.defenses import Halving, SampleConsensus, build
from robosac.detectors import Message
from robosac.detectors.v2xsim.voxels import occupancy as v2xsim_occupancy
from robosac.detectors.voxels import occupancy
from tests.robosac.fusing import EGO, TEAM, FakeDetector


def fused(rng, detector=None, defense=None, ego=EGO, teammates=TEAM):
    return robosac.fuse(detector or FakeDetector(), defense or SampleConsensus(), ego, teammates, rng=rng)


def test_fuse_names_what_is_no_argument_of_its(rng):
    for wrong, told in (
        ({"teammates": [EGO]}, "teammates must be a mapping of ids to messages"),
        ({"teammates": None}, "teammates must be a mapping"),
        ({"teammates": {"a": None}}, r"teammates\['a'\] must be a Message, got NoneType"),
        ({"ego": None}, "ego must be a Message, got NoneType"),
        ({"defense": {"kind": "none"}}, "defense must be a defence, and dict lacks"),
    ):
        with pytest.raises(TypeError, match=told):
            fused(rng, **wrong)
    for no_rng in (None, 0):
        with pytest.raises(TypeError, match=r"rng must be a numpy.random.Generator"):
            fused(no_rng)


def test_fuse_names_the_message_and_the_tensor_that_is_not_of_the_layout(detector, ego_message, benign, rng):
    features = ego_message.tensors["features"]
    for tensors, told in (
        ({}, "the tensor 'features' is missing"),
        ({"features": features[:, :16, :16]}, r"the tensor 'features' must be of shape \(64, 32, 32\), got"),
        ({"features": features.transpose(2, 1, 0)}, "the tensor 'features' must be of shape"),
    ):
        wrong = replace(ego_message, tensors=tensors)
        with pytest.raises(ValueError, match=f"^ego: {told}"):
            fused(rng, detector, None, wrong, benign)
        with pytest.raises(ValueError, match=rf"^teammates\['rsu'\]: {told}"):
            fused(rng, detector, None, ego_message, {**benign, "rsu": wrong})
    for pose in (np.eye(3), np.eye(4).ravel()):
        with pytest.raises(ValueError, match=r"^ego: the pose must be of shape \(4, 4\)"):
            fused(rng, detector, None, Message(pose, ego_message.tensors), benign)


@pytest.mark.parametrize("pose", [np.zeros((4, 4)), np.diag([1, 1, 1, np.nan]), np.diag([1.0, 1, -1, 1])])
def test_a_teammate_that_is_nowhere_costs_only_itself(pose, detector, ego_message, benign):
    session = robosac.Session(detector, list(benign), rng=np.random.default_rng(0))
    broken = benign | {"car-2": Message(pose, benign["car-2"].tensors)}
    for frame in range(2):
        result = session.answer(frame, ego_message, broken)
        assert result.fault is None
        assert (result.rejected["car-2"].reason, result.rejected["car-2"].evidence["field"]) == ("malformed", "pose")
        assert set(result.accepted) == set(benign) - {"car-2"}
    with pytest.raises(ValueError, match=r"^ego: the pose must be a rigid transform"):
        session.answer(2, Message(pose, ego_message.tensors), benign)


def test_fuse_names_the_array_that_is_none_or_of_other_things_than_numbers(detector, ego_message, benign, rng):
    features, pose = ego_message.tensors["features"], ego_message.pose
    for wrong, kind, told in (
        (Message(pose.tolist(), ego_message.tensors), TypeError, "the pose must be a numpy array, got list"),
        (Message(pose.astype(str), ego_message.tensors), ValueError, "the pose must be of numbers, got <U"),
        (Message(pose, {"features": torch.tensor(features)}), TypeError, "the tensor 'features' must be a numpy array"),
        (Message(pose, {"features": features.astype(int)}), ValueError, "'features' must be of float16, got int64"),
        (Message(pose, {"features": features.astype("g")}), ValueError, "'features' must be of float16, got float128"),
        (Message(pose, {"features": features.astype(str)}), ValueError, "'features' must be of float16, got <U"),
    ):
        for who, ego, teammates in (
            ("ego", wrong, benign),
            (r"teammates\['rsu'\]", ego_message, {**benign, "rsu": wrong}),
        ):
            with pytest.raises(kind, match=f"^{who}: .*{told}"):
                fused(rng, detector, None, ego, teammates)


def test_a_deadline_is_no_number(rng):
    with pytest.raises(TypeError, match=r"^deadline must be a robosac\.deadline\.Deadline or None, got 0\.2"):
        robosac.fuse(FakeDetector(), SampleConsensus(), EGO, TEAM, rng=rng, deadline=0.2)
    with pytest.raises(TypeError, match=r"^deadline must be"):
        robosac.Session(FakeDetector(), list(TEAM), SampleConsensus()).answer(0, EGO, TEAM, 0.2)


def test_a_message_may_be_frozen_spaced_or_of_wider_numbers(detector, ego_message, benign):
    features = benign["rsu"].tensors["features"]
    frozen = features.copy()
    frozen.flags.writeable = False
    wanted = fused(np.random.default_rng(0), detector, None, ego_message, benign)
    wider = (features.astype(dtype) for dtype in (">f2", ">f4", np.float32, np.float64))
    for array in (frozen, *wider, np.asfortranarray(features)):
        for sender in ("rsu", min(benign)):
            mine = array if sender == "rsu" else benign[sender].tensors["features"].astype(array.dtype)
            said = {**benign, sender: replace(benign[sender], tensors={"features": mine})}
            result = fused(np.random.default_rng(0), detector, None, ego_message, said)
            assert (result.accepted, result.boxes.tolist()) == (wanted.accepted, wanted.boxes.tolist())


def test_a_frame_that_is_no_integer_is_refused_and_spoils_no_later_one(detector, ego_message, benign):
    session = robosac.Session(detector, list(benign), rng=np.random.default_rng(0))
    for wrong in ("0", None, 0.0, [0]):
        with pytest.raises(TypeError, match="frame must be an integer"):
            session.answer(wrong, ego_message, benign)
    for number in np.arange(2):
        assert session.answer(number, ego_message, benign).fault is None
    json.dumps(session.save())


SAVED = {"defense": "sample_consensus", "state": {}, "previous": None}


def test_a_session_names_what_it_cannot_be_made_of():
    for wrong, kind, told in (
        ({"team": None}, TypeError, "team must be a sequence of ids"),
        ({"team": "car-2"}, TypeError, "team must be a sequence of ids, got 'car-2'"),
        ({"team": ["a", "b", "a"]}, ValueError, "team: id 2 is there twice"),
        ({"defense": "none"}, TypeError, "defense must be a defence, not its name, and str lacks"),
        ({"saved": {}}, TypeError, "saved must be what Session.save gave, got {}"),
        ({"saved": "state"}, TypeError, "saved must be what Session.save gave, got 'state'"),
        ({"saved": SAVED | {"previous": 5}}, TypeError, "saved must be what Session.save gave"),
        ({"saved": SAVED | {"previous": {"frame": 1}}}, ValueError, "no previous answer: KeyError: 'boxes'"),
        ({"saved": SAVED | {"defense": "a2cp"}}, ValueError, "saved by a session of the defence a2cp, this one has"),
        ({"rng": 7}, TypeError, r"rng must be a numpy.random.Generator"),
        ({"screening": "none"}, TypeError, "screening must be a Screening"),
    ):
        with pytest.raises(kind, match=told):
            robosac.Session(FakeDetector(), **{"team": ["a", "b"], "defense": SampleConsensus()} | wrong)


def test_a_session_refuses_what_is_no_message_and_goes_on():
    session = robosac.Session(FakeDetector(), list(TEAM), SampleConsensus())
    with pytest.raises(TypeError, match="ego must be a Message"):
        session.answer(0, None, TEAM)
    assert session.answer(0, EGO, TEAM).fault is None


@pytest.mark.parametrize("grid_of", [lambda points: occupancy(points, 1.8), v2xsim_occupancy], ids=["small", "v2xsim"])
def test_points_are_numbers_of_three_columns_and_those_that_are_not_finite_are_none(grid_of):
    points = np.array([[3.0, 4.0, 0.0], [-3.0, 4.0, 0.5]])
    wanted = grid_of(points)
    assert wanted.sum() == 2
    holes = [[np.nan, 1.0, 0.0], [1.0, np.inf, 0.0], [1.0, 1.0, np.nan], [1.0, 1.0, np.inf]]
    for same in (points.tolist(), points.astype(np.float32), np.vstack([points, holes]), np.c_[points, [7.0, 7.0]]):
        assert (grid_of(same) == wanted).all()
    assert grid_of([]).sum() == grid_of(np.zeros((0, 3))).sum() == 0
    for wrong in (points[:, :2], points[0], [["a"] * 3], None):
        with pytest.raises(ValueError, match=r"^points must be numbers of shape \(P, 3\+\)"):
            grid_of(wrong)


def test_a_scan_is_encoded_with_a_pose_of_four_by_four(detector):
    assert detector.encode([], np.eye(4).tolist()).pose.tolist() == np.eye(4).tolist()
    for wrong in (np.eye(3), np.eye(4).ravel(), None):
        with pytest.raises(ValueError, match=r"^pose must be "):
            detector.encode([], wrong)


def test_weights_are_opened_by_a_path_too(detector):
    from robosac.detectors.embedded import SHIPPED_WEIGHTS

    assert robosac.load_detector(SHIPPED_WEIGHTS).info.weights_digest == detector.info.weights_digest


def test_an_attack_names_the_parameter_that_cannot_be():
    for wrong, told in (
        ({"epsilon": "x"}, "epsilon must be a number, got 'x'"),
        ({"epsilon": None}, "epsilon must be a number"),
        ({"epsilon": True}, "epsilon must be a number, got True"),
        ({"steps": True}, "steps must be a whole number, got True"),
        ({"epsilon": float("inf")}, "epsilon must be positive and finite"),
        ({"epsilon": float("nan")}, "epsilon must be positive and finite"),
        ({"steps": 1.5}, r"steps must be a whole number, got 1\.5"),
        ({"steps": 0}, "steps must be positive and finite"),
        ({"step_size": -1}, "step_size must be positive and finite"),
    ):
        with pytest.raises(ValueError, match=f"^{told}"):
            robosac.PGD(**wrong)
    assert robosac.PGD(epsilon=1, steps=np.int64(3)).steps == 3


def test_an_attack_may_have_a_parameter_that_is_no_number():
    @dataclass(frozen=True)
    class Own(robosac.PGD):
        loud: bool = False

    assert Own().loud is False


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("intersection-mean@foo", "intersection-mean@foo: the precision must be one of float32, .*, got 'foo'"),
        ("nowhere/own.safetensors@foo", ".*: the precision must be one of float32, bfloat16, float16, got 'foo'"),
        ("intersection-mean@bfloat16@float16", "intersection-mean@bfloat16@float16 names more than one precision"),
        ("nowhere/@own.safetensors", "there is no file nowhere/@own.safetensors"),
    ],
)
def test_a_precision_that_cannot_be_is_told(name, told):
    with pytest.raises(ValueError, match=f"^{told}$"):
        robosac.load_detector(name)


@pytest.mark.parametrize("precision", ["float64", "foo", None, 16])
def test_a_detector_decodes_in_no_precision_that_is_not_checked(precision, detector):
    told = f"precision must be one of float32, bfloat16, float16, got {precision!r}"
    with pytest.raises(ValueError, match=f"^{told}$"):
        detector.in_precision(precision)


@pytest.mark.parametrize(
    ("wrong", "error", "told"),
    [
        ({"at": float("nan")}, ValueError, "at must be a time or infinite, got nan"),
        ({"at": "soon"}, TypeError, "at must be a number of seconds, got 'soon'"),
        ({"at": None}, TypeError, "at must be a number of seconds, got None"),
        ({"reserve_s": float("nan")}, ValueError, "reserve_s must be at least 0 and finite, got nan"),
        ({"reserve_s": float("inf")}, ValueError, "reserve_s must be at least 0 and finite, got inf"),
        ({"reserve_s": -0.1}, ValueError, "reserve_s must be at least 0 and finite, got -0.1"),
        ({"reserve_s": True}, TypeError, "reserve_s must be a number of seconds, got True"),
        ({"hypotheses": -1}, ValueError, "hypotheses must be at least 0, got -1"),
        ({"hypotheses": 1.5}, TypeError, r"hypotheses must be a whole number or None, got 1\.5"),
        ({"hypotheses": True}, TypeError, "hypotheses must be a whole number or None, got True"),
    ],
)
def test_a_deadline_names_the_argument_that_cannot_be(wrong, error, told):
    with pytest.raises(error, match=f"^{told}$"):
        Deadline(**wrong)


def test_a_scene_names_the_number_that_cannot_be():
    for wrong, told in (
        ({"seed": -1}, "seed must be a non-negative integer, got -1"),
        ({"seed": 1.5}, "seed must be a non-negative integer"),
        ({"seed": "8"}, "seed must be a non-negative integer"),
        ({"seed": 8, "car_agents": 2.5}, "car_agents must be a whole number"),
    ):
        with pytest.raises(ValueError, match=f"^{told}"):
            robosac.IntersectionScene(**wrong).frame(0)
    for index in (1.5, "0"):
        with pytest.raises(ValueError, match=r"^frame index must be an integer"):
            robosac.IntersectionScene(seed=8).frame(index)


def test_a_log_is_read_as_bytes():
    for text in ("{}", ["{}"], b"{}"):
        with pytest.raises(TypeError, match=r"^lines must be an iterable of bytes"):
            verify(text)


def test_settings_of_a_defence_are_a_mapping():
    for wrong in ("none", None, ["kind"]):
        with pytest.raises(DomainError, match=r"^settings must be a mapping with a kind"):
            build(wrong)


class Own(Halving):
    """A defence of the user's, whose first state is of another kind than it should be."""

    kind: Literal["own"] = "own"
    first: Any = None

    def initial_state(self, team):
        return self.first() if callable(self.first) else self.first

    def change_team(self, state, team):
        return self.initial_state(team)


@pytest.mark.parametrize(
    ("first", "why"),
    [
        (None, "own: initial_state must return a dict of JSON values, got a NoneType"),
        ([], "own: initial_state must return a dict of JSON values, got a list"),
        ({"met": {1}}, "own: initial_state must return a dict of JSON values: .*unsupported type: <class 'set'>"),
        (lambda: {}["team"], "own: initial_state: KeyError: 'team'"),
    ],
)
def test_a_session_says_what_is_wrong_with_what_a_defence_remembers_at_first(first, why, rng):
    for begin in (
        lambda: robosac.Session(FakeDetector(), ["a"], Own(first=first)),
        lambda: fused(rng, defense=Own(first=first)),
    ):
        with pytest.raises(DomainError, match=f"^{why}$"):
            begin()
    session = robosac.Session(FakeDetector(), ["a"], Own(first=first), saved={"defense": "own", "state": {}})
    with pytest.raises(DomainError, match=f"^{why.replace('initial_state', 'change_team')}$"):
        session.change_team(["b"])
