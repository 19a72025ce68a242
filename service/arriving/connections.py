"""Connections that are bounded before a request is whole: uvicorn waits for a head for ever, takes any size of it, and
looks at all that came in one go, however small its pieces are, while everybody else waits.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

from asyncio import TimerHandle, Transport

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from service.arriving.arrival import note_first_byte
from service.arriving.waiting import waited_s

HEAD_BYTES = 64 * 1024
"""What of a head is taken before it is whole; `service.arriving.doors` judges it then."""
HEADERS = 256
PIPELINED = 4
"""Requests that are taken on a connection beside the one that is being answered."""
PIECES, PIECE_BYTES = 1024, 64
"""From so many pieces on, those of a body have so many bytes on average."""


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
    _in_head = False
    _head_ended = False
    _head_bytes = 0
    _pieces = 0
    _body_bytes = 0
    _refused: _TooMuch | None = None
    _unread: TimerHandle | None = None

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        self._waited_s = waited_s(transport)
        super().connection_made(transport)
        self._arm()

    def data_received(self, data: bytes) -> None:
        begins_in_head = self._in_head or self.cycle is None  # and not with the end of a body
        self._head_ended = False
        super().data_received(data)
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
        super().on_header(name, value)
        if len(self.headers) > HEADERS:
            self._refuse("431 Request Header Fields Too Large", f"A head may have {HEADERS} headers.")

    def on_headers_complete(self) -> None:
        self._in_head, self._head_ended, self._head_bytes = False, True, 0
        self._pieces = self._body_bytes = 0
        super().on_headers_complete()
        if len(self.pipeline) > PIPELINED:
            self._refuse("429 Too Many Requests", f"At most {PIPELINED} requests may wait on a connection.")

    def on_body(self, body: bytes) -> None:
        self._pieces += 1
        self._body_bytes += len(body)
        if self._pieces > PIECES and self._body_bytes < self._pieces * PIECE_BYTES:
            self._refuse("400 Bad Request", f"The pieces of a body must have {PIECE_BYTES} bytes on average.")
        super().on_body(body)

    def on_message_complete(self) -> None:
        super().on_message_complete()
        if not self.pipeline:
            self.flow.resume_reading()  # the next request's first byte is to be seen when it comes

    def send_400_response(self, msg: str) -> None:
        if self._refused is None:
            super().send_400_response(msg)
        else:
            self._hang_up(*self._refused.args)

    def connection_lost(self, exc: Exception | None) -> None:
        self._disarm()
        self._forget_unread()
        super().connection_lost(exc)

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

    def _hang_up(self, status: str, why: str) -> None:
        self._disarm()
        if self.transport.is_closing():
            return
        in_body = self._answering() and not self._in_head and not self.pipeline and not self.cycle.response_started
        if in_body:
            self.cycle.disconnected = True  # what it would answer comes too late
        if in_body or (self._in_head and not self._answering()):
            head = f"HTTP/1.1 {status}\r\ncontent-type: text/plain\r\ncontent-length: {len(why)}\r\nconnection: close"
            self.transport.write(f"{head}\r\n\r\n{why}".encode())
        self.transport.close()
