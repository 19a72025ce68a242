"""Connections that are bounded before a request is whole: uvicorn waits for a head for ever, takes any size of it, and
looks at all that came in one go, however small its pieces are, while everybody else waits.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

import re
import time
from asyncio import TimerHandle, Transport
from collections.abc import Sequence

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from service.arriving.arrival import note_first_byte
from service.arriving.metering import METER, Meter
from service.arriving.pacing import KEY, OTHERS, Pacing, Party
from service.arriving.waiting import waited_s, waits

HEAD_BYTES = 64 * 1024
"""What of a head is taken before it is whole; `service.arriving.doors` judges it then."""
HEADERS = 256
PIPELINED = 4
"""Requests that are taken on a connection beside the one that is being answered."""
PIECES, PIECE_BYTES = 128, 64
"""From so many pieces on, those of a body have so many bytes on average."""
AROUND_BYTES = 64 * 1024
"""What may come between the pieces of a body, as their lengths do: so much, or as much as the body has."""


_CREDENTIAL = re.compile(rb"\r\nAuthorization:[ \t]*((?:Bearer|DPoP) [^\r\n]{1,4096})\r\n", re.IGNORECASE)


class _TooMuch(Exception):
    """What is not taken: a status, and why."""


class BoundedHTTP(HttpToolsProtocol):
    """HTTP of uvicorn, for its option ``http``; hangs up on whoever takes too long, or sends too much, before there is
    a request to answer, and on whoever does not read what is answered.

    The time runs from when a connection is made, or from the first byte after a request is answered, until a whole head
    is in. (How long nothing at all may come after an answer is for ``--timeout-keep-alive`` to say, and how long a body
    may take for the gateway.)
    """

    head_timeout_s = 10.0
    unread_timeout_s = 30.0
    """How long a client may take nothing of what waits for it. To close a connection would wait for it for ever."""

    _waited_s = 0.0
    _deadline: TimerHandle | None = None
    _in_head = _in_body = False
    _head_ended = False
    _head_bytes = 0
    _pieces = 0
    _body_bytes = _around_bytes = 0
    _refused: _TooMuch | None = None
    _unread: TimerHandle | None = None
    _kept = b""
    _kept_since = 0.0
    """What came while others had to be served, and when; nothing more is read meanwhile."""
    _unanswered: Sequence[RequestResponseCycle] = ()
    """Requests: to answer them once the connection is closed would be a fault, though nobody is to blame for it."""
    _pacing: Pacing | None = None
    party: Party = (OTHERS, "")

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        self._waited_s = waited_s(transport)
        super().connection_made(transport)
        self._arm()
        self._pacing = self.app_state.get(KEY)
        if self._pacing is not None:
            self.party = self._pacing.party_of({"client": self.client, "headers": []})
            self._pacing.had_since(self.party)

    def data_received(self, data: bytes) -> None:
        pacing = self._pacing
        if pacing is None:
            self._take(data)
            return
        self._look_whose(data, pacing)
        if not pacing.is_over(self.party):
            self._take_metered(data, pacing)
        elif pacing.wait(self, len(data)):
            self._unset_keepalive_if_required()
            self._kept, self._kept_since = data, time.perf_counter()
            self.transport.pause_reading()
            pacing.had_since(self.party)
        else:
            self.transport.abort()

    @property
    def is_gone(self) -> bool:
        """As `service.arriving.pacing.Paced` has it."""
        return self.transport.is_closing()

    def go_on(self, pacing: Pacing) -> None:
        """As `service.arriving.pacing.Paced` has it."""
        data, self._kept = self._kept, b""
        self._waited_s += time.perf_counter() - self._kept_since
        self._take_metered(data, pacing)
        if self.transport.is_closing():
            return
        if waits(self.transport):
            self._waited_s = time.perf_counter() - self._kept_since  # so long at most
        if not self.flow.read_paused:
            self.transport.resume_reading()

    def _look_whose(self, data: bytes, pacing: Pacing) -> None:
        """See whose a request is, before anything is done for it: by the credential, if it is in the first bytes."""
        if self._in_head or self._in_body:
            return
        found = _CREDENTIAL.search(data, 0, HEAD_BYTES)  # if none, a proxy may send for somebody else than before
        headers = [(b"authorization", found[1])] if found else []
        self.party = pacing.party_of({"client": self.client, "headers": headers})

    def _take_metered(self, data: bytes, pacing: Pacing) -> None:
        self._take(data)
        if self._in_head or self.cycle is not None:
            self._waited_s = 0.0  # what comes next did not wait
        pacing.had_since(self.party)

    def _take(self, data: bytes) -> None:
        begins_in_head = self._in_head or self.cycle is None  # and not with the end of a body
        begins_in_body, before = self._in_body, self._body_bytes
        self._head_ended = False
        super().data_received(data)
        if begins_in_body and self._in_body and not self._head_ended:
            self._around_bytes += max(0, len(data) - (self._body_bytes - before))
            if self._around_bytes > max(AROUND_BYTES, self._body_bytes):
                self._hang_up("400 Bad Request", "What is between the pieces of a body must be shorter than they are.")
        if begins_in_head and not self._head_ended:
            self._head_bytes += len(data)
        if self._answering():
            self._disarm()
        elif self._deadline is None:
            self._arm()
        if self._in_head and self._head_bytes > HEAD_BYTES:
            self._hang_up("431 Request Header Fields Too Large", f"A head may have {HEAD_BYTES} bytes.")

    def on_message_begin(self) -> None:
        self._in_head = True
        super().on_message_begin()
        note_first_byte(self.scope["state"], self._waited_s)
        self._waited_s = 0.0

    def on_header(self, name: bytes, value: bytes) -> None:
        if self._in_body:  # a trailer field: nothing of it may count as of the head, by which a request is let in
            self._count_piece(0)
            return
        super().on_header(name, value)
        if len(self.headers) > HEADERS:
            self._refuse("431 Request Header Fields Too Large", f"A head may have {HEADERS} headers.")

    def on_headers_complete(self) -> None:
        self._in_head, self._in_body, self._head_ended, self._head_bytes = False, True, True, 0
        self._pieces = self._body_bytes = self._around_bytes = 0
        super().on_headers_complete()
        self._unanswered = [cycle for cycle in (*self._unanswered, self.cycle) if not cycle.response_complete]
        if self._pacing is not None:
            self.scope["state"][METER] = Meter(self._pacing, self.party)
        if len(self.pipeline) > PIPELINED:
            self._refuse("429 Too Many Requests", f"At most {PIPELINED} requests may wait on a connection.")

    def on_body(self, body: bytes) -> None:
        self._count_piece(len(body))
        super().on_body(body)

    def _count_piece(self, size: int) -> None:
        self._pieces += 1
        self._body_bytes += size
        if self._pieces > PIECES and self._body_bytes < self._pieces * PIECE_BYTES:
            self._refuse("400 Bad Request", f"The pieces of a body must have {PIECE_BYTES} bytes on average.")

    def on_message_complete(self) -> None:
        self._in_body = False
        super().on_message_complete()
        if not self.pipeline:
            self.flow.resume_reading()  # the next request's first byte is to be seen when it comes

    def _should_upgrade_to_ws(self) -> bool:
        return False  # an upgrade would pass by all bounds, and the gateway has no use for one

    def _unsupported_upgrade_warning(self) -> None:
        """Say nothing: whoever asks for an upgrade is answered in HTTP/1.1."""

    def send_400_response(self, msg: str) -> None:
        if self._refused is None:
            super().send_400_response(msg)
        else:
            self._hang_up(*self._refused.args)

    def connection_lost(self, exc: Exception | None) -> None:
        self._disarm()
        self._forget_unread()
        self._give_up()
        super().connection_lost(exc)
        if self._pacing is not None:
            self._pacing.had_since(self.party)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch_unread()

    def resume_writing(self) -> None:
        self._forget_unread()
        super().resume_writing()

    def _answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _arm(self) -> None:
        self._deadline = self.loop.call_later(
            self.head_timeout_s, self._hang_up, "408 Request Timeout", "The head did not come in time."
        )

    def _disarm(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _watch_unread(self) -> None:
        waits = self.transport.get_write_buffer_size()
        self._unread = self.loop.call_later(self.unread_timeout_s, self._look_at_unread, waits)

    def _look_at_unread(self, before: int) -> None:
        """Cut the connection off if nothing was taken since then; what waits for it is lost."""
        if self.transport.get_write_buffer_size() < before:
            self._watch_unread()
        else:
            self.transport.abort()

    def _forget_unread(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _refuse(self, status: str, why: str) -> None:
        """Let the parser stop; it then has a 400 sent."""
        self._refused = _TooMuch(status, why)
        raise self._refused

    def _give_up(self) -> None:
        for cycle in self._unanswered:
            cycle.disconnected = True
            cycle.message_event.set()

    def _hang_up(self, status: str, why: str) -> None:
        self._disarm()
        if self.transport.is_closing():
            return
        in_body = self._answering() and not self._in_head and not self.pipeline and not self.cycle.response_started
        self._give_up()
        if in_body or (self._in_head and not self._answering()):
            head = f"HTTP/1.1 {status}\r\ncontent-type: text/plain\r\ncontent-length: {len(why)}\r\nconnection: close"
            self.transport.write(f"{head}\r\n\r\n{why}".encode())
        self.transport.close()
