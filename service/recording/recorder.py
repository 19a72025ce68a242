"""Records sessions on a thread of its own. A frame is handed over in microseconds, after its answer is ready; where the
thread or the disk cannot follow, frames are left out and counted, and no answer waits for it.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import structlog

from robosac.answers import FrameAnswer
from robosac.extras import need
from robosac.faults import describe, told
from robosac.recording.content import Moment
from service.deciding.asked import Answered
from service.errors import Kind, Refused
from service.keeping.record import SessionRecord
from service.recording.folder import IDLE_S, Folder
from service.sessions.live import LiveSession
from service.settings import Settings
from service.watching.metrics import Metrics

logger = structlog.stdlib.get_logger(__name__)

MOST_WAITING = 256
MOST_WAITING_BYTES = 2**26
"""Frames that wait to be written, and the bytes of their messages; beyond, frames are left out."""
RETRY_S = 5.0
"""How long nothing is tried after the disk has failed."""
TOLD_EVERY_S = 60.0
"""How often the log says that frames are left out."""


@dataclass(frozen=True)
class _Noted:
    record: SessionRecord
    live: LiveSession
    moment: Moment
    nbytes: int
    dropped: int


@dataclass(frozen=True)
class _Over:
    session_id: str


class Recorder:
    """Records all sessions, or those that ask for it, or none.

    Raises
    ------
    MissingExtra
        If recordings are wanted and cannot be written.
    """

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._folder: Folder | None = None
        if settings.record is not None:
            need("mcap", "recordings")
            bodies = settings.record_messages == "whole"
            self._folder = Folder(settings.record, settings.record_file_bytes, settings.record_bytes, bodies)
        self._all = settings.record_sessions == "all"
        self._metrics = metrics
        self._waiting: queue.SimpleQueue[_Noted | _Over | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._frames = self._nbytes = 0
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._retry_at = self._tell_at = 0.0
        self._untold = 0

    def start(self) -> None:
        """Begin to record.

        Raises
        ------
        ValueError
            If the folder cannot be used.
        """
        if self._folder is None:
            return
        try:
            self._folder.make()
        except OSError as fault:
            raise ValueError(f"ROBOSAC_RECORD: {told(fault)}") from fault
        self._thread.start()

    def stop(self) -> None:
        """Write what waits, and close all files."""
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()

    def check(self, *, asked: bool) -> None:
        """Refuse a session that wants to be recorded where nothing is."""
        if asked and self._folder is None:
            raise Refused(Kind.INVALID_REQUEST, "this gateway records nothing (ROBOSAC_RECORD)", "record")

    async def begin(self, session_id: str, *, asked: bool) -> bool:
        """A session is open; whether it is recorded. The folder keeps who asked, for other processes, too."""
        if self._all or not asked:
            return self._folder is not None and self._all
        return await asyncio.to_thread(self._try, lambda folder: folder.ask(session_id)) is None

    def end(self, session_id: str) -> None:
        """A session is over: its recording is whole."""
        if self._folder is not None:
            self._waiting.put(_Over(session_id))

    def note(self, answered: Answered, answer: FrameAnswer) -> None:
        """Hand an answered frame over to be recorded, if there is room for it. Nothing is computed or copied."""
        record, live = answered.record, answered.asked.caller.live
        if self._folder is None or not (self._all or live.recorded is not False):
            return
        asked, result = answered.asked, answered.result
        messages = {record.ego_id: asked.ego, **asked.messages}
        nbytes = sum(received.nbytes for received in messages.values())
        with self._lock:
            full = self._frames >= MOST_WAITING or self._nbytes + nbytes > MOST_WAITING_BYTES
            if not full:
                self._frames, self._nbytes = self._frames + 1, self._nbytes + nbytes
                dropped, live.unrecorded = live.unrecorded, 0
        if full:
            self._leave_out(record.session_id, live, "waiting", "the disk is too slow")
            return
        moment = Moment(
            time_ns=time.time_ns(),
            messages=messages,
            fused=answered.fused,
            team=record.teammates,
            seed=record.seed,
            answer=answer,
            state=record.state,
            previous=answered.previous,
            left=result.state,
            left_previous=result.previous,
            least_score=live.detector.info.consensus_score,
            out_of_time=result.out_of_time,
            truth=asked.ego.truth,
        )
        self._waiting.put(_Noted(record, live, moment, nbytes, dropped))

    def _work(self) -> None:
        """What the thread does."""
        look_at = 0.0
        while True:
            now = time.monotonic()
            if now >= look_at:
                self._try(lambda folder: folder.close(IDLE_S))
                look_at = now + IDLE_S / 2
            try:
                noted = self._waiting.get(timeout=IDLE_S / 2)
            except queue.Empty:
                continue
            if noted is None:
                self._try(Folder.close)
                return
            self._take(noted)

    def _take(self, noted: _Noted | _Over) -> None:
        if isinstance(noted, _Over):
            self._try(lambda folder: folder.over(noted.session_id))
            return
        self._write(noted)
        with self._lock:
            self._frames, self._nbytes = self._frames - 1, self._nbytes - noted.nbytes

    def _write(self, noted: _Noted) -> None:
        session_id = noted.record.session_id
        if time.monotonic() >= self._retry_at:
            fault = self._try(lambda folder: self._add(folder, noted))
            if fault is None:
                return
        else:
            fault = "the disk has failed"
        with self._lock:
            noted.live.unrecorded += noted.dropped
        self._leave_out(session_id, noted.live, "disk", fault)

    def _add(self, folder: Folder, noted: _Noted) -> None:
        """Write a frame, unless nobody asked for it: of each session it is looked once."""
        if not self._all and noted.live.recorded is None:
            noted.live.recorded = folder.is_asked(noted.record)
        if self._all or noted.live.recorded:
            folder.add(noted.record, noted.moment, noted.dropped)
            self._metrics.recorded()

    def _try(self, work: Callable[[Folder], None]) -> str | None:
        """Do something with the folder; what went wrong, if anything did."""
        if self._folder is None:
            return None
        try:
            work(self._folder)
        except OSError as fault:
            self._retry_at = time.monotonic() + RETRY_S
            return describe(fault)
        except Exception as fault:  # whatever is wrong with a frame must cost its recording only
            logger.exception("a frame cannot be recorded")
            return describe(fault)
        return None

    def _leave_out(self, session_id: str, live: LiveSession, why: str, detail: str) -> None:
        """Count a frame that is not recorded, and say so every so often."""
        self._metrics.unrecorded(why)
        with self._lock:
            live.unrecorded += 1
            self._untold += 1
            if time.monotonic() < self._tell_at:
                return
            self._tell_at, untold, self._untold = time.monotonic() + TOLD_EVERY_S, self._untold, 0
        logger.warning("frames are not recorded", frames=untold, session_id=session_id, why=detail)
