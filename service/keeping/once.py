"""What is kept once: secrets, made when they are first asked for, proofs, of which each counts once, and a change that
tells whether changes are taken.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from secrets import token_hex

from sqlalchemy import Connection, Delete, delete, func, insert, literal, select, text

from service.errors import Kind, Refused
from service.keeping.clock import Today
from service.keeping.tables import audit_lines, secrets, sessions, used_proofs
from service.keeping.urls import file_of

MOST_PROOFS = 256
"""Proofs of one vehicle that could still count at a time."""
CLOCKS_APART_S = 300.0
"""So long proofs are remembered that do not count any more: by the clock of another gateway they may."""
LINE_BYTES = 2**16
"""Of a line of a log, with a whole state in it."""
MOST_ROOM = 8 * 2**20
"""More is not written to see whether there is room for it."""

_CHANGED = text(
    "INSERT INTO secrets (name, value) VALUES ('changed', :value) ON CONFLICT (name) DO UPDATE SET value = :value"
)


def secret(connection: Connection, name: str, make: Callable[[], str]) -> str:
    """The secret of a name: what ``make`` gave when it was first asked for."""
    keep = text("INSERT INTO secrets (name, value) VALUES (:name, :value) ON CONFLICT DO NOTHING")
    connection.execute(keep, {"name": name, "value": make()})
    value: str = connection.execute(select(secrets.c.value).where(secrets.c.name == name)).scalar_one()
    return value


def change(connection: Connection, room: int = LINE_BYTES) -> None:
    """Change something that means nothing, where there is room for so many bytes: they are kept, until `changed`.

    A disk is asked first: for twice as much, since what SQLite's journal holds comes into the file as well.
    """
    file = file_of(connection.engine.url)
    if file is not None and shutil.disk_usage(Path(file).absolute().parent).free < 2 * room:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    undone = connection.begin_nested()
    line = literal(token_hex(LINE_BYTES // 2))  # at random, as it may be compressed
    of_any = select(sessions.c.session_id, literal(0), line, Today()).limit(1)
    connection.execute(insert(audit_lines).from_select(["session_id", "seq", "line", "day"], of_any))
    undone.rollback()
    connection.execute(_CHANGED, {"value": token_hex(min(room, MOST_ROOM) // 2)})


def changed(connection: Connection) -> None:
    """Let go of what `change` kept."""
    connection.execute(_CHANGED, {"value": token_hex(16)})


def use_proof(
    connection: Connection, session_id: str, vehicle_id: str, proof_id: str, ends_at: float, now: float
) -> bool:
    """Remember a vehicle's proof until it would not count anyway (Unix time), and for `CLOCKS_APART_S` more; whether it
    is new.

    Raises
    ------
    Refused
        If as many of the vehicle's proofs could still count as may be (``too-many-proofs``).
    """
    of_vehicle = (used_proofs.c.session_id == session_id, used_proofs.c.vehicle_id == vehicle_id)
    connection.execute(delete(used_proofs).where(*of_vehicle, used_proofs.c.ends_at < now - CLOCKS_APART_S))
    counting = select(func.count()).select_from(used_proofs).where(*of_vehicle, used_proofs.c.ends_at >= now)
    if connection.execute(counting).scalar_one() >= MOST_PROOFS:
        raise Refused(Kind.TOO_MANY_PROOFS, f"a vehicle may use {MOST_PROOFS} proofs in about a minute")
    keep = text(
        "INSERT INTO used_proofs (session_id, vehicle_id, proof_id, ends_at) "
        "VALUES (:session_id, :vehicle_id, :proof_id, :ends_at) ON CONFLICT DO NOTHING"
    )
    row = {"session_id": session_id, "vehicle_id": vehicle_id, "proof_id": proof_id, "ends_at": ends_at}
    return connection.execute(keep, row).rowcount == 1


def forget_proofs(session_id: str) -> Delete:
    """The proofs of a session that ends, to be deleted: none can count any more."""
    return delete(used_proofs).where(used_proofs.c.session_id == session_id)
