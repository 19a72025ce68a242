"""Who waits for a write, and how long: a decision is kept only while somebody waits for it."""

from __future__ import annotations

import threading

from service.errors import GivenUp


class Patience:
    """Lets either of two threads have the last word on a write: the one that waits for it, or the one that does it.

    The writer asks at the end of its transaction, before the commit. From then on nobody can give up, and whoever waits
    has to find out what came of it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._given_up = False
        self._committing = False

    def give_up(self) -> bool:
        """Wait no longer; whether that was in time, so that nothing is kept."""
        with self._lock:
            self._given_up = not self._committing
            return self._given_up

    def check(self) -> None:
        """Begin no work for nobody.

        Raises
        ------
        GivenUp
        """
        if self._given_up:
            raise GivenUp

    def commit(self) -> None:
        """Let nobody give up from now on.

        Raises
        ------
        GivenUp
            If somebody has.
        """
        with self._lock:
            if self._given_up:
                raise GivenUp
            self._committing = True
