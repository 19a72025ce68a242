import asyncio
import dataclasses
import io
import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import msgpack
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rich.console import Console
from typer.testing import CliRunner

from clients.fleet import FleetOptions, run_fleet
from clients.local_gateway import GatewayProcess
from clients.playing import play_against
from clients.record import SUFFIXES, app
from robosac import cli
from robosac.recording.reading import RecordingError, sessions
from robosac.recording.truth import Truth
from tests.recorded import write


@pytest.fixture(scope="module")
def path(detector, recorded_moments, tmp_path_factory):
    return write(tmp_path_factory.mktemp("recording") / "one.mcap", detector, recorded_moments[:3])


def run(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, " ".join(result.output.replace("│", " ").split())


async def test_a_fleet_is_recorded_by_a_gateway_that_is_killed_and_played_again(tmp_path):
    recordings = tmp_path / "recordings"
    settings = {"ROBOSAC_RECORD": str(recordings), "ROBOSAC_LATENCY_BUDGET_MS": "5000"}
    process = GatewayProcess(tmp_path / "log", f"sqlite:///{tmp_path}/db", settings=settings)
    try:
        await process.ready()
        options = FleetOptions(process.url, scenes=1, frames=2, attack="noise", truth=True)
        summary = await run_fleet(options, Console(file=io.StringIO()))
        await recorded(recordings, [2])
        (fleet,) = sessions(recordings)
        told = await play_against(process.url, fleet)
        assert "2 frames" in told
        await recorded(recordings, [2, 2])
    finally:
        await process.kill()
    first, second = sessions(recordings)
    assert len(summary.attacked_from) == 1
    attackers = {name for _, _, name in summary.attacked_from}
    assert {frame.truth.attackers for frame in first.frames + second.frames} == {tuple(attackers)}
    status, said = await asyncio.to_thread(run, "replay", recordings)
    assert status == 0, said
    assert said.count("2 of 2 answers are the same") == 2


async def recorded(folder, frames):
    async with asyncio.timeout(30):
        while not list(folder.iterdir()) or [len(session.frames) for session in sessions(folder)] != frames:
            await asyncio.sleep(0.05)


def test_info_tells_what_is_in_it(path, tmp_path):
    status, said = run("info", path)
    assert status == 0, said
    for part in ("car-1", "car-2, car-3, car-4, car-5, rsu", "group_testing", "of 3 frames", "/messages 18", "whole"):
        assert part in said
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(path.read_bytes()[:-2000])
    status, said = run("info", broken)
    assert status == 1
    assert "what is before that is good" in said


def test_what_a_foreign_recording_says_is_no_markup_and_no_terminal_obeys_it(detector, recorded_moments, tmp_path):
    name = "[/x]:smile:\x1b[2J"
    (moment,) = recorded_moments[:1]
    lying = dataclasses.replace(moment, truth=Truth(moment.truth.boxes, (name,)))
    foreign = {"created_at": name, "defense": {"kind": name}, "session_id": name}
    path = write(tmp_path / "foreign.mcap", detector, [lying], **foreign)
    status, said = run("info", path)
    assert status == 0, said
    assert said.count(r"[/x]:smile:\x1b[2J") == 4
    path = write(tmp_path / "kind.mcap", detector, [lying], defense={"kind": name})
    out = tmp_path / "out.jsonl"
    for words in (
        ("replay", path),
        ("replay", path, "--defense", "none"),
        ("export", path, "--to", "cpm", "--out", out),
    ):
        assert "\x1b" not in run(*words)[1]


def test_info_gives_the_name_of_a_file_whole_on_a_narrow_screen(path, tmp_path):
    file = tmp_path / f"20261122T131204Z-{'0123456789abcdef' * 5}-0001.mcap"
    file.write_bytes(path.read_bytes())
    assert f"{file.name}: {file.stat().st_size} bytes, 3 frames, whole" in run("info", file)[1]


def test_a_file_that_is_not_whole_is_told_by_replay_and_export(path, tmp_path):
    broken, empty = tmp_path / "broken.mcap", tmp_path / "empty.mcap"
    broken.write_bytes(path.read_bytes()[:-2000])
    empty.write_bytes(path.read_bytes()[:50_000])
    for words in (("replay",), ("export", "--to", "cpm", "--out", tmp_path / "out.jsonl")):
        status, said = run(*words, broken)
        assert status == 0, said
        assert "it ends in the middle (EndOfFile); what is before that is good" in said
        status, said = run(*words, empty, *(["--force"] if len(words) > 1 else []))
        assert status == 1
        assert "Error:" in said
        assert "empty.mcap has no frames" in said
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 3


def test_replay_ends_with_1_only_if_the_recorded_defence_differs(path, detector, recorded_moments, tmp_path):
    assert run("replay", path)[0] == 0
    status, said = run("replay", path, "--defense", "none")
    assert status == 0, said
    assert "a recorded attacker in 3 of 3 answers" in said
    other = write(tmp_path / "other.mcap", detector, recorded_moments[:1], defense={"kind": "none"})
    status, said = run("replay", other)
    assert status == 1
    assert "0 of 1 answers are the same frame 0 differs in" in said


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("replay", "none.mcap"), "No such file"),
        (("replay", "{path}", "--defense", "nonesuch"), "Invalid value for --defense"),
        (("replay", "{path}", "--detector", "nonesuch"), "Invalid value for --detector"),
        (("replay", "{path}", "--url", "http://127.0.0.1:9", "--detector", "x"), "the gateway has its own"),
        (("export", "{path}", "--to", "video", "--out", "{folder}/x.avi"), "ends with .gif or .mp4, not with .avi"),
        (("export", "{path}", "--to", "video", "--out", "{folder}/x.mp4"), "ffmpeg is not installed"),
        (("export", "{path}", "--to", "cpm", "--out", "{folder}/there.jsonl"), "is there already; --force"),
        (("export", "{path}", "--to", "ros2", "--out", "{path}", "--force"), "is what is to be read"),
        (("export", "{path}", "--to", "ros2", "--out", "{folder}/link.mcap", "--force"), "is what is to be read"),
        (("export", "{path.parent}", "--to", "ros2", "--out", "{path}", "--force"), "is what is to be read"),
        (("export", "{path}", "--to", "rerun", "--out", "{folder}/x.mcap"), "has to end in .rrd"),
        (("export", "{path}", "--to", "cpm", "--out", "{folder}/x"), "has to end in .jsonl"),
        (("export", "{path}", "--to", "ros2", "--out", "{folder}/x.bag"), "has to end in .mcap"),
        (
            ("export", "{path}", "--to", "cpm", "--out", "{folder}/x.jsonl", "--session", "nonesuch"),
            "must choose one of 5e5e5e5e",
        ),
    ],
)
def test_what_cannot_be_done_is_said_before_it_is_begun(words, why, path, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))  # no ffmpeg
    (tmp_path / "there.jsonl").touch()
    (tmp_path / "link.mcap").symlink_to(path)
    before = path.read_bytes()
    status, said = run(*(word.format(path=path, folder=tmp_path) for word in words))
    assert status == 2
    assert why in said
    assert path.read_bytes() == before


def test_a_copy_beside_a_recording_is_no_second_time(path, detector, recorded_moments, tmp_path):
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(path.read_bytes())
    (session,) = sessions(tmp_path)
    assert [frame.number for frame in session.frames] == [0, 1, 2]
    rewrite(path, tmp_path / "b.mcap", {"deadline_met": False})
    with pytest.raises(RecordingError, match=r"frame 0 is recorded twice, and not as the same, in .*a.mcap and .*b"):
        sessions(tmp_path)


@pytest.mark.parametrize(("form", "package"), [("pictures", "matplotlib"), ("ros2", "rosbags"), ("rerun", "rerun")])
def test_a_form_that_needs_an_extra_is_refused_before_any_work(form, package, path, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    out = tmp_path / f"out{SUFFIXES.get(form, '')}"
    words = ["record", "export", path, "--to", form, "--out", out]
    result = CliRunner().invoke(cli.app, list(map(str, words)))
    assert result.exit_code == 2
    assert result.output.startswith(f"Error: {package} is not installed, for ")
    assert "frames" not in result.output
    assert not out.exists()


def test_a_defence_that_does_not_ship_has_to_be_named(detector, recorded_moments, tmp_path):
    path = write(tmp_path / "own.mcap", detector, recorded_moments[:1], defense={"kind": "of_my_own"})
    status, said = run("replay", path)
    assert status == 2
    assert "for --recorded-defense: the defence of session " in said
    assert ", of_my_own, does not ship: say where it is" in said


def test_all_sessions_of_a_folder_can_be_replayed_or_none_is(detector, recorded_moments, tmp_path):
    write(tmp_path / "a.mcap", detector, recorded_moments[:1])
    other = replace(detector.info, name="another")
    write(tmp_path / "b.mcap", SimpleNamespace(info=other), recorded_moments[:1], session_id="6f" * 16)
    status, said = run("replay", tmp_path)
    assert status == 2
    assert "for --detector: the detector of session " in said
    assert ", 'another', does not ship; give it" in said
    assert " on " not in said.partition("Error")[0]


def test_a_recording_of_digests_cannot_be_replayed(detector, recorded_moments, tmp_path):
    path = write(tmp_path / "digests.mcap", detector, recorded_moments[:1], bodies=False)
    status, said = run("replay", path)
    assert status == 2
    assert "for FILE" in said
    assert "holds digests in the place of messages" in said


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"frame_period_ms": 0.0}, "/session is not of this form: frame_period_ms"),
        ({"frame_period_ms": float("inf")}, "/session is not of this form: frame_period_ms"),
        ({"defense": {"kind": ["a"]}}, "/session is not of this form: defense"),
        ({"defense": {}}, "/session is not of this form: defense"),
        ({"seed": "zz"}, "/frames is not of this form: seed"),
        ({"seed": "-1"}, "/frames is not of this form: seed"),
        ({"tensors": {"a": 5}}, "tensors.a"),
        ({"tensors": {"a": {"dtype": "(99999999999999999999,)f4", "shape": [1], "data": b""}}}, "tensors.a.dtype"),
        ({"tensors": {"a": {"dtype": "float32", "shape": ["x", 2], "data": b""}}}, "tensors.a.shape"),
        ({"tensors": {"a": {"dtype": "float32", "shape": [-1, -4], "data": bytes(16)}}}, "tensors.a.shape"),
        ({"tensors": {"a": {"dtype": "float32", "shape": [0, 2**63], "data": b""}}}, "a message cannot be read"),
        ({"tensors": {5: {"dtype": "float32", "shape": [1], "data": bytes(4)}}}, "tensors"),
    ],
)
def test_what_no_gateway_writes_is_told_with_its_file_and_field(changes, field, path, tmp_path):
    odd = tmp_path / "odd.mcap"
    rewrite(path, odd, changes)
    status, said = run("replay", odd)
    assert status == 2, said
    assert "for FILE" in said
    unfolded = said.replace(" ", "")
    assert "odd.mcap" in unfolded
    assert field.replace(" ", "") in unfolded


CODECS = {
    "json": (json.loads, lambda content: json.dumps(content).encode()),
    "msgpack": (msgpack.unpackb, msgpack.packb),
}


def rewrite(path, to, changes):
    """The same recording with other values for some fields, wherever they stand."""
    with path.open("rb") as file, to.open("wb") as out:
        writer, channels = Writer(out), {}
        writer.start()
        for _, channel, told in make_reader(file).iter_messages(log_time_order=False):
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, 0)
            data = told.data
            if channel.message_encoding in CODECS:
                unpack, pack = CODECS[channel.message_encoding]
                data = pack({name: changes.get(name, value) for name, value in unpack(data).items()})
            writer.add_message(channels[channel.topic], told.log_time, data, told.publish_time)
        writer.finish()


async def test_an_empty_recording_is_played_to_nobody(detector, recorded_moments, tmp_path):
    path = write(tmp_path / "one.mcap", detector, recorded_moments[:1])
    (session,) = sessions(path)
    session.files[0].frames.clear()
    with pytest.raises(RecordingError, match="has no frames"):
        await play_against("http://127.0.0.1:9", type(session)(session.opening, [], session.files))


def test_perceived_objects_are_exported(path, tmp_path):
    out = tmp_path / "[red]out.jsonl"
    status, said = run("export", path, "--to", "cpm", "--out", out)
    assert status == 0, said
    assert f"{out}: 3 frames" in said
    assert [json.loads(line)["frame"] for line in out.read_text().splitlines()] == [0, 1, 2]
