import calendar
import json

import numpy as np
import pytest

from robosac.answers import FrameAnswer
from robosac.boxes import pose_matrix
from robosac.interfaces.cpm import collective_perception, timestamp_its


def answer(boxes):
    return FrameAnswer(
        frame=3, boxes=np.array(boxes, dtype=float).reshape(-1, 6), source="consensus", accepted=(), rejected=[],
        hypotheses=[], sampling_steps=0, attacker_ratio=None, deadline_met=True, degraded_by=None, timings_ms={},
    )  # fmt: skip


def perceived(boxes, pose=None):
    told = collective_perception(answer(boxes), np.eye(4) if pose is None else pose, 1.8e9)
    json.dumps(told, allow_nan=False)
    return told["perceivedObjectContainer"]


def test_units_are_those_of_the_standard():
    (one,) = perceived([[12.34, -5.671, 4.52, 1.9, np.radians(30), 0.8]])["perceivedObjects"]
    assert one["position"]["xCoordinate"]["value"] == 1234
    assert one["position"]["yCoordinate"]["value"] == -567  # the upper one of -568 and -567
    assert one["angles"]["zAngle"]["value"] == 300
    assert (one["objectDimensionX"]["value"], one["objectDimensionY"]["value"]) == (46, 19)
    assert one["objectPerceptionQuality"] == 12
    assert one["classification"] == [{"objectClass": {"vehicleSubClass": 5}, "confidence": 80}]


def test_places_are_from_the_ego_along_the_axes_of_the_world():
    pose = pose_matrix(100.0, 50.0, 1.9, np.pi / 2)
    (one,) = perceived([[10.0, 0.0, 4.0, 2.0, 0.0, 1.0]], pose)["perceivedObjects"]
    assert [one["position"][axis]["value"] for axis in ("xCoordinate", "yCoordinate")] == [0, 1000]
    assert one["angles"]["zAngle"]["value"] == 900


@pytest.mark.parametrize(("yaw_deg", "value"), [(-0.04, 0), (359.99, 0), (-90, 2700), (0, 0), (180, 1800), (0.01, 1)])
def test_angles_stay_below_a_whole_turn(yaw_deg, value):
    (one,) = perceived([[1, 1, 4, 2, np.radians(yaw_deg), 0.5]])["perceivedObjects"]
    assert one["angles"]["zAngle"]["value"] == value


def test_what_does_not_fit_has_the_last_value_that_does():
    (one,) = perceived([[-5000, 5000, 99, 0.0, 0, 1.5]])["perceivedObjects"]
    assert [one["position"][axis]["value"] for axis in ("xCoordinate", "yCoordinate")] == [-131072, 131071]
    assert (one["objectDimensionX"]["value"], one["objectDimensionY"]["value"]) == (255, 1)
    assert one["objectPerceptionQuality"] == 15


def test_of_many_boxes_the_best_are_told():
    container = perceived([[1, 1, 4, 2, 0, 0.5]] * 300)
    assert container["numberOfPerceivedObjects"] == 300
    assert [one["objectId"] for one in container["perceivedObjects"]] == list(range(255))
    assert perceived([])["perceivedObjects"] == []


def test_time_counts_from_2004_with_leap_seconds():
    assert timestamp_its(calendar.timegm((2004, 1, 1, 0, 0, 0)) - 5) == 0
    assert timestamp_its(calendar.timegm((2017, 1, 1, 0, 0, 0))) == 410_313_605_000
