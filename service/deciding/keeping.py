"""Keeping a decision: in the store and in memory, or in neither, within the time that its frame has."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from robosac import wire
from robosac.answers import FrameAnswer
from robosac.audit import commitment
from robosac.audit.events import FrameAnswered
from robosac.audit.packing import packed_state
from robosac.defenses import State
from robosac.fusion import FusionResult
from service.deciding.asked import Asked, Present
from service.errors import GivenUp, StoreTooSlow, StoreUnavailable
from service.keeping.patience import GRACE_S, Patience, ask_for_the_exception
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.sessions.sessions import Sessions


@dataclass(frozen=True)
class Keeping:
    """Keeps decisions. Memory follows the store: what a session remembers is what the store has of it."""

    sessions: Sessions
    store: Store
    keep_frames: int
    """Latest frames of a session whose messages are kept, to replay decisions."""
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)

    async def keep(
        self, asked: Asked, record: SessionRecord, present: Present, result: FusionResult, answer: FrameAnswer
    ) -> SessionRecord:
        """Put a decision on record, with all that it takes to make it again, and remember it; the session with it.

        Raises
        ------
        StoreTooSlow
            If that took until `GRACE_S` after the frame's time. Either nothing is kept and the frame can be asked for
            again; or the store is past the point of return. The session's next frame waits until the store has let go.
        SessionChanged, FrameDecided, SessionOver, StoreUnavailable
            As `service.keeping.store.Store.decide`. Nothing is remembered then.
        """
        live = asked.caller.live
        write = _Write(self, asked, present, result, live.count_anew(), tuple(live.late))
        live.late.clear()
        task = asyncio.create_task(write.run(record, answer))
        self._tasks.add(task)  # the loop itself holds tasks only weakly
        task.add_done_callback(self._tasks.discard)
        await asyncio.wait({task}, timeout=max(asked.due - time.perf_counter(), 0.0) + GRACE_S)
        if task.done():
            task.result()
            return write.kept
        task.add_done_callback(ask_for_the_exception)
        live.settling = task  # one at a time: each may hold a connection for as long as another holds the session's row
        if write.patience.give_up():
            write.undo()
            raise StoreTooSlow("did not take the decision in time; nothing of it is kept, send the frame again")
        write.is_too_late = True
        raise StoreTooSlow("is still writing the decision; if the frame, sent again, is stale-frame, it was kept")

    async def close(self) -> None:
        """Wait for what is still on its way."""
        if self._tasks:
            await asyncio.wait(self._tasks)


@dataclass
class _Write:
    """A decision on its way into the store."""

    keeping: Keeping
    asked: Asked
    present: Present
    result: FusionResult
    unlogged: Mapping[str, int]
    """Refusals without a record since the decision before."""
    late: tuple[int, ...]
    """Frames before it that were answered too late, though their records say otherwise."""
    is_too_late: bool = False
    """Whether it is not waited for any more."""
    patience: Patience = field(default_factory=Patience)
    kept: SessionRecord = field(init=False)
    """The session with the decision, once it is kept."""

    async def run(self, record: SessionRecord, answer: FrameAnswer) -> None:
        """Write and remember; undo what was noted before if the store fails."""
        keeping, asked = self.keeping, self.asked
        next_seed = keeping.sessions.draw_seed()
        body = None
        try:
            if keeping.keep_frames:
                body = await asyncio.to_thread(whole_frame, asked, self.present, record.state, self.result.state)
            event = self._event(record, answer, next_seed)
            patience, keep_frames = self.patience, keeping.keep_frames
            self.kept = await keeping.store.decide(record, event, next_seed, body, patience, keep_frames)
        except GivenUp:  # whoever gave up has undone it
            return
        except BaseException as error:
            with contextlib.suppress(GivenUp):
                self.patience.check()
                self.undo()
            if isinstance(error, StoreUnavailable) and answer.deadline_met:
                asked.caller.live.unsure = asked.frame, next_seed
            raise
        self._remember()
        if self.is_too_late and answer.deadline_met:
            asked.caller.live.late.append(asked.frame)

    def undo(self) -> None:
        """It is not kept: the session is as it was before the frame."""
        live = self.asked.caller.live
        live.unlogged.update(self.unlogged)
        live.late[:0] = self.late
        live.gathering.reopen(self.asked.frame)

    def _event(self, record: SessionRecord, answer: FrameAnswer, next_seed: str) -> FrameAnswered:
        asked, live = self.asked, self.asked.caller.live
        senders = {record.ego_id: asked.ego, **self.present}
        return FrameAnswered(
            **dict(answer),
            seed=record.seed,
            ego_pose=asked.ego.message.pose,
            messages={name: received.proof for name, received in senders.items()},
            previous_frame=None if live.session.previous is None else live.session.previous.frame,
            out_of_time=self.result.out_of_time,
            fault=self.result.fault,
            state=dict(self.result.state),
            unlogged_refusals=dict(self.unlogged),
            late=self.late,
            next_seed_commitment=commitment(next_seed),
            gateway=self.keeping.sessions.moving.name,
        )

    def _remember(self) -> None:
        """What the next frame is judged by."""
        asked, live = self.asked, self.asked.caller.live
        live.allow_more_records()
        live.team_changes, live.unsure = 0, None
        live.session.remember(self.result)
        live.answered, live.ego_proof = asked.frame, asked.ego.proof
        live.gathering.close(asked.frame)
        for name, received in {asked.caller.vehicle_id: asked.ego, **self.present}.items():
            live.motion.moved(name, asked.frame, received.message.pose)


def whole_frame(asked: Asked, present: Present, before: State, after: State) -> bytes:
    """The messages that were decided from, for a replay, and what was remembered before and after."""
    states = {"before": packed_state(before)[1], "after": packed_state(after)[1]}
    messages = {name: received.message for name, received in present.items()}
    signatures = {name: r.signature for name, r in present.items() if r.signature is not None}
    return wire.pack_frame(asked.frame, asked.ego.message, messages, asked.ego.signature, signatures, states)
