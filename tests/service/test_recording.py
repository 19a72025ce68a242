import asyncio
import contextlib
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from clients.simulation import Fleet
from robosac import wire
from robosac.attacks import PGD
from robosac.playback.replay import replay
from robosac.recording.reading import sessions
from robosac.recording.truth import Truth
from robosac.recording.writing import RecordingFile
from robosac.scenes import IntersectionScene
from service.keeping.record import SessionRecord
from service.recording.folder import Folder
from service.settings import Settings
from tests.service.conftest import EGO, problem, serve


@pytest.fixture(scope="module")
def fleet(detector):
    """Frames of a fleet in which one attacks."""
    driven = Fleet(IntersectionScene(8), detector, 1, 1, PGD(steps=2), 0)
    return [driven.sense(index)[0] for index in range(4)]


async def drive(served, session, fleet, truth=True, start=0):
    for index, frame in enumerate(fleet, start):
        told = Truth(frame.truth, tuple(frame.attackers)) if truth else None
        yield await served.ego(session).post_frame(index, frame.message, frame.sent, truth=told)


async def test_what_a_gateway_recorded_replays_to_the_same_answers(fleet, detector, tmp_path):
    async with serve(record=tmp_path) as served:
        session = await served.open()
        sending = [served.teammate(session, name).send(0, message) for name, message in fleet[0].sent.items()]
        asked = served.ego(session).ask(0, fleet[0].message, Truth(fleet[0].truth))
        answers = [(await asyncio.gather(asked, *sending))[0]]
        async for answer in drive(served, session, fleet[1:3], start=1):
            answers.append(answer)
        await served.ego(session).dismiss("car-5")
        last = {name: message for name, message in fleet[3].sent.items() if name != "car-5"}
        answers.append(await served.ego(session).post_frame(3, fleet[3].message, last))
        assert "robosac_recorded_frames_total 4.0" in (await until_recorded(served, 4))
        await served.ego(session).close()
    (recorded,) = sessions(tmp_path)
    assert recorded.opening.session_id == session.session_id
    assert recorded.files[0].damage is None
    assert [frame.truth is None for frame in recorded.frames] == [False, False, False, True]
    for frame, answer in zip(recorded.frames, answers, strict=True):
        assert frame.answer.accepted == answer.accepted
        assert frame.answer.receipt == answer.receipt
        np.testing.assert_array_equal(frame.answer.boxes, answer.boxes)
    replayed = list(replay(recorded, detector))
    assert [each.differing for each in replayed] == [()] * 4
    assert [frame.decided.before is not None for frame in recorded.frames] == [True, False, False, True]  # the team


async def until_recorded(served, frames):
    async with asyncio.timeout(20):
        while True:
            told = (await served.http.get("/metrics")).text
            if f"robosac_recorded_frames_total {frames}.0" in told:
                return told
            await asyncio.sleep(0.01)


async def test_where_a_recording_is_removed_the_next_frame_begins_another(fleet, tmp_path):
    folder = tmp_path / "recordings"
    async with serve(record=folder) as served:
        session = await served.open()
        driven = drive(served, session, fleet)
        await anext(driven)
        await until_recorded(served, 1)
        (first,) = folder.iterdir()
        first.unlink()
        await anext(driven)
        await until_recorded(served, 2)
        (second,) = folder.iterdir()
        second.unlink()
        folder.rmdir()
        await anext(driven)
        async with asyncio.timeout(20):
            while 'unrecorded_frames_total{why="disk"} 1.0' not in (await served.http.get("/metrics")).text:
                await asyncio.sleep(0.01)


async def test_only_sessions_that_ask_are_recorded_where_the_operator_says_so(fleet, tmp_path):
    database, folder = f"sqlite:///{tmp_path}/db", tmp_path / "recordings"
    settings = {"record": folder, "record_sessions": "asked", "record_messages": "digests", "database_url": database}
    async with serve(**settings) as served:
        asked, other = await served.open(record=True), await served.open()
        for session in (other, asked):
            async for _ in drive(served, session, fleet[:1]):
                pass
        opened = await served.http.post("/v1/sessions", json={"ego_id": EGO, "teammates": ["a"], "record": True})
        assert opened.json()["recorded"] is True
    async with serve(**settings) as served:  # started again, it knows whom it recorded
        async for _ in drive(served, asked, fleet[1:2], start=1):
            pass
    (recorded,) = sessions(folder)
    assert recorded.opening.session_id == asked.session_id
    assert [file.opening.part for file in recorded.files] == [1, 2]
    assert [file.counts["/digests"] for file in recorded.files] == [6, 6]


async def test_a_session_that_asked_is_recorded_wherever_it_goes(fleet, tmp_path):
    folder = tmp_path / "recordings"
    settings = {"record": folder, "record_sessions": "asked", "database_url": f"sqlite:///{tmp_path}/db"}
    async with serve(**settings) as one, serve(**settings) as other:
        early, late, unasked = await one.open(record=True), await one.open(record=True), await one.open()
        for session, turns in ((early, (other, one)), (late, (one, other, other)), (unasked, (other,))):
            for index, served in enumerate(turns):
                async for _ in drive(served, session, fleet[index : index + 1], start=index):
                    pass
        for session in (early, late, unasked):
            await other.ego(session).close()
    found = {session.opening.session_id: [frame.number for frame in session.frames] for session in sessions(folder)}
    assert found == {early.session_id: [0, 1], late.session_id: [0, 1, 2]}
    assert {path.suffix for path in folder.iterdir()} == {".mcap"}


async def test_the_recording_of_a_session_that_expires_is_whole_at_once(fleet, tmp_path):
    async with serve(record=tmp_path, record_sessions="asked", session_idle_s=1.0) as served:
        session = await served.open(record=True)
        async for _ in drive(served, session, fleet[:1]):
            pass
        await until_recorded(served, 1)
        async with asyncio.timeout(20):
            while len(list(tmp_path.iterdir())) > 1 or served.gateway.recorder._folder._files:
                await asyncio.sleep(0.01)
    (recorded,) = sessions(tmp_path)
    assert recorded.files[0].damage is None


async def test_a_gateway_that_records_nothing_says_so(served):
    refused = await served.http.post("/v1/sessions", json={"ego_id": EGO, "teammates": ["a"], "record": True})
    assert problem(refused, 422, "invalid-request")["field"] == "record"
    opened = await served.http.post("/v1/sessions", json={"ego_id": EGO, "teammates": ["a"]})
    assert opened.json()["recorded"] is False


async def test_a_truth_that_is_none_is_refused_with_its_field(served, ego_message, benign):
    session = await served.open()
    body = wire.pack_frame(0, ego_message, benign, truth={"boxes": {"dtype": "float64", "shape": [1, 4], "data": b""}})
    assert problem(await served.post(session, "frames", body), 422, "wrong-shape")["field"] == "ego.truth.boxes.shape"


async def test_a_folder_that_cannot_be_used_keeps_the_gateway_from_starting(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=rf"^ROBOSAC_RECORD: {tmp_path}/file is a file; a folder is wanted$"):
        async with serve(record=tmp_path / "file"):
            pass


async def test_a_disk_that_stands_still_holds_no_frame_up_and_what_is_left_out_is_told(fleet, detector, tmp_path):
    blocked = threading.Event()
    async with serve(record=tmp_path) as served:
        recorder = served.gateway.recorder
        recorder._folder = Slow(recorder._folder, blocked)
        session = await served.open()
        with capture_logs() as logs:
            nbytes = sum(t.nbytes for m in [fleet[0].message, *fleet[0].sent.values()] for t in m.tensors.values())
            recorder._nbytes = 2**26 - 2 * nbytes  # as if so much waited
            answers = [answer async for answer in drive(served, session, fleet)]
        assert len(answers) == 4
        assert [log["frames"] for log in logs if log["event"] == "frames are not recorded"] == [1]
        assert 'robosac_unrecorded_frames_total{why="waiting"} 2.0' in (await served.http.get("/metrics")).text
        blocked.set()
        await until_recorded(served, 2)
        recorder._nbytes = 0
        async for _ in drive(served, session, fleet[:1], start=4):
            pass
    (recorded,) = sessions(tmp_path)
    assert [(frame.number, frame.decided.dropped) for frame in recorded.frames] == [(0, 0), (1, 0), (4, 2)]
    assert [each.differing for each in replay(recorded, detector)] == [()] * 3


class Slow:
    """A folder on a disk that stands still until it is told to go on."""

    def __init__(self, folder, until):
        self._folder, self._until = folder, until

    def add(self, *what):
        self._until.wait(20)
        self._folder.add(*what)

    def over(self, session_id):
        self._folder.over(session_id)

    def close(self, idle_s=0.0):
        self._folder.close(idle_s)


async def test_a_disk_that_fails_costs_the_recording_only(fleet, detector, tmp_path):
    folder = tmp_path / "recordings"
    async with serve(record=folder) as served:
        session = await served.open()
        async for _ in drive(served, session, fleet[:1]):
            pass
        await until_recorded(served, 1)
        recorder = served.gateway.recorder
        (opened,) = recorder._folder._files.values()
        with Path("/dev/full").open("wb") as full:
            os.dup2(full.fileno(), opened.file._file.fileno())
        with capture_logs() as logs:
            answers = [answer async for answer in drive(served, session, fleet[1:3], start=1)]
            async with asyncio.timeout(20):
                while 'why="disk"} 2.0' not in (await served.http.get("/metrics")).text:
                    await asyncio.sleep(0.01)
        assert [answer.frame for answer in answers] == [1, 2]
        assert any(log["event"] == "frames are not recorded" for log in logs)
        recorder._retry_at = 0.0
        async for _ in drive(served, session, fleet[3:], start=3):
            pass
    (recorded,) = sessions(folder)
    assert [(frame.number, frame.decided.dropped) for frame in recorded.frames] == [(0, 0), (3, 2)]
    assert [bool(file.damage) for file in recorded.files] == [True, False]
    assert [each.differing for each in replay(recorded, detector)] == [(), ()]


def a_session(number, **more):
    return SessionRecord(
        session_id=f"{number:032x}", ego_id=EGO, teammates=("car-2",), detector="intersection-mean",
        defense={"kind": "none"}, latency_budget_ms=200.0, gather_ms=100.0, frame_period_ms=200.0, token_ids={},
        created_at="2026-11-22T12:00:00.000Z", seed="00", **more,
    )  # fmt: skip


def test_whoever_records_much_loses_recordings_of_its_own(recorded_moments, tmp_path):
    folder = Folder(tmp_path, most_file=2**28, most=2**21, bodies=True)
    folder.make()
    honest, keyless = [a_session(number, key_id=key) for number, key in ((0, "0123456789abcdef"), (1, ""))]
    for session in (honest, keyless):
        folder.add(session, recorded_moments[0], 0)
        folder.end(session.session_id)
    for number in range(2, 40):
        folder.add(a_session(number, key_id="fedcba9876543210"), recorded_moments[0], 0)
        folder.end(a_session(number).session_id)
    folder.make_room()
    left = sorted(path.name.split("-", 1)[1] for path in tmp_path.iterdir())
    assert left[:2] == [f"{0:032x}-0001-01234567.mcap", f"{1:032x}-0001.mcap"]
    assert left[-1] == f"{39:032x}-0001-fedcba98.mcap"
    assert 2 < len(left) < 40
    assert {session.opening.session_id for session in sessions(tmp_path)} >= {honest.session_id, keyless.session_id}


def test_a_folder_that_holds_very_many_files_is_not_read_for_each_session(recorded_moments, tmp_path, monkeypatch):
    folder = Folder(tmp_path, most_file=2**28, most=2**33, bodies=False)
    folder.make()
    folder.make_room()
    with monkeypatch.context() as patched:
        patched.setattr(Folder, "_found", lambda _: pytest.fail("the folder was read"))
        for number in range(3):
            assert not folder.is_asked(a_session(number))
            for answered in range(3):
                folder.add(a_session(number, frames_answered=answered), recorded_moments[answered], 0)
                folder.end(a_session(number).session_id)
    other = Folder(tmp_path, most_file=2**28, most=2**33, bodies=False)  # of another process
    other.add(a_session(0, frames_answered=3), recorded_moments[3], 0)
    folder.add(a_session(0, frames_answered=4), recorded_moments[4], 0)
    for each in (folder, other):
        each.close()
    parts = sorted(int(path.name.split("-")[2][:4]) for path in tmp_path.glob(f"*-{a_session(0).session_id}-*"))
    assert parts == [1, 2, 3, 4, 5]


def test_files_are_rotated_and_the_oldest_are_removed(recorded_moments, tmp_path):
    folder = Folder(tmp_path, most_file=2**19, most=2**21, bodies=True)
    folder.make()
    foreign = tmp_path / "of somebody else.mcap"
    foreign.write_bytes(bytes(2**21))
    for turn in range(4):
        for moment in recorded_moments:
            folder.add(a_session(turn % 2), moment, 0)
            assert sum(path.stat().st_size for path in tmp_path.iterdir() if path != foreign) < 2**21 + 2**19
    folder.close()
    foreign.unlink()
    found = sessions(tmp_path)
    assert max(len(session.files) for session in found) > 1
    assert all(file.damage is None for session in found for file in session.files)
    latest = max(found, key=lambda session: session.frames[-1].time_ns)
    assert latest.frames[-1].number == 5
    assert all(file.frames[0].decided.before is not None for file in latest.files)


def open_files(folder):
    """Recordings in a folder that this process has open."""
    places = []
    for number in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # that of this very look
            places.append(number.readlink())
    return [place for place in places if folder in place.parents]


def test_of_many_sessions_that_take_turns_each_has_one_file_and_few_are_open(recorded_moments, tmp_path):
    folder = Folder(tmp_path, most_file=2**28, most=2**33, bodies=False)
    folder.make()
    for turn in range(4):
        for number in range(folder.most_open + 2):
            folder.add(a_session(number), recorded_moments[turn], 0)
    assert len(open_files(tmp_path)) == folder.most_open == 64
    folder.close(idle_s=60.0)
    assert len(list(tmp_path.iterdir())) == 66
    folder.end(a_session(0).session_id)
    folder.close()
    assert not open_files(tmp_path)
    found = sessions(tmp_path)
    assert [[frame.number for frame in session.frames] for session in found] == [[0, 1, 2, 3]] * 66
    assert not any(file.damage for session in found for file in session.files)
    assert folder.is_asked(a_session(65))
    assert not folder.is_asked(a_session(66))


def test_a_file_that_is_removed_while_it_waits_for_its_next_frame_is_not_missed(recorded_moments, tmp_path):
    folder = Folder(tmp_path, most_file=2**28, most=2**33, bodies=False, most_open=1)
    folder.make()
    for number in range(2):
        folder.add(a_session(number), recorded_moments[0], 0)
    (removed,) = tmp_path.glob(f"*-{a_session(0).session_id}-*")
    removed.unlink()
    for number in range(2):
        folder.add(a_session(number), recorded_moments[1], 0)
    folder.add(a_session(2), recorded_moments[0], 0)
    folder.add(a_session(3), recorded_moments[0], 0)
    next(tmp_path.glob(f"*-{a_session(2).session_id}-*")).unlink()
    folder.close()
    found = {session.opening.session_id: session for session in sessions(tmp_path)}
    frames = [[frame.number for frame in found[a_session(number).session_id].frames] for number in range(2)]
    assert frames == [[1], [0, 1]]


def test_the_folder_is_measured_as_much_is_written_and_not_for_every_file(recorded_moments, tmp_path, monkeypatch):
    folder = Folder(tmp_path, most_file=2**28, most=2**33, bodies=False)
    folder.make()
    measured = []
    monkeypatch.setattr(folder, "make_room", lambda: measured.append(True))
    for number in range(20):
        folder.add(a_session(number), recorded_moments[0], 0)
    assert len(measured) == 1
    folder.close()


async def test_files_of_sessions_that_went_elsewhere_are_closed_while_others_go_on(fleet, tmp_path, monkeypatch):
    monkeypatch.setattr("service.recording.recorder.IDLE_S", 1.0)
    async with serve(record=tmp_path) as served:
        gone = await served.open()
        async for _ in drive(served, gone, fleet[:1]):
            pass
        await until_recorded(served, 1)
        recorder = served.gateway.recorder
        async with asyncio.timeout(5):
            while gone.session_id in recorder._folder._files:
                recorder.end("another session, so that there is always something to do")
                await asyncio.sleep(0.01)


def test_where_all_files_are_open_the_one_unused_for_longest_goes(recorded_moments, tmp_path):
    folder = Folder(tmp_path, most_file=2**28, most=2**21, bodies=True)
    folder.make()
    for number in range(9):
        folder.add(a_session(number), recorded_moments[0], 0)
        for path in tmp_path.iterdir():
            if f"{number:032x}" in path.name:
                os.utime(path, (time.time() - 100 + number,) * 2)
    folder.make_room()
    left = {int(path.name.split("-")[1], 16) for path in tmp_path.iterdir()}
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2**21
    folder.close()
    assert 8 in left
    assert 0 not in left


def test_of_a_key_what_is_being_written_goes_last(recorded_moments, tmp_path):
    folder = Folder(tmp_path, most_file=2**28, most=2**33, bodies=True)
    folder.make()
    for number in range(3):
        folder.add(a_session(number), recorded_moments[0], 0)
    folder.end(a_session(2).session_id)
    (size, *_) = [path.stat().st_size for path in tmp_path.iterdir()]
    folder.most = 5 * size // 2
    folder.make_room()
    assert {int(path.name.split("-")[1], 16) for path in tmp_path.iterdir()} == {0, 1}
    folder.close()


def test_more_sessions_are_recorded_than_are_remembered(recorded_moments, tmp_path, monkeypatch):
    monkeypatch.setattr("service.recording.folder.REMEMBERED", 4)
    folder = Folder(tmp_path, most_file=2**28, most=2**33, bodies=False)
    folder.make()
    for frame in range(3):
        for number in range(6):
            folder.add(a_session(number, frames_answered=frame), recorded_moments[frame], 0)
            assert len(folder._parts) <= 4
    for number in range(6):
        folder.over(a_session(number).session_id)
    assert not folder._parts
    found = sessions(tmp_path)
    assert [[frame.number for frame in session.frames] for session in found] == [[0, 1, 2]] * 6


def test_what_a_file_and_a_folder_may_have_is_bounded():
    for name in ("record_file_bytes", "record_bytes"):
        with pytest.raises(ValueError, match=name):
            Settings(**{name: 1000})


def test_nobody_writes_over_a_recording(recorded_moments, detector, tmp_path):
    from tests.recorded import opening

    (tmp_path / "x.mcap").write_bytes(b"kept")
    with pytest.raises(FileExistsError):
        RecordingFile(tmp_path / "x.mcap", opening(detector, ("car-2",)), 0)
    assert (tmp_path / "x.mcap").read_bytes() == b"kept"
