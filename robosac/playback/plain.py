"""Recordings without what only this project reads: perceived objects as JSON Lines, and messages of ROS 2 alone."""

from __future__ import annotations

import json
from pathlib import Path

from robosac.extras import need
from robosac.files import replacing
from robosac.interfaces.cpm import collective_perception
from robosac.interfaces.ros2 import TOPICS, Ros2, SeenFrame
from robosac.recording.reading import RecordedSession


def write_cpm(session: RecordedSession, path: Path) -> None:
    """Write each answer's boxes as `robosac.interfaces.cpm` has them, an answer a line."""
    ego_id = session.opening.ego_id
    with replacing(path) as beside, beside.open("w") as file:
        for frame in session.frames:
            told = collective_perception(frame.answer, frame.poses[ego_id], frame.time_ns / 1e9)
            file.write(json.dumps({"frame": frame.number, **told}, separators=(",", ":")) + "\n")


def write_ros2(session: RecordedSession, path: Path) -> None:
    """Write an MCAP file of the profile ``ros2``, as rosbag2 wants it, with nothing but messages of ROS 2.

    Raises
    ------
    MissingExtra
    """
    need("mcap", "recordings")
    from mcap.writer import Writer  # noqa: PLC0415 (of an extra)

    ros2, ego_id = Ros2(), session.opening.ego_id
    with replacing(path) as beside, beside.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="robosac")
        channels = {}
        for topic, name in TOPICS.items():
            schema = writer.register_schema(name, "ros2msg", ros2.schema(name).encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for frame in session.frames:
            score = session.opening.least_score
            seen = SeenFrame(frame.time_ns, ego_id, frame.poses, frame.answer, frame.true_boxes, score)
            for topic, data in ros2.messages(seen).items():
                writer.add_message(channels[topic], frame.time_ns, data, frame.time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
