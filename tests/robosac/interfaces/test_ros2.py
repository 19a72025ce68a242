from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import ContradictedBox, FrameAnswer, Support
from robosac.boxes import pose_matrix
from robosac.interfaces.opv2v import x_to_world
from robosac.interfaces.ros2 import TOPICS, Ros2, SeenFrame, quaternions

BOXES = np.array([[5.0, 1.0, 4.0, 2.0, 0.3, 0.9], [8.0, -2.0, 4.5, 1.8, 0.0, 0.7]])
OUT = ContradictedBox(
    status="contradicted", witnesses=("car-3",), deniers=("car-1",), box=(9.0, 9.0, 4.0, 2.0, 0.0, 0.6)
)
STANDING = (
    Support(status="confirmed", witnesses=("car-1",), deniers=()),
    Support(status="disputed", witnesses=("car-2",), deniers=("rsu",)),
)


@pytest.fixture(scope="module")
def ros2():
    return Ros2()


@pytest.fixture(scope="module")
def seen():
    answer = FrameAnswer(
        frame=1, boxes=BOXES, support=STANDING, contradicted=(OUT,), source="consensus", accepted=("car-2",),
        rejected=[{"vehicle_id": "car-3", "reason": "dissensus"}], hypotheses=[], sampling_steps=1, attacker_ratio=None,
        deadline_met=True, degraded_by=None, timings_ms={},
    )  # fmt: skip
    poses = {"car-1": pose_matrix(1, 2, 1.9, 0.5), "car-2": pose_matrix(4, 5, 1.9, 0), "car-3": pose_matrix(7, 8, 2, 3)}
    return SeenFrame(1_700_000_000_123_456_789, "car-1", poses, answer, np.array([[5.0, 1.0, 4.0, 2.0, 0.3]]))


def test_what_is_written_can_be_read(ros2, seen):
    read = {topic: ros2.read(topic, data) for topic, data in ros2.messages(seen).items()}
    assert read.keys() == TOPICS.keys()
    transforms = {each.child_frame_id: each for each in read["/tf"].transforms}
    assert transforms.keys() == seen.poses.keys()
    stamp = transforms["car-1"].header.stamp
    assert (stamp.sec, stamp.nanosec, transforms["car-1"].header.frame_id) == (1_700_000_000, 123_456_789, "map")
    moved = transforms["car-2"].transform.translation
    assert (moved.x, moved.y, moved.z) == (4.0, 5.0, 1.9)
    assert read["/ego_pose"].pose.position.x == 1.0
    detections = read["/detections"]
    assert detections.header.frame_id == "car-1"
    for found, (x, y, length, width, _, score) in zip(detections.detections, BOXES, strict=True):
        assert (found.bbox.center.position.x, found.bbox.center.position.y) == (x, y)
        assert (found.bbox.size.x, found.bbox.size.y) == (length, width)
        assert found.results[0].hypothesis.score == score
    assert detections.detections[0].bbox.center.orientation.z == pytest.approx(np.sin(0.15))


def test_markers_tell_how_boxes_stand_and_whom_the_answer_holds(ros2, seen):
    first, *markers = ros2.read("/markers", ros2.messages(seen)["/markers"]).markers
    assert first.action == 3  # takes all earlier ones away
    assert [marker.ns for marker in markers] == ["boxes"] * 2 + ["contradicted", "truth"] + ["vehicles"] * 3
    colours = [(marker.color.r, marker.color.g, marker.color.b) for marker in markers]
    assert len(set(colours[:4])) == 4  # confirmed, disputed, contradicted, true
    assert colours[4] == colours[5] != colours[6]  # car-3 was left out
    assert [marker.header.frame_id for marker in markers[4:]] == list(seen.poses)
    assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)


def test_boxes_that_are_not_certain_are_not_drawn(ros2, seen):
    told = ros2.messages(replace(seen, least_score=0.8))
    drawn = [
        marker.pose.position.x for marker in ros2.read("/markers", told["/markers"]).markers if marker.ns == "boxes"
    ]
    assert drawn == [5.0]
    assert len(ros2.read("/detections", told["/detections"]).detections) == 2


def test_schemas_hold_all_that_a_reader_needs(ros2):
    text = ros2.schema("vision_msgs/msg/Detection3DArray")
    for part in ("vision_msgs/Detection3D", "geometry_msgs/Quaternion", "builtin_interfaces/Time"):
        assert f"MSG: {part}\n" in text


def test_a_turn_is_told_as_a_quaternion():
    (x, y, z, w), level = quaternions([x_to_world([0, 0, 0, 0, 60, 0]), np.eye(4)])
    assert (x, y) == pytest.approx((0, 0))
    assert (z, w) == pytest.approx((0.5, np.sqrt(0.75)))
    assert level == pytest.approx([0, 0, 0, 1])
