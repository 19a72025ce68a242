import json
import os
import shutil

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from robosac.interfaces.ros2 import TOPICS, Ros2
from robosac.recording.content import FORMS
from robosac.recording.reading import RecordingError, read, sessions
from robosac.recording.writing import RecordingFile
from tests.recorded import EGO, opening, write


@pytest.fixture(scope="module")
def some(recorded_moments):
    return recorded_moments[:3]


@pytest.fixture(scope="module")
def whole(detector, some, tmp_path_factory):
    return write(tmp_path_factory.mktemp("recording") / "one.mcap", detector, some)


def test_what_is_written_is_read(whole, some):
    (session,) = sessions(whole)
    assert session.files[0].damage is None
    assert session.without_truth == 0
    for frame, moment in zip(session.frames, some, strict=True):
        assert frame.answer == moment.answer.model_copy(update={"boxes": frame.answer.boxes})
        np.testing.assert_array_equal(frame.answer.boxes, moment.answer.boxes)
        np.testing.assert_array_equal(frame.true_boxes, moment.truth.boxes)
        assert (frame.time_ns, frame.truth.attackers) == (moment.time_ns, ("car-2",))
        assert (frame.decided.seed, frame.decided.fused, frame.decided.team) == (moment.seed, moment.fused, moment.team)
        held = frame.messages()
        assert list(held) == list(moment.messages)
        for name, said in moment.messages.items():
            np.testing.assert_array_equal(held[name].pose, said.message.pose)
            np.testing.assert_array_equal(held[name].tensors["features"], said.message.tensors["features"])


def test_memory_is_written_only_where_it_is_not_what_the_frame_before_left(whole, some, detector, tmp_path):
    (session,) = sessions(whole)
    assert [frame.decided.before is not None for frame in session.frames] == [True, False, False]
    gap = write(tmp_path / "gap.mcap", detector, [some[0], some[2]])
    first, third = sessions(gap)[0].frames
    assert third.decided.before.state == some[2].state
    assert third.decided.before.previous == some[2].previous.as_json()
    assert first.decided.before.previous is None


def test_in_a_folder_what_is_no_file_is_passed_over(whole, tmp_path):
    shutil.copy(whole, tmp_path)
    os.mkfifo(tmp_path / "pipe.mcap")  # of which nobody holds the other end
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "nowhere.mcap").symlink_to("nonesuch.mcap")
    (session,) = sessions(tmp_path)
    assert [file.path.name for file in session.files] == [whole.name]


def test_any_reader_of_mcap_reads_it_with_its_schemas(whole):
    with whole.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = {channel.topic: channel for channel in summary.channels.values()}
        assert topics.keys() == FORMS.keys() | TOPICS.keys()
        for topic, channel in topics.items():
            schema = summary.schemas[channel.schema_id]
            if topic in TOPICS:
                assert (schema.name, schema.encoding, channel.message_encoding) == (TOPICS[topic], "ros2msg", "cdr")
            else:
                assert schema.encoding == "jsonschema"
                assert "properties" in json.loads(schema.data)
        assert summary.statistics.message_count == 1 + 3 * (6 + 4 + 4)
        kinds = {channel.topic for _, channel, _ in reader.iter_messages(starting_at=1001 * 10**9)}
        assert {"/messages", "/answers", "/markers"} <= kinds


@pytest.mark.parametrize("lost", [1, 8, 400, 100_000])
def test_of_a_file_that_breaks_off_all_frames_before_are_good(whole, lost, tmp_path):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(whole.read_bytes()[:-lost])
    file = read(broken)
    assert file.damage
    assert len(file.frames) == (2 if lost == 100_000 else 3)
    assert file.frames[-1].messages().keys() == file.frames[0].messages().keys()


def test_a_file_whose_writer_was_killed_is_good_up_to_its_last_frame(detector, some, tmp_path):
    file = read(write(tmp_path / "killed.mcap", detector, some, close=False))
    assert (len(file.frames), bool(file.damage)) == (3, True)


def test_garbage_in_the_middle_costs_what_comes_after(whole, tmp_path):
    content = bytearray(whole.read_bytes())
    content[len(content) // 2] ^= 0xFF
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(content)
    file = read(broken)
    assert file.damage
    assert 1 <= len(file.frames) < 3
    assert all(frame.messages() for frame in file.frames)


def test_digests_may_stand_in_the_place_of_messages(detector, some, tmp_path):
    path = write(tmp_path / "digests.mcap", detector, some, bodies=False)
    (session,) = sessions(path)
    assert path.stat().st_size < 200_000
    assert session.files[0].counts["/digests"] == 18
    with pytest.raises(RecordingError, match="digests in the place of messages"):
        session.frames[0].messages()


def test_the_files_of_a_session_are_one_recording(detector, some, tmp_path):
    write(tmp_path / "b.mcap", detector, some[:2])
    write(tmp_path / "a.mcap", detector, some[2:], part=2)
    write(tmp_path / "c.mcap", detector, some[:1], session_id="ab" * 16)
    (tmp_path / "of somebody else.mcap").write_text("no recording at all")
    first, other = sorted(sessions(tmp_path), key=lambda session: -len(session.frames))
    assert [frame.number for frame in first.frames] == [0, 1, 2]
    assert [file.path.name for file in first.files] == ["b.mcap", "a.mcap"]
    assert (len(other.frames), other.opening.ego_id) == (1, EGO)


def test_the_frames_of_a_session_that_came_back_are_in_order(detector, recorded_moments, tmp_path):
    write(tmp_path / "here.mcap", detector, recorded_moments[0:6:2])
    write(tmp_path / "there.mcap", detector, recorded_moments[1:6:2])
    (session,) = sessions(tmp_path)
    assert [frame.number for frame in session.frames] == [0, 1, 2, 3, 4, 5]
    assert [file.path.name for file in session.files] == ["here.mcap", "there.mcap"]


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "text.mcap").write_text("no recording at all")
    with pytest.raises(RecordingError, match="is no MCAP file"):
        sessions(tmp_path / "text.mcap")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="holds no recording"):
        sessions(tmp_path / "empty")
    for name, format_, match in (("other.mcap", None, "no recording of a session"), ("later.mcap", "9", "format '9'")):
        with (tmp_path / name).open("wb") as file:
            writer = Writer(file)
            writer.start()
            if format_ is not None:
                writer.add_metadata("robosac", {"format": format_})
            writer.finish()
        with pytest.raises(RecordingError, match=match):
            sessions(tmp_path / name)


@pytest.mark.parametrize(
    ("topic", "told", "match"),
    [
        ("/session", {}, "on /session is not of this form: session_id"),
        ("/poses", {"frame": 0, "poses": {EGO: [1.0, 2.0]}}, "on /poses is not of this form: poses.car-1"),
        ("/truth", {"frame": 0, "boxes": [[1.0, 2.0]], "attackers": []}, "on /truth is not of this form: boxes.0"),
        ("/answers", {"frame": "x"}, "on /answers is not of this form: frame"),
    ],
)
def test_content_of_another_form_is_told_with_its_field(topic, told, match, whole, tmp_path):
    first = read(whole).opening.as_json()
    with (tmp_path / "odd.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name, content in {"/session": first, topic: told}.items():
            channel = writer.register_channel(name, "json", writer.register_schema("", "", b""))
            writer.add_message(channel, 1, json.dumps(content).encode(), 1)
        writer.finish()
    with pytest.raises(RecordingError, match=match):
        read(tmp_path / "odd.mcap")


def test_a_file_that_could_not_be_begun_is_not_left_behind(detector, some, tmp_path):
    class Broken(Ros2):
        def schema(self, name):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        RecordingFile(tmp_path / "x.mcap", opening(detector, some[0].team), 0, Broken())
    assert not list(tmp_path.iterdir())
