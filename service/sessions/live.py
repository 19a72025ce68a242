"""What a session holds in this process only, and who speaks in it."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

from robosac.audit.events import Proof
from robosac.defenses import DefenseSettings
from robosac.detectors import Detector, Role
from robosac.session import Session
from service.errors import TokenReplaced
from service.keeping.record import SessionRecord
from service.sessions.gathering import Gathering
from service.sessions.motion import Motion
from service.sessions.unread import Unread

RENEWALS = 16
"""Tokens that a vehicle may take in a while, see `service.sessions.teams`."""
REFUSALS_LOGGED = 16
"""Refused messages of one vehicle that get a record each, and one more with each frame; the others are counted. Every
record is a transaction, and the ego's decisions are kept on the same thread.
"""
EQUIVOCATIONS_LOGGED = 4
"""Likewise of its equivocations, whatever else of it was refused."""
QUIET_S = 30.0
"""After so long without a request it is looked whether what waits is of any use."""
STRANGERS = "?"
"""Under which the refusals of all callers without a token that counts are counted: no vehicle is called so."""


@dataclass(frozen=True, eq=False)
class Standing:
    """A vehicle that stands by, until its stream is over."""

    over: asyncio.Event = field(default_factory=asyncio.Event)


@dataclass
class LiveSession:
    """What a session holds in this process only; the lock is held while a frame is answered or the team changes.

    The store is right about what ``session`` remembers; only the previous answer is known to this process alone. It and
    ``ego_proof`` are of the frame ``answered``, the latest that this process answered.
    """

    session: Session
    settings: DefenseSettings
    """Of its defence."""
    detector: Detector
    team: tuple[str, ...]
    public_keys: Mapping[str, str]
    token_ids: Mapping[str, str]
    gathering: Gathering
    motion: Motion
    budget_s: float
    key: str = ""
    """Which API key opened it (`service.sessions.identity.ApiKeys`)."""
    digests: tuple[str | None, str | None] = (None, None)
    """As `service.keeping.record.SessionRecord.digests` when it began here, or its ego took it to these weights."""
    has_other_weights: bool = False
    """Whether the detector has others here than those: the session goes on with them once its ego asks here."""
    answered: int | None = None
    ego_proof: Proof | None = None
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    last_used: float = field(default_factory=time.monotonic)
    unlogged: Counter[str] = field(default_factory=Counter)
    """Refusals without a record of their own since the last decision, by vehicle."""
    refusals: Counter[str] = field(default_factory=Counter)
    """Those with one, less one for each frame since."""
    late: list[int] = field(default_factory=list)
    """Frames whose records say that they were in time, and whose answers were late: the next record tells."""
    unsure: tuple[int, str] | None = None
    """A frame whose record says that it was in time, and the seed drawn with it, where the store failed, and may have
    kept it all the same.
    """
    equivocations: Counter[str] = field(default_factory=Counter)
    """As ``refusals``."""
    renewals: defaultdict[str, deque[float]] = field(
        default_factory=lambda: defaultdict(partial(deque, maxlen=RENEWALS))
    )
    """When each vehicle took its latest tokens here (`time.monotonic`)."""
    team_changes: int = 0
    unread: defaultdict[str, Unread] = field(default_factory=lambda: defaultdict(Unread))
    """Bodies that are not whole yet, by vehicle."""
    settling: asyncio.Task[None] | None = None
    """A decision that nobody waits for any more, and of which the store has not let go yet: it may be kept."""
    recorded: bool | None = None
    """Whether it is one of those that asked to be recorded; None until it is looked in the folder."""
    unrecorded: int = 0
    """Frames that its recording lacks, since the latest that it has."""
    held: bool = False
    """Whether the ego has asked here, and not been seen to ask elsewhere since."""
    standing: dict[str, Standing] = field(default_factory=dict)
    """Vehicles that are told when they have to send again, see `service.sessions.moving`."""
    looked_for: float = 0.0
    """Whether the session has moved away is looked for until then (`time.monotonic`)."""

    def follow(self, record: SessionRecord) -> None:
        """Catch up with what another process did to the session, if one did."""
        ours = self.team, self.public_keys, self.token_ids
        if ours != (record.teammates, record.public_keys, record.token_ids):
            # whoever has another key or token now may have left and joined again: what it has sent does not count
            known = [one for one in record.teammates if self._is_who_it_was(one, record)]
            self.gathering.change_team(known)
            self.gathering.change_team(record.teammates)
            here = {record.ego_id, *record.teammates}
            self.motion.forget_all_but(here)
            for of_vehicles in (self.renewals, self.unread):
                for gone in of_vehicles.keys() - here:
                    del of_vehicles[gone]
            self.team, self.public_keys, self.token_ids = record.teammates, record.public_keys, record.token_ids
        if record.last_frame is not None and record.last_frame > self.gathering.closed:
            self.gathering.close(record.last_frame)
        self.settle(record)
        self.session.state = record.state
        if record.last_frame != self.answered:
            self.session.previous = self.ego_proof = None

    def settle(self, record: SessionRecord) -> None:
        """Find out whether a decision was kept of which the store did not say so: nobody got the answer in time."""
        if self.unsure is not None and self.unsure == (record.last_frame, record.seed):
            self.late.append(self.unsure[0])
            self.unsure = None

    def _is_who_it_was(self, vehicle: str, record: SessionRecord) -> bool:
        same_key = self.public_keys.get(vehicle) == record.public_keys.get(vehicle)
        return same_key and self.token_ids.get(vehicle) == record.token_ids.get(vehicle)

    @property
    def is_quiet(self) -> bool:
        """Whether messages wait, and nobody has come for long."""
        quiet = self.last_used < time.monotonic() - QUIET_S
        return quiet and self.gathering.waits and not self.lock.locked()

    def send_away(self) -> None:
        """The session is elsewhere now, or soon: let those who stand by find it there."""
        self.held = False
        for standing in self.standing.values():
            standing.over.set()

    def count_on(self, before: LiveSession) -> None:
        """Count what there was before since the last decision."""
        self.unlogged, self.refusals, self.equivocations = before.unlogged, before.refusals, before.equivocations
        self.late = before.late
        self.renewals, self.team_changes, self.unsure = before.renewals, before.team_changes, before.unsure
        self.unrecorded = before.unrecorded

    def count_anew(self) -> Counter[str]:
        """``unlogged``, which begins again, unless it is given back."""
        counted, self.unlogged = self.unlogged, Counter()
        return counted

    def allow_more_records(self) -> None:
        """A frame was answered: every vehicle may get one more."""
        self.refusals -= Counter(list(self.refusals))
        self.equivocations -= Counter(list(self.equivocations))


@dataclass(frozen=True)
class Caller:
    """Who speaks: the vehicle that a token belongs to, in the session it belongs to."""

    record: SessionRecord
    live: LiveSession
    vehicle_id: str
    token_id: str
    """Of the token that it came with."""

    @property
    def is_ego(self) -> bool:
        """Whether the ego speaks."""
        return self.vehicle_id == self.record.ego_id

    def check_token(self, now: SessionRecord) -> None:
        """Refuse a caller whose token was good when it was authenticated, and is not in the session as it is now.

        Raises
        ------
        TokenReplaced
            If the token was renewed, or its vehicle has left, even if that has joined again since.
        """
        if now.token_ids.get(self.vehicle_id) != self.token_id:
            raise TokenReplaced

    @property
    def role(self) -> Role:
        """In which role the vehicle speaks."""
        return "ego" if self.is_ego else "teammate"
