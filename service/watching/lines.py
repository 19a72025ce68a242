"""Lines for standard error, written apart from those who have them to say: whoever reads them may be slow, or stand."""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections import deque
from collections.abc import Callable
from itertools import groupby
from operator import itemgetter
from typing import TextIO

MOST = 2048
"""Lines that wait to be written; each is short."""


class Lines:
    """Writes lines in the order in which they come, in a thread of its own. What comes while `MOST` wait is lost."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[tuple[TextIO, str]] = deque()
        self._lost = 0
        self._writing = self._stands = False
        self._thread: threading.Thread | None = None

    def put(self, stream: TextIO, line: str, loss: Callable[[int], str]) -> None:
        """Have a line written, and before it the ``loss`` of so many others, if there was one."""
        with self._changed:
            if len(self._waiting) >= MOST:
                self._lost += 1
                return
            if self._lost:
                self._waiting.append((stream, loss(self._lost)))
                self._lost = 0
            self._waiting.append((stream, line))
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._write, name="log", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def flush(self, within_s: float) -> None:
        """Wait until all is written; but only for so long, and not again until there is progress."""
        with self._changed:
            if not self._stands:
                self._stands = not self._changed.wait_for(self._is_done, within_s)

    def _is_done(self) -> bool:
        return not self._waiting and not self._writing

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                batch = list(self._waiting)
                self._waiting.clear()
                self._writing = True
            for stream, lines in groupby(batch, itemgetter(0)):
                _write(stream, "".join(line for _, line in lines))
            with self._changed:
                self._writing = self._stands = False
                self._changed.notify_all()


def _write(stream: TextIO, text: str) -> None:
    """Past the stream's own buffer: its lock would be held as long as nobody reads, and the process could not end."""
    with contextlib.suppress(Exception):  # there is nobody to tell
        try:
            file = stream.fileno()
        except (OSError, ValueError):
            stream.write(text)
            stream.flush()
            return
        data = text.encode(errors="backslashreplace")
        while data:
            try:
                data = data[os.write(file, data) :]
            except BlockingIOError:  # whoever shares it may have made it so
                select.select([], [file], [])
