"""How much may be kept for an API key, so that nobody fills the disk with sessions that begin and end."""

from __future__ import annotations

from collections import Counter

from service.errors import Kind, Refused
from service.keeping.record import SessionRecord
from service.keeping.store import Store


class LogQuota:
    """Counts what is kept of the sessions of each API key, those included that have ended.

    What all processes keep is looked up now and then (`look`). Until then, what sessions that are opened here and teams
    that change here add is counted, and what frames add is not.

    Parameters
    ----------
    most : int
        Bytes of one key. Where no key is asked for there is no limit.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: Counter[str] = Counter()

    def check(self, key_id: str) -> None:
        """Refuse what would add to a key's logs, but for frames.

        Raises
        ------
        Refused
            With the kind ``key-full``.
        """
        if key_id and self._kept[key_id] >= self._most:
            detail = (
                f"the audit logs of this key's sessions hold {self._kept[key_id]} bytes; from {self._most} on "
                "(ROBOSAC_AUDIT_MAX_BYTES_PER_KEY) none is opened and nobody joins, until the oldest logs are purged"
            )
            raise Refused(Kind.KEY_FULL, detail)

    def add(self, after: SessionRecord, before: SessionRecord | None = None) -> None:
        """Count what a session has grown by."""
        self._kept[after.key_id] += after.kept_bytes - (0 if before is None else before.kept_bytes)

    async def look(self, store: Store) -> None:
        """Find out what is kept now."""
        self._kept = await store.kept_bytes()
