"""How long the first request of a connection has waited in the kernel, which knows when its bytes came.

An event loop may take long to accept a connection though it never stands still: uvloop accepts one a round, so a
request on a new connection waits behind all connections that were made before it.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from asyncio import BaseTransport

TOLD = sys.platform == "linux"
"""Whether the kernel tells in the form that is read here: `tcp_info` of Linux."""
LAST_DATA_RECEIVED = 52
"""Where it holds how long ago the latest bytes came, milliseconds, 32 bits."""
BYTES_RECEIVED = 128
"""Where it holds how many came, 64 bits."""
LEAST_S = 0.015
"""What is less is not told: the kernel counts in ticks of up to 10 ms."""


def waited_s(transport: BaseTransport) -> float:
    """For how long, at least, the first bytes of a new connection have waited; 0 if it is short, or nobody knows.

    Parameters
    ----------
    transport : asyncio.BaseTransport
        Nothing was read from it yet. Once something was, more may come, and the kernel tells of that.
    """
    of = transport.get_extra_info("socket") if TOLD else None
    if of is None:
        return 0.0
    with contextlib.suppress(OSError, struct.error):  # no TCP, closed by now, or an old kernel
        told = of.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, BYTES_RECEIVED + 8)
        (milliseconds,), (received,) = (
            struct.unpack_from(form, told, at) for form, at in (("=I", LAST_DATA_RECEIVED), ("=Q", BYTES_RECEIVED))
        )
        return milliseconds / 1e3 if received and milliseconds >= LEAST_S * 1e3 else 0.0
    return 0.0


def waits(transport: BaseTransport) -> bool:
    """Whether bytes of a connection wait to be read, or may."""
    of = transport.get_extra_info("socket")
    if of is None:
        return True
    with contextlib.suppress(OSError, ImportError):
        import fcntl  # noqa: PLC0415 (not there on Windows)
        import termios  # noqa: PLC0415

        number = bytearray(4)
        fcntl.ioctl(of.fileno(), termios.FIONREAD, number)
        return number != bytes(4)
    return True
