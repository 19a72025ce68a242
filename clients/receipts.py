"""What a client keeps of a gateway's promises: every answer comes with the signed end of the log that it is in."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

from clients.errors import ProtocolError
from robosac.answers import LogReceipt
from robosac.audit.receipts import ReceiptError, by_id, check_receipt


class ReceiptBook:
    """Checks receipts, and keeps them in a file.

    Parameters
    ----------
    ask : callable
        Gives the gateway's public keys as it publishes them.
    pinned : sequence of str, optional
        The gateway's public keys (base64) from a better source; then no others count, and every answer must have a
        receipt. By default what the gateway publishes is believed.
    file : Path, optional
        Where receipts are added to, a line each, for ``robosac audit verify --receipts``.
    """

    def __init__(
        self, ask: Callable[[], Awaitable[Sequence[str]]], pinned: Sequence[str] | None, file: Path | None
    ) -> None:
        self._ask = ask
        self._pinned = pinned is not None
        self._keys = by_id(pinned or ())
        self._file = file
        self._latest: dict[str, LogReceipt] = {}

    def latest(self, session_id: str) -> LogReceipt | None:
        """The receipt that promises most of a session's log."""
        return self._latest.get(session_id)

    def promised(self, session_id: str) -> int:
        """The number of the latest record of a session's log that was promised; 0 if none was."""
        latest = self._latest.get(session_id)
        return 0 if latest is None else latest.seq

    async def take(self, receipt: LogReceipt | None, session_id: str, after: int = 0) -> None:
        """Check a receipt, and keep it.

        Parameters
        ----------
        receipt : LogReceipt or None
            That of an answer, if it has one.
        session_id : str
        after : int
            The record has a higher number than this: what was `promised` before a request that adds a record. A gateway
            that gives an old receipt again and again promises nothing.

        Raises
        ------
        ProtocolError
            If it was not signed by the gateway, is of another session or of no later record, contradicts an earlier
            one, or is missing though keys are pinned.
        """
        if receipt is None:
            if self._pinned:
                raise ProtocolError("the answer has no receipt")
            return
        if receipt.key_id not in self._keys and not self._pinned:
            try:
                self._keys = self._keys | by_id(await self._ask())
            except ValueError as error:
                raise ProtocolError(f"the gateway publishes what is no key: {error}") from error
        try:
            check_receipt(receipt, self._keys)
        except ReceiptError as error:
            raise ProtocolError(f"a receipt that proves nothing: {error}") from error
        before = self._latest.get(session_id)
        if receipt.session != session_id:
            raise ProtocolError(f"the receipt is of session {receipt.session:.64}")
        if receipt.seq <= after:
            raise ProtocolError(f"the receipt is of record {receipt.seq}, and record {after} was promised before")
        if before is not None and before.seq == receipt.seq and before.head != receipt.head:
            raise ProtocolError(f"the gateway signed two heads of record {receipt.seq}: {before.head}, {receipt.head}")
        if before is None or receipt.seq > before.seq:
            self._latest[session_id] = receipt
        if self._file is not None:
            _add_line(self._file, receipt.model_dump_json())


def _add_line(file: Path, line: str) -> None:
    """Add a line to a file whose last one may be torn, as by a process that was killed."""
    with file.open("ab+") as kept:
        torn = False
        if kept.seek(0, os.SEEK_END):
            kept.seek(-1, os.SEEK_END)
            torn = kept.read() != b"\n"
        kept.write(b"\n" * torn + line.encode() + b"\n")
