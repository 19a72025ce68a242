"""Frames as messages of ROS 2, without ROS: what Foxglove, RViz and rosbag2 read.

The layouts are those of ROS 2 Humble as `rosbags` ships them, and of vision_msgs 4. A box has no height of its own: it
is given one that can be seen, around the plane of the sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import cos, sin
from typing import TYPE_CHECKING, Any

import numpy as np

from robosac.answers import FrameAnswer, Standing
from robosac.boxes import FloatArray
from robosac.extras import need

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

WORLD = "map"
"""Name of the world's frame; each vehicle's frame has its id."""
HEIGHT_M = 1.6
TOPICS: Mapping[str, str] = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/ego_pose": "geometry_msgs/msg/PoseStamped",
    "/detections": "vision_msgs/msg/Detection3DArray",
    "/markers": "visualization_msgs/msg/MarkerArray",
}
"""By topic: the type of its messages."""
_VISION: Mapping[str, str] = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
_CUBE, _ARROW, _DELETE_ALL = 1, 0, 3
_GREY, _TRUE = (0.6, 0.6, 0.6), (0.0, 0.62, 0.45)
_COLOURS: Mapping[Standing | None, tuple[float, float, float]] = {
    None: (0.0, 0.45, 0.7),
    Standing.CONFIRMED: (0.0, 0.45, 0.7),
    Standing.SINGLE_WITNESS: (0.9, 0.62, 0.0),
    Standing.DISPUTED: (0.8, 0.47, 0.65),
    Standing.REPAIRED: (0.34, 0.71, 0.91),
    Standing.CONTRADICTED: (0.84, 0.37, 0.0),
}
"""Of the palette by Okabe and Ito, as the pictures have them."""


@dataclass(frozen=True)
class SeenFrame:
    """What is told of a frame."""

    time_ns: int
    """When it was answered, Unix nanoseconds."""
    ego_id: str
    poses: Mapping[str, FloatArray]
    """By vehicle: world_from_sensor (4, 4), the ego's among them."""
    answer: FrameAnswer
    truth: FloatArray | None = None
    """True boxes (G, 5), where they are known; ego frame."""
    least_score: float = 0.0
    """From which on answered boxes are drawn; detections are all."""


class Ros2:
    """Makes messages of frames.

    Raises
    ------
    MissingExtra
        If rosbags is not installed.
    """

    def __init__(self) -> None:
        need("rosbags", "recordings")

    @cached_property
    def _store(self) -> Typestore:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 (of an extra)

        store = get_typestore(Stores.ROS2_HUMBLE)
        for name, text in _VISION.items():
            store.register(get_types_from_msg(text, name))
        return store

    def schema(self, name: str) -> str:
        """The definition of a type with all that it is made of, as MCAP wants it for ``ros2msg``."""
        return str(self._store.generate_msgdef(name, ros_version=2)[0])

    def messages(self, frame: SeenFrame) -> dict[str, bytes]:
        """By topic of `TOPICS`: the frame's message, in CDR."""
        turns = quaternions(list(frame.poses.values()))
        turned = {
            name: self._make("geometry_msgs/Quaternion", *turn) for name, turn in zip(frame.poses, turns, strict=True)
        }
        place = self._make("geometry_msgs/Point", *map(float, frame.poses[frame.ego_id][:3, 3]))
        pose = self._make("geometry_msgs/Pose", place, turned[frame.ego_id])
        made = {
            "/tf": self._transforms(frame, turned),
            "/ego_pose": self._make("geometry_msgs/PoseStamped", self._header(frame, WORLD), pose),
            "/detections": self._detections(frame),
            "/markers": self._markers(frame),
        }
        return {topic: bytes(self._store.serialize_cdr(made[topic], name)) for topic, name in TOPICS.items()}

    def read(self, topic: str, data: bytes) -> Any:
        """A message of a topic, from CDR."""
        return self._store.deserialize_cdr(data, TOPICS[topic])

    @cached_property
    def _types(self) -> dict[str, Any]:
        return {name.replace("/msg/", "/"): kind for name, kind in self._store.types.items()}

    @cached_property
    def _upright(self) -> Any:
        return self._make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)

    @cached_property
    def _for_ever(self) -> Any:
        return self._make("builtin_interfaces/Duration", 0, 0)

    @cached_property
    def _nothing(self) -> tuple[Any, Any]:
        """No texture and no mesh."""
        header = self._make("std_msgs/Header", self._time(0), "")
        texture = self._make("sensor_msgs/CompressedImage", header, "", np.zeros(0, dtype=np.uint8))
        return texture, self._make("visualization_msgs/MeshFile", "", np.zeros(0, dtype=np.uint8))

    def _make(self, name: str, *fields: Any) -> Any:
        return self._types[name](*fields)

    def _header(self, frame: SeenFrame, frame_id: str) -> Any:
        return self._make("std_msgs/Header", self._time(frame.time_ns), frame_id)

    def _time(self, time_ns: int) -> Any:
        return self._make("builtin_interfaces/Time", *divmod(time_ns, 10**9))

    def _flat(self, x: float, y: float, yaw: float) -> Any:
        half = yaw / 2
        turned = self._make("geometry_msgs/Quaternion", 0.0, 0.0, sin(half), cos(half)) if yaw else self._upright
        return self._make("geometry_msgs/Pose", self._make("geometry_msgs/Point", x, y, 0.0), turned)

    def _transforms(self, frame: SeenFrame, turned: Mapping[str, Any]) -> Any:
        header = self._header(frame, WORLD)
        transforms = []
        for name, matrix in frame.poses.items():
            place = self._make("geometry_msgs/Vector3", *map(float, matrix[:3, 3]))
            moved = self._make("geometry_msgs/Transform", place, turned[name])
            transforms.append(self._make("geometry_msgs/TransformStamped", header, name, moved))
        return self._make("tf2_msgs/TFMessage", transforms)

    def _detections(self, frame: SeenFrame) -> Any:
        header, unknown = self._header(frame, frame.ego_id), np.zeros(36)
        found = []
        for number, (x, y, length, width, yaw, score) in enumerate(frame.answer.boxes.tolist()):
            pose, size = self._flat(x, y, yaw), self._make("geometry_msgs/Vector3", length, width, HEIGHT_M)
            kind = self._make("vision_msgs/ObjectHypothesis", "vehicle", score)
            placed = self._make("geometry_msgs/PoseWithCovariance", pose, unknown)
            result = self._make("vision_msgs/ObjectHypothesisWithPose", kind, placed)
            box = self._make("vision_msgs/BoundingBox3D", pose, size)
            found.append(self._make("vision_msgs/Detection3D", header, [result], box, str(number)))
        return self._make("vision_msgs/Detection3DArray", header, found)

    def _markers(self, frame: SeenFrame) -> Any:
        """Certain boxes by how they stand, contradicted and true ones, and an arrow for each vehicle.

        The first marker takes all earlier ones away.
        """
        answer, header = frame.answer, self._header(frame, frame.ego_id)
        standings = [None] * len(answer.boxes) if answer.support is None else [each.status for each in answer.support]
        boxes = [
            ("boxes", box, _COLOURS[how], 0.75)
            for box, how in zip(answer.boxes.tolist(), standings, strict=True)
            if box[5] >= frame.least_score
        ]
        red = _COLOURS[Standing.CONTRADICTED]
        boxes += [("contradicted", list(out.box), red, 0.35) for out in answer.contradicted or ()]
        boxes += [("truth", box, _TRUE, 0.25) for box in ([] if frame.truth is None else frame.truth.tolist())]
        markers = [self._marker(header, "", 0, _CUBE, self._flat(0, 0, 0), (1, 1, 1), (*_GREY, 0.0), _DELETE_ALL)]
        for number, (what, (x, y, length, width, yaw, *_), colour, alpha) in enumerate(boxes):
            pose, size = self._flat(x, y, yaw), (length, width, HEIGHT_M)
            markers.append(self._marker(header, what, number, _CUBE, pose, size, (*colour, alpha)))
        for number, name in enumerate(frame.poses):
            own = self._header(frame, name)
            taken = name == frame.ego_id or name in answer.accepted
            shade = (*(_COLOURS[None] if taken else red), 1.0)
            arrow = self._marker(own, "vehicles", number, _ARROW, self._flat(0, 0, 0), (3.0, 0.6, 0.6), shade)
            markers.append(arrow)
        return self._make("visualization_msgs/MarkerArray", markers)

    def _marker(
        self,
        header: Any,
        what: str,
        number: int,
        kind: int,
        pose: Any,
        size: tuple[float, float, float],
        colour: tuple[float, float, float, float],
        action: int = 0,
    ) -> Any:
        texture, mesh = self._nothing
        return self._make(
            "visualization_msgs/Marker", header, what, number, kind, action, pose,
            self._make("geometry_msgs/Vector3", *size), self._make("std_msgs/ColorRGBA", *colour),
            self._for_ever, False, [], [], "", texture, [], "", "", mesh, False,
        )  # fmt: skip


def quaternions(poses: Sequence[FloatArray]) -> list[list[float]]:
    """x, y, z, w of the rotation of each pose (4, 4)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (a second to import)

    turns: list[list[float]] = Rotation.from_matrix(np.array(poses)[:, :3, :3]).as_quat().tolist()
    return turns
