"""How many bytes are kept of each session, so that what an API key has kept can be summed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_RECORD_BYTES = 2048
"""About what a record of a session takes that is there already: to read all logs would take too long."""


def upgrade() -> None:
    """Add the column, and the index by which it is summed."""
    op.add_column("sessions", sa.Column("kept_bytes", sa.BigInteger, nullable=False, server_default="0"))
    op.execute(f"UPDATE sessions SET kept_bytes = audit_seq * {_RECORD_BYTES}")
    ended = sa.text("ended_at IS NOT NULL")
    of_key = ["key_id", "kept_bytes", "ended_at"]
    op.create_index("sessions_kept", "sessions", of_key, sqlite_where=ended, postgresql_where=ended)


def downgrade() -> None:
    """Drop both."""
    op.drop_index("sessions_kept", "sessions")
    op.drop_column("sessions", "kept_bytes")
