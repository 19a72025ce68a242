"""The latest decisions of every session, and those who watch them. Watching costs a frame nothing: noting it down
takes some microseconds, and everything else is done a few times a second, only for sessions that somebody watches, once
for all who do.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import structlog

from robosac.answers import FrameAnswer
from robosac.audit.sentences import sentence
from robosac.boxes import FloatArray
from robosac.faults import printable
from robosac.fusion import FusionResult
from service.errors import Kind, Refused, SessionOver
from service.keeping.record import SessionRecord
from service.viewing.shown import Seen
from service.viewing.viewers import Batch, Viewer

logger = structlog.stdlib.get_logger(__name__)

FRAMES = 60
"""Latest frames that are kept of a session."""
ALL_FRAMES = 2000
"""And of all sessions together; those unused for longest are forgotten first."""
SESSIONS = 256
TICK_S = 0.25
"""Those who watch are told so often, where they are few."""
SENDS_PER_S = 100
"""Where they are many, each is told less often."""
FRAMES_PER_S = 12
"""So many frames are told; if there were more, the latest. Vehicles ask 5 to 10 times a second."""
TAIL = 40
"""Latest audit records that are told."""

_OF_A_FRAME = '"event":"frame_answered"'
"""In its line only: a text in a record has its quotes escaped."""

ReadLog = Callable[[str, int, int], Awaitable[list[str]]]
"""Lines of a session's audit log: of this session, after this number, at most so many."""


@dataclass
class _Session:
    """What is known of a session to be watched."""

    record: SessionRecord
    about: Mapping[str, Any]
    least_score: float
    frames: deque[Seen] = field(default_factory=lambda: deque(maxlen=FRAMES))
    viewers: set[Viewer] = field(default_factory=set)
    news: asyncio.Event = field(default_factory=asyncio.Event)
    teller: asyncio.Task[None] | None = None
    count: int = 0
    """Frames noted so far."""
    told: int = 0
    """Of them, up to which one viewers were told."""
    seq: int = 0
    """Number of the latest audit record that is known of."""
    read: int = 0
    """Number of the latest that was read."""
    told_seq: int = 0
    """Number of the latest that viewers were told of."""
    tail: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=TAIL))


class Feed:
    """What can be watched.

    Parameters
    ----------
    read_log : callable
        See `ReadLog`.
    most_viewers : int
        At a time, of all sessions.
    encode : callable
        JSON to what is sent.
    """

    def __init__(self, read_log: ReadLog, most_viewers: int, encode: Callable[[str], bytes] = str.encode) -> None:
        self._read_log = read_log
        self._encode = encode
        self._most_viewers = most_viewers
        self._sessions: OrderedDict[str, _Session] = OrderedDict()
        self._viewers = 0
        self._frames = 0
        self._over = False

    def note(
        self,
        record: SessionRecord,
        answer: FrameAnswer,
        result: FusionResult,
        ego_pose: FloatArray,
        poses: Mapping[str, FloatArray],
        least_score: float,
    ) -> None:
        """Note down an answered frame. Nothing is computed; of the messages only the poses are kept."""
        session = self._sessions.get(record.session_id)
        if session is None:
            session = self._sessions[record.session_id] = _Session(record, _about(record, least_score), least_score)
        self._sessions.move_to_end(record.session_id)
        self._frames += len(session.frames) < FRAMES
        session.record = record
        session.frames.append(Seen.of(answer, result, ego_pose, poses))
        session.count += 1
        if answer.receipt is not None:
            session.seq = answer.receipt.seq
            session.read += session.read == session.seq - 1  # there is no other record since
        self._forget()
        if session.viewers:
            session.news.set()

    def sessions(self) -> list[dict[str, Any]]:
        """The sessions that can be watched, the one answered last first."""
        return [
            {
                **session.about,
                "teammates": list(session.record.teammates),
                "frames": session.record.frames_answered + 1,
                "frame": session.frames[-1].answer.frame,
                "answered_at": round(session.frames[-1].time, 3),
                "named": list(session.frames[-1].answer.named),
                "viewers": len(session.viewers),
            }
            for session in reversed(self._sessions.values())
        ]

    @contextlib.contextmanager
    def watching(self, session_id: str) -> Iterator[Viewer]:
        """Somebody watches a session for the length of a block.

        Raises
        ------
        Refused
            If no frame of such a session is known, or too many watch.
        """
        session = self._sessions.get(session_id)
        if session is None:
            raise SessionOver("no frame of such a session was answered lately")
        if self._viewers >= self._most_viewers or self._over:
            detail = f"{self._most_viewers} may watch at a time (ROBOSAC_MAX_VIEWERS)"
            raise Refused(Kind.TOO_MANY_VIEWERS, detail)
        viewer = Viewer()
        self._viewers += 1
        session.viewers.add(viewer)
        if session.teller is None:
            session.told, session.told_seq = session.count, 0
            session.teller = asyncio.create_task(self._tell(session))
        try:
            yield viewer
        finally:
            self._viewers -= 1
            session.viewers.discard(viewer)
            if not session.viewers and session.teller is not None:
                session.teller.cancel()
                session.teller = None

    def about(self, session_id: str) -> Mapping[str, Any]:
        """What a viewer is told of a session first."""
        return self._sessions[session_id].about

    async def latest(self, session_id: str, after: int = -1) -> Batch:
        """The frames of a session that are kept and numbered above ``after``, and the tail of its log."""
        session = self._sessions[session_id]
        frames = [seen for seen in session.frames if seen.answer.frame > after]
        await self._read(session)
        return await self._batch(session, frames, list(session.tail))

    def end(self) -> None:
        """Nobody may watch any more; those who do are sent away."""
        self._over = True
        for session in self._sessions.values():
            for viewer in session.viewers:
                viewer.end()

    async def _tell(self, session: _Session) -> None:
        """Tell those who watch a session what is new, every so often, as long as somebody does."""
        while True:
            await session.news.wait()
            session.news.clear()
            new, session.told = session.count - session.told, session.count
            tick_s = max(TICK_S, self._viewers / SENDS_PER_S)
            frames = list(session.frames)[-min(new, round(FRAMES_PER_S * tick_s)) :] if new else []
            try:
                await self._read(session)
                audit = [entry for entry in session.tail if entry["seq"] > session.told_seq]
                session.told_seq = session.read
                batch = await self._batch(session, frames, audit, new - len(frames))
            except Exception:  # what cannot be shown must not end the feed of what comes after
                logger.exception("a frame cannot be shown", session_id=session.record.session_id)
                continue
            for viewer in session.viewers:
                viewer.offer(batch)
            await asyncio.sleep(tick_s)

    async def _read(self, session: _Session) -> None:
        """Read what is new in a session's log: of frames nothing, since they are told themselves."""
        if session.read >= session.seq:
            return
        after = max(session.read, session.seq - TAIL)
        try:
            lines = await self._read_log(session.record.session_id, after, TAIL)
        except Refused:  # the database failed; the next time it may not
            return
        told = await asyncio.to_thread(_told, lines)
        session.tail += [entry for entry in told if entry["seq"] > session.read]  # others were read meanwhile
        session.read = max(session.read, after + len(lines))

    async def _batch(
        self, session: _Session, frames: list[Seen], audit: list[dict[str, Any]], skipped: int = 0
    ) -> Batch:
        """Frames and log entries, made ready off the event loop."""

        def made() -> bytes:
            told = ",".join(seen.as_json(session.least_score) for seen in frames)
            return self._encode(f'{{"frames":[{told}],"skipped":{skipped},"audit":{json.dumps(audit)}}}')

        return Batch(await asyncio.to_thread(made), len(frames))

    def _forget(self) -> None:
        """Keep within bounds: sessions that were not answered for longest go, unless somebody watches them."""
        while self._frames > ALL_FRAMES or len(self._sessions) > SESSIONS:
            quiet = next((key for key, session in self._sessions.items() if not session.viewers), None)
            if quiet is None:
                return
            self._frames -= len(self._sessions.pop(quiet).frames)


def _told(lines: Sequence[str]) -> list[dict[str, Any]]:
    """Lines of a log in words, but those of frames."""
    others = [(line, json.loads(line)) for line in lines if _OF_A_FRAME not in line]
    return [
        {"seq": record["seq"], "time": record["time"], "text": printable(sentence(line))} for line, record in others
    ]


def _about(record: SessionRecord, least_score: float) -> dict[str, Any]:
    """Of a session what does not change from frame to frame."""
    return {
        "session_id": record.session_id,
        "ego_id": record.ego_id,
        "detector": record.detector,
        "defense": record.defense.get("kind"),
        "created_at": record.created_at,
        "latency_budget_ms": record.latency_budget_ms,
        "least_score": least_score,
    }
