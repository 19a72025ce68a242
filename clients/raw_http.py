"""HTTP by hand, for what no library would send."""

from __future__ import annotations

import asyncio


async def read_response(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """A response's status and body.

    Raises
    ------
    asyncio.IncompleteReadError
        If the connection ends before the response does.
    ValueError
        If it is none.
    """
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
    fields = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in head[1:] if line)}
    status = int(head[0].split(" ", 2)[1])
    return status, await reader.readexactly(int(fields.get("content-length", 0)))
