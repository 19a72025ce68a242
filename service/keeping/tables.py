"""The one schema of SQLite and PostgreSQL; `service.keeping.migrations` brings a database there."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Double, ForeignKey, Index, LargeBinary, MetaData, Table, Text

metadata = MetaData()


def _session_id() -> Column[str]:
    return Column("session_id", ForeignKey("sessions.session_id", ondelete="CASCADE"), primary_key=True)


sessions = Table(
    "sessions",
    metadata,
    Column("session_id", Text, primary_key=True),
    Column("ego_id", Text, nullable=False),
    Column("teammates", Text, nullable=False),  # this and the next four are JSON
    Column("defense", Text, nullable=False),
    Column("token_ids", Text, nullable=False),
    Column("public_keys", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("detector", Text, nullable=False),
    Column("weights_digest", Text),
    Column("calibration_digest", Text),
    Column("latency_budget_ms", Double, nullable=False),
    Column("gather_ms", Double, nullable=False),
    Column("frame_period_ms", Double, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("seed", Text, nullable=False),
    Column("last_frame", BigInteger),
    Column("frames_answered", BigInteger, nullable=False),
    Column("ended_at", Text),
    Column("audit_seq", BigInteger, nullable=False),
    Column("audit_head", Text, nullable=False),
    Column("revision", BigInteger, nullable=False),
    Column("key_id", Text, nullable=False, server_default=""),
    Column("holder", Text, nullable=False, server_default=""),
    Column("touched_at", Double, nullable=False),  # Unix time of the last audit record, or of a later use
    Column("kept_bytes", BigInteger, nullable=False, server_default="0"),
)
_open, _ended = sessions.c.ended_at.is_(None), sessions.c.ended_at.is_not(None)
Index("sessions_open", sessions.c.touched_at, sqlite_where=_open, postgresql_where=_open)
Index("sessions_ended", sessions.c.touched_at, sqlite_where=_ended, postgresql_where=_ended)
_summed = sessions.c.key_id, sessions.c.kept_bytes, sessions.c.ended_at  # the last, or SQLite reads the rows as well
Index("sessions_kept", *_summed, sqlite_where=_ended, postgresql_where=_ended)

audit_lines = Table(
    "audit_lines",
    metadata,
    _session_id(),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("line", Text, nullable=False),
    Column("day", BigInteger, nullable=False, server_default="0"),  # in PostgreSQL a part of the key: see `partitions`
)

kept_messages = Table(
    "kept_messages",
    metadata,
    _session_id(),
    Column("frame", BigInteger, primary_key=True, autoincrement=False),
    Column("body", LargeBinary, nullable=False),
)

secrets = Table(
    "secrets",
    metadata,
    Column("name", Text, primary_key=True),
    Column("value", Text, nullable=False),
)

used_proofs = Table(
    "used_proofs",
    metadata,
    _session_id(),
    Column("vehicle_id", Text, primary_key=True),
    Column("proof_id", Text, primary_key=True),
    Column("ends_at", Double, nullable=False),  # Unix time from when on the proof would not count anyway
)
