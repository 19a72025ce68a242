"""The day on which a line was written; in PostgreSQL, the log in a part for each day."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column. In PostgreSQL what is there becomes the part of day 0: its lines stay where they are."""
    op.add_column("audit_lines", sa.Column("day", sa.BigInteger, nullable=False, server_default="0"))
    if op.get_bind().dialect.name != "postgresql":
        return
    for statement in (
        "ALTER TABLE audit_lines RENAME TO audit_lines_before",
        "ALTER TABLE audit_lines_before DROP CONSTRAINT audit_lines_pkey",
        "ALTER TABLE audit_lines_before ADD CONSTRAINT audit_lines_before_pkey PRIMARY KEY (session_id, seq, day)",
        "CREATE TABLE audit_lines (LIKE audit_lines_before INCLUDING DEFAULTS, PRIMARY KEY (session_id, seq, day), "
        "FOREIGN KEY (session_id) REFERENCES sessions ON DELETE CASCADE) PARTITION BY RANGE (day)",
        "ALTER TABLE audit_lines ATTACH PARTITION audit_lines_before FOR VALUES FROM (MINVALUE) TO (1)",
    ):
        op.execute(statement)


def downgrade() -> None:
    """Put all lines into one table again, and drop the column."""
    if op.get_bind().dialect.name == "postgresql":
        for statement in (
            "ALTER TABLE audit_lines RENAME TO audit_lines_parts",
            "CREATE TABLE audit_lines (session_id text, seq bigint, line text NOT NULL, day bigint)",
            "INSERT INTO audit_lines (session_id, seq, line) SELECT session_id, seq, line FROM audit_lines_parts",
            "DROP TABLE audit_lines_parts",
            "ALTER TABLE audit_lines ADD CONSTRAINT audit_lines_pkey PRIMARY KEY (session_id, seq), "
            "ADD FOREIGN KEY (session_id) REFERENCES sessions ON DELETE CASCADE",
        ):
            op.execute(statement)
    op.drop_column("audit_lines", "day")
