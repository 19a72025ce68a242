"""Pieces of work that share a transaction, and each its own fate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

T = TypeVar("T")
Work = Callable[[Connection], T]


class Piece:
    """Work that is done if what comes before the transaction went well."""

    def __init__(self, work: Work[Any], first: Callable[[], object]) -> None:
        self.work, self._first = work, first
        self._failed: Exception | None = None

    def prepare(self) -> None:
        """Do what comes before the transaction."""
        try:
            self._first()
        except Exception as error:  # whoever asked for this piece is told, and nobody else
            self._failed = error

    def __call__(self, connection: Connection) -> Any:
        if self._failed is not None:
            raise self._failed
        return self.work(connection)


def prepare_each(pieces: Sequence[Piece]) -> None:
    """Do what comes before the transaction."""
    for piece in pieces:
        piece.prepare()


def do_each(connection: Connection, pieces: Sequence[Piece]) -> list[Any]:
    """Results, and exceptions of work that is undone; a database error undoes all."""
    if len(pieces) == 1:
        return [pieces[0](connection)]
    outcomes: list[Any] = []
    for piece in pieces:
        try:
            with connection.begin_nested():
                outcomes.append(piece(connection))
        except SQLAlchemyError:
            raise
        except Exception as error:
            outcomes.append(error)
    return outcomes
