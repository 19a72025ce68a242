"""Attacks on a gateway by somebody who has a key: each is bounded in time and in number, and says what it was answered.

They run in a process of their own, so that the honest ego's clock does not wait for them.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractContextManager
from enum import StrEnum

import httpx

from clients.hostile import connections, faults, forging, requests, sessions, stolen
from clients.hostile.attacker import BROKEN, STRANGERS, Attacker, Target, strange_frame

__all__ = ["BROKEN", "FAULTS", "FAULTY", "OF_TEAMMATES", "STRANGERS", "Attack", "Target", "run_attack", "strange_frame"]

FAULTY = 0.5
"""Part of the time for which a fault lasts; the rest shows how the gateway recovers."""


class Attack(StrEnum):
    """What an attacker does."""

    IDLE = "idle gathers"
    """Nine sessions wait for teammates that never send."""
    LONG = "long budgets"
    """One session asks for 600 hypotheses within 60 s."""
    MANY = "many sessions"
    """Ten sessions of one key do so at once, one frame after the other."""
    TEAMS = "large teams"
    """Sessions of 63 teammates send whole frames, with the default defence."""
    STALE = "stale frames"
    """Frames of 63 teammates, small when compressed, that are answered already."""
    BODIES = "body flood"
    """Bodies as large as allowed that are no messages, with a good token, some sent very slowly."""
    HEADS = "heads without end"
    """Heads of requests that never end, most of them sent very slowly."""
    SMALL = "small bad messages"
    """A teammate sends messages that are none, as fast as it can."""
    STRANGER = "strangers' messages"
    """Messages and frames for the honest session, and for none, with tokens that are none."""
    OPENING = "sessions in a loop"
    """Sessions are opened and closed."""
    OPENINGS = "large openings"
    """Requests for sessions, as large as allowed, that are wrong in every part."""
    TEAM = "joining and leaving"
    """Teammates join, with keys of their own, and leave."""
    TOKENS = "tokens in a loop"
    """A teammate asks for one token after the other."""
    STREAMS = "streams in a loop"
    """A teammate stands by on one stream after the other."""
    AUDIT = "audit in a loop"
    """A log is read, again and again."""
    METRICS = "metrics in a loop"
    """Whoever has no key at all asks for what is counted."""
    PAGES = "pages in a loop"
    """The description of the API is asked for."""
    VIEWERS = "viewers that do not read"
    """As many as may watch the honest session, and none of them reads."""
    UNREAD = "answers nobody reads"
    """Many connections ask for long answers, and read none."""
    PIPELINE = "pipelined requests"
    """Thousands of requests are sent over each connection before the first answer."""
    CHUNKS = "chunks of a byte"
    """A body in as many chunks as it has bytes."""
    DRIPPING = "bodies byte by byte"
    """A body in as many writes as it has bytes."""
    KNOCKS = "connections in a loop"
    """Connections are made and ended without a word."""
    UPGRADES = "upgrades in a loop"
    """Connections of another protocol are asked for."""
    HEADERS = "thousands of headers"
    """Heads of many short lines."""
    LISTS = "lists in a header"
    """Good messages with an `Accept` of thousands of parts."""
    STOLEN = "stolen tokens"
    """Tokens of vehicles that registered keys, without the keys."""
    FORGED = "forged logs"
    """An operator rewrites a session's log in seven ways, and seals it anew."""
    DATABASE = "locked database"
    """Another process holds the database's write lock."""
    DISK = "full disk"
    """No file of the gateway may grow."""
    STOPPED = "stopped process"
    """The gateway's process stands still."""


_PLAYED: dict[Attack, Callable[[Attacker], Awaitable[object]]] = {
    Attack.IDLE: sessions.idle,
    Attack.LONG: lambda attacker: sessions.long(attacker, 1),
    Attack.MANY: lambda attacker: sessions.long(attacker, sessions.SESSIONS),
    Attack.TEAMS: sessions.large_teams,
    Attack.STALE: sessions.stale,
    Attack.BODIES: connections.flood,
    Attack.HEADS: connections.heads,
    Attack.SMALL: requests.small_messages,
    Attack.STRANGER: requests.strangers,
    Attack.OPENING: requests.opening,
    Attack.OPENINGS: requests.large_openings,
    Attack.TEAM: requests.joining,
    Attack.TOKENS: requests.tokens,
    Attack.STREAMS: connections.streams,
    Attack.AUDIT: requests.audit,
    Attack.METRICS: requests.metrics,
    Attack.PAGES: requests.pages,
    Attack.VIEWERS: connections.viewers,
    Attack.UNREAD: connections.unread,
    Attack.PIPELINE: connections.pipeline,
    Attack.CHUNKS: connections.chunks,
    Attack.DRIPPING: connections.dripping,
    Attack.KNOCKS: connections.knocks,
    Attack.UPGRADES: connections.upgrades,
    Attack.HEADERS: connections.headers,
    Attack.LISTS: sessions.long_accepts,
    Attack.STOLEN: stolen.tokens,
    Attack.FORGED: forging.logs,
}
OF_TEAMMATES = frozenset({Attack.SMALL, Attack.TOKENS, Attack.STREAMS, Attack.CHUNKS, Attack.DRIPPING, Attack.LISTS})
"""Attacks for which nothing is needed but a teammate's token."""
FAULTS: Mapping[Attack, Callable[[Target], AbstractContextManager[None]]] = {
    Attack.DATABASE: faults.locked_database,
    Attack.DISK: faults.full_disk,
    Attack.STOPPED: faults.stopped_process,
}
"""Attacks during which no frame can be answered in time: what counts is what is said then, and what comes after."""


def run_attack(attack: Attack, target: Target, seconds: float) -> Counter[str]:
    """Attack for a time; what was answered, by status."""
    if attack in FAULTS:
        with FAULTS[attack](target):
            time.sleep(FAULTY * seconds)
        return Counter()
    return asyncio.run(_attack(attack, target, seconds))


async def _attack(attack: Attack, target: Target, seconds: float) -> Counter[str]:
    answers: Counter[str] = Counter()
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=target.url, timeout=seconds + 30.0, limits=limits) as http:
        try:
            async with asyncio.timeout(seconds):
                await _PLAYED[attack](Attacker(http, target, answers))
        except TimeoutError:
            pass
    return answers
