"""Sessions, audit lines, kept messages and secrets."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "sessions",
        sa.Column("session_id", sa.Text, primary_key=True),
        *(
            sa.Column(name, sa.Text, nullable=False)
            for name in ("ego_id", "teammates", "defense", "token_ids", "public_keys", "state", "detector")
        ),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("latency_budget_ms", "gather_ms", "frame_period_ms")),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("seed", sa.Text, nullable=False),
        sa.Column("last_frame", sa.BigInteger),
        sa.Column("frames_answered", sa.BigInteger, nullable=False),
        sa.Column("ended_at", sa.Text),
        sa.Column("audit_seq", sa.BigInteger, nullable=False),
        sa.Column("audit_head", sa.Text, nullable=False),
        sa.Column("revision", sa.BigInteger, nullable=False),
        sa.Column("touched_at", sa.Double, nullable=False),
    )
    for name, condition in (("sessions_open", "ended_at IS NULL"), ("sessions_ended", "ended_at IS NOT NULL")):
        where = sa.text(condition)
        op.create_index(name, "sessions", ["touched_at"], sqlite_where=where, postgresql_where=where)
    for table, key, content in (
        ("audit_lines", "seq", sa.Column("line", sa.Text, nullable=False)),
        ("kept_messages", "frame", sa.Column("body", sa.LargeBinary, nullable=False)),
    ):
        op.create_table(
            table,
            sa.Column(
                "session_id", sa.Text, sa.ForeignKey("sessions.session_id", ondelete="CASCADE"), primary_key=True
            ),
            sa.Column(key, sa.BigInteger, primary_key=True, autoincrement=False),
            content,
        )
    op.create_table(
        "secrets",
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("value", sa.Text, nullable=False),
    )


def downgrade() -> None:
    """Drop the tables, with all that is in them."""
    for table in ("secrets", "kept_messages", "audit_lines", "sessions"):
        op.drop_table(table)
