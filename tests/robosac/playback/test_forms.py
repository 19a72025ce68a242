import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from mcap.reader import make_reader
from PIL import Image

from robosac.boxes import pose_matrix
from robosac.interfaces.ros2 import TOPICS
from robosac.playback.plain import write_cpm, write_ros2
from robosac.playback.views import write_moving, write_pictures
from robosac.recording.reading import sessions
from tests.recorded import write


@pytest.fixture(scope="module")
def session(detector, recorded_moments, tmp_path_factory):
    some = recorded_moments[:2]
    (session,) = sessions(write(tmp_path_factory.mktemp("recording") / "one.mcap", detector, some))
    return session


def test_rerun_reads_what_is_written_for_it(session, tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    from robosac.playback.rerun_file import write_rerun

    path = tmp_path / "one.rrd"
    write_rerun(session, path)
    reader = chunk.RrdReader(path)
    (recording,) = reader.recordings()
    assert (recording.application_id, recording.recording_id) == ("robosac", session.opening.session_id)
    rows = {}
    for part in reader.stream():
        rows[part.entity_path] = rows.get(part.entity_path, 0) + part.num_rows
    assert {"/world/boxes", "/world/truth", "/world/vehicles/car-1", "/suspicion/car-2", "/decision"} <= rows.keys()
    assert rows["/world/boxes"] == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_told_and_not_waited_for(session):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from robosac.playback.rerun_file import write_rerun

    with pytest.raises(OSError, match="No space left"):
        write_rerun(session, Path("/dev/full"))


def test_far_from_the_origin_rerun_keeps_its_precision(session, tmp_path):
    """As in UTM; single precision would move everything by up to 25 cm."""
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    from robosac.playback.rerun_file import write_rerun

    def moved(frame):
        poses = {name: pose_matrix(500_000.0, 5_400_000.0, 0.0, 0.0) @ pose for name, pose in frame.poses.items()}
        return replace(frame, poses=poses)

    def places(session, path):
        write_rerun(session, path)
        parts = {part.entity_path: part for part in chunk.RrdReader(path).stream() if "vehicles" in part.entity_path}
        batch = parts["/world/vehicles/car-1"].to_record_batch()
        return np.array(batch.column("Transform3D:translation").to_pylist()).reshape(-1, 3)

    near = places(session, tmp_path / "near.rrd")
    far = places(replace(session, frames=[moved(frame) for frame in session.frames]), tmp_path / "far.rrd")
    np.testing.assert_allclose(far, near, atol=1e-4)


def test_rerun_reads_the_recording_itself(session):
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    paths = {part.entity_path for part in chunk.McapReader(session.files[0].path).stream()}
    assert any("tf" in path for path in paths)


def test_ros2_alone(session, tmp_path):
    write_ros2(session, tmp_path / "ros.mcap")
    with (tmp_path / "ros.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
    assert sorted(topics) == sorted([*TOPICS, *TOPICS])


def test_perceived_objects_are_a_line_a_frame(session, tmp_path):
    write_cpm(session, tmp_path / "out.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == [0, 1]
    for line, frame in zip(lines, session.frames, strict=True):
        assert line["perceivedObjectContainer"]["numberOfPerceivedObjects"] == len(frame.answer.boxes)


def test_a_picture_a_frame(session, tmp_path):
    drawn = []
    write_pictures(session, tmp_path, 0.3, lambda: drawn.append(1))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000.png", "000001.png"]
    assert imread(tmp_path / "000001.png").std() > 0.01
    assert len(drawn) == 2


def test_a_moving_picture(session, tmp_path):
    write_moving(session, tmp_path / "one.gif", 0.3, lambda: None)
    with Image.open(tmp_path / "one.gif") as picture:
        assert picture.n_frames == 2


def test_without_ffmpeg_a_video_is_refused(session, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match="ffmpeg is not installed"):
        write_moving(session, tmp_path / "one.mp4", 0.3, lambda: None)
