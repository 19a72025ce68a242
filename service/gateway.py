"""The parts of a running gateway, for whoever serves or inspects it."""

from __future__ import annotations

from dataclasses import dataclass

from service.arriving.frames import Frames
from service.arriving.limits import Unfinished
from service.arriving.parties import Parties
from service.deciding.admission import Admission
from service.engine import Engine
from service.keeping.gateway_keys import GatewayKeys
from service.keeping.store import Store
from service.recording.recorder import Recorder
from service.sessions.identity import ApiKeys
from service.sessions.opening import Opening
from service.sessions.possession import Possession
from service.sessions.room import Room
from service.sessions.sessions import Sessions
from service.sessions.teams import Teams
from service.sessions.viewers import ViewerTokens
from service.viewing.feed import Feed
from service.watching.metrics import Metrics
from service.watching.stalls import LoopWatch


@dataclass(frozen=True)
class Gateway:
    """One gateway: detectors and their thread, sessions and teams, what answers frames, who may open a session,
    and who may watch one.
    """

    admission: Admission
    keys: GatewayKeys
    engine: Engine
    metrics: Metrics
    store: Store
    opening: Opening
    sessions: Sessions
    teams: Teams
    possession: Possession
    parties: Parties
    frames: Frames
    bodies: Room
    unfinished: Unfinished
    api_keys: ApiKeys
    watch: LoopWatch
    feed: Feed
    viewer_tokens: ViewerTokens
    recorder: Recorder

    def stop(self) -> None:
        """Take nothing new, and send away whoever only listens."""
        self.sessions.drain()
        self.unfinished.give_up()
        self.feed.end()
