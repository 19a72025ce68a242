"""A gateway is one process: of several that share the socket of their port, all but the first are refused.

A teammate's message waits in the memory of the process that received it. Servers such as ``uvicorn --workers 2`` let
the system choose the process of each connection, so half of the messages would wait where no ego asks for them.
"""

from __future__ import annotations

import errno
import os
import socket
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_OPEN_FILES = Path("/proc/self/fd")
_HELD = (errno.EACCES, errno.EAGAIN)


class SharedSocket(ValueError):
    """Another gateway process accepts connections from the same socket."""


def check_alone() -> None:
    """See that no other gateway has the sockets for connections that this process was given.

    A lock is put on each (POSIX, ``fcntl``). It belongs to this process alone, though others hold the same socket, and
    goes with it. A worker that is replaced, such as by ``uvicorn --reload``, is in nobody's way. A socket that the
    server opens by itself afterwards is nobody else's. Only Linux can tell; elsewhere nothing is checked.

    Raises
    ------
    SharedSocket
        If another process has locked one of them.
    """
    if sys.platform != "linux":
        return
    import fcntl  # noqa: PLC0415 (not there on Windows)

    for number in _given_sockets():
        with _borrowed(number) as given:
            if not _is_for_connections(given):
                continue
            try:
                fcntl.lockf(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in _HELD:
                    raise SharedSocket(_advice(given.getsockname())) from None


def _given_sockets() -> Iterator[int]:
    for path in _OPEN_FILES.iterdir():
        number = int(path.name)
        try:
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                yield number
        except OSError:  # the listing's own descriptor is closed by now
            continue


@contextmanager
def _borrowed(number: int) -> Iterator[socket.socket]:
    """A descriptor as a socket, not closed afterwards: to close any one of a socket would drop the lock on it."""
    borrowed = socket.socket(fileno=number)
    try:
        yield borrowed
    finally:
        borrowed.detach()


def _is_for_connections(given: socket.socket) -> bool:
    """Whether a socket has an address and no peer: some servers listen only once the gateway has started."""
    if given.type != socket.SOCK_STREAM or given.family not in (socket.AF_INET, socket.AF_INET6, socket.AF_UNIX):
        return False
    try:
        given.getpeername()
    except OSError:
        name = given.getsockname()
        return bool(name[1] if isinstance(name, tuple) else name)
    return False


def _advice(address: object) -> str:
    where = ":".join(map(str, address[:2])) if isinstance(address, tuple) else address
    return (
        "start one worker (no --workers, no WEB_CONCURRENCY); docs/scaling.md has how several gateways share the work. "
        f"Another worker serves {where} already, and teammates' messages wait in the memory of one process"
    )
