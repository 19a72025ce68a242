"""HTTP by hand, for what no library would send."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

from clients.client import MSGPACK


@asynccontextmanager
async def connected(url: str) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection of one's own to a server, for the length of a block."""
    parts = urlsplit(url)
    reader, writer = await asyncio.open_connection(parts.hostname, parts.port or 80)
    try:
        yield reader, writer
    finally:
        writer.close()


def post_head(url: str, path: str, size: int, credential: str | None, media_type: str = MSGPACK, **more: str) -> bytes:
    """The head of a POST with a body of ``size`` bytes; further headers have underscores for hyphens."""
    fields = {"Host": urlsplit(url).netloc, "Content-Type": media_type, "Content-Length": str(size)}
    if credential is not None:
        fields["Authorization"] = f"Bearer {credential}"
    fields |= {name.replace("_", "-"): value for name, value in more.items()}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    return f"POST {path} HTTP/1.1\r\n{lines}\r\n".encode()


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
