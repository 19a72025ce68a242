"""Connections that are bounded before a request is whole: uvicorn waits for a head for ever, and takes any size of it.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

from asyncio import TimerHandle, Transport

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

HEAD_BYTES = 64 * 1024
"""What of a head is taken before it is whole; `service.arriving.doors` judges it then."""


class BoundedHTTP(HttpToolsProtocol):
    """HTTP of uvicorn, for its option ``http``; hangs up on whoever takes too long, or sends too much, before there is
    a request to answer.

    The time runs from when a connection is made, or from the first byte after a request is answered, until a whole head
    is in. (How long nothing at all may come after an answer is for ``--timeout-keep-alive`` to say, and how long a body
    may take for the gateway.)
    """

    head_timeout_s = 10.0

    _deadline: TimerHandle | None = None
    _in_head = False
    _head_ended = False
    _head_bytes = 0

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
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

    def on_headers_complete(self) -> None:
        self._in_head, self._head_ended, self._head_bytes = False, True, 0
        super().on_headers_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        self._disarm()
        super().connection_lost(exc)

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

    def _hang_up(self, status: str, why: str) -> None:
        self._disarm()
        if self.transport.is_closing():
            return
        if self._in_head and not self._answering():
            head = f"HTTP/1.1 {status}\r\ncontent-type: text/plain\r\ncontent-length: {len(why)}\r\nconnection: close"
            self.transport.write(f"{head}\r\n\r\n{why}".encode())
        self.transport.close()
