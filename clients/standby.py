"""Sending again what a gateway process took and could not pass on, as it ended or its sessions moved elsewhere."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from clients.errors import (
    FrameConflict,
    GatewayError,
    GatewayUnavailable,
    GatewayUnreachable,
    ProtocolError,
    RequestRefused,
)

KEPT_FRAMES = 6
"""Latest messages that can be sent again; the gateway takes no more ahead by default."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.02, 0.5
"""Between two attempts to reach the gateway."""


class Standby:
    """A teammate's side of ``GET .../standby``.

    Parameters
    ----------
    events : callable
        Opens the stream and gives its events.
    send : callable
        Posts a body once more.
    """

    def __init__(
        self,
        events: Callable[[], AsyncIterator[tuple[str, Any]]],
        send: Callable[[bytes], Awaitable[object]],
    ) -> None:
        self._events = events
        self._send = send
        self._sent: OrderedDict[int, tuple[bytes, int]] = OrderedDict()
        self._known: tuple[int, frozenset[int]] | None = None
        self.streams = 0
        """How many were asked for: what a vehicle began to send before the latest may have gone elsewhere."""
        self.standing = asyncio.Event()
        """Set while the gateway knows that the vehicle stands by."""
        self.sent_again: list[int] = []
        """Frames."""

    async def sent(self, frame: int, body: bytes, streams: int) -> None:
        """A message was taken by the gateway, which the vehicle began to send when so many ``streams`` were asked for.

        If the stream ended meanwhile, nobody knows which process took it, and it is sent again.
        """
        self._sent[frame] = body, streams
        if len(self._sent) > KEPT_FRAMES:
            self._sent.popitem(last=False)
        if self._known is not None and streams < self.streams:
            await self._send_again({frame: body}, *self._known)

    async def run(self) -> None:
        """Stand by until the session is over, or the token is worth nothing any more."""
        pause_s = FIRST_PAUSE_S
        while True:
            self.streams += 1  # what is sent from now on goes where the stream goes, or later
            stood = False
            try:
                async for event, said in self._events():
                    if event == "standing":
                        self._known = _known(said)
                        before = {f: body for f, (body, streams) in self._sent.items() if streams < self.streams}
                        await self._send_again(before, *self._known)
                        stood, pause_s = True, FIRST_PAUSE_S
                        self.standing.set()
                if stood:
                    continue
            except (GatewayUnreachable, GatewayUnavailable, ProtocolError):
                pass
            except RequestRefused:
                return
            finally:
                self._known = None
                self.standing.clear()
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    async def _send_again(self, bodies: dict[int, bytes], answered: int, waiting: frozenset[int]) -> None:
        for frame, body in sorted(bodies.items()):
            if frame > answered and frame not in waiting:
                try:
                    await self._send(body)
                except FrameConflict:  # answered meanwhile
                    continue
                except GatewayError:  # the next stream tells what is still to be sent
                    return
                self.sent_again.append(frame)


def _known(said: dict[str, Any]) -> tuple[int, frozenset[int]]:
    try:
        return int(said["answered"]), frozenset(said["waiting"])
    except (TypeError, KeyError, ValueError) as error:
        raise ProtocolError("not what a gateway says to whoever stands by") from error
