"""What a gateway process may take of a database server."""

from __future__ import annotations

from dataclasses import dataclass

UNBOUND = {
    "application_name": "robosac",
    "default_transaction_isolation": "read committed",
    "statement_timeout": "0",
    "lock_timeout": "0",
    "idle_in_transaction_session_timeout": "0",
    "tcp_keepalives_idle": "5",
    "tcp_keepalives_interval": "2",
    "tcp_keepalives_count": "3",
}
"""Settings of a connection that may take as long as it needs to, whatever the server's operator has set.

Whoever changes a session waits for its row, and then sees it as it is. Where transactions are isolated more, they fail.
"""


@dataclass(frozen=True)
class Limits:
    """What a gateway process takes of a PostgreSQL server.

    A process that stands still within a transaction holds a session's row: it is hung up on, so that another can go on.
    """

    connections: int = 10
    statement_s: float = 2.0

    def of_server(self) -> dict[str, str]:
        """Settings of a connection."""
        milliseconds = str(round(self.statement_s * 1e3))
        bounds = {"statement_timeout": milliseconds, "idle_in_transaction_session_timeout": milliseconds}
        return {**UNBOUND, **bounds}
