"""What the trials of a gateway share: options, folders, a gateway to try, how a trial ends, tables and percentiles."""

from __future__ import annotations

import asyncio
import json
import re
import sys
import tempfile
from collections.abc import AsyncIterator, Coroutine, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import httpx
import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from clients.client import API_KEY_VARIABLE, GatewayClient
from clients.errors import AccessDenied, GatewayError
from clients.local_gateway import cancelled_by_sigterm, local_gateway
from robosac.cli import outputs
from robosac.extras import MissingExtra
from robosac.faults import printable
from robosac.figures import need_figures
from robosac.files import write_text

T = TypeVar("T")

MOST_BUDGET_MS = 60_000
"""Longer budgets no gateway grants."""
MOST_SECONDS = 86_400
"""Of a part: a day."""
_KEY = re.compile(r"[A-Za-z0-9._~+/-]+=*")


def checked_url(url: str | None) -> str | None:
    """The URL of a gateway, as an option has it."""
    if url is None:
        return None
    if not url.lower().startswith(("http://", "https://")):
        raise typer.BadParameter(f"must begin with http:// or https://, got {url}")
    try:
        read = httpx.URL(url)
    except (httpx.InvalidURL, ValueError) as error:
        raise typer.BadParameter(f"{url} is no URL: {error}") from error
    if not read.host or not 0 < (read.port or 1) < 2**16:
        raise typer.BadParameter(f"{url} names no {'port' if read.host else 'host'} that there can be")
    return url


def checked_urls(urls: list[str] | None) -> list[str] | None:
    """The URLs of several gateways, as an option that is given several times has them."""
    for url in urls or ():
        checked_url(url)
    return urls


def checked_key(key: str | None) -> str | None:
    """An API key that a header can carry."""
    if key is not None and not _KEY.fullmatch(key):
        raise typer.BadParameter("a key has only A-Z a-z 0-9 . _ ~ + / -, and may have = at its end")
    return key


Url = Annotated[
    str | None, typer.Option(callback=checked_url, help="The gateway; by default one is started for the test.")
]
ApiKey = Annotated[
    str | None,
    typer.Option(envvar=API_KEY_VARIABLE, callback=checked_key, help="Opens sessions, where the gateway asks for one."),
]
Seconds = Annotated[float, typer.Option(min=0.5, max=MOST_SECONDS, help="Length of each part.")]
Budget = Annotated[float, typer.Option(min=1, max=MOST_BUDGET_MS, help="Latency budget.")]
Force = outputs.Force
Out = Annotated[Path | None, typer.Option(help="Folder for the report, a JSON file.")]


def make_folder(path: Path | None, option: str, report: str, force: bool, *, for_pictures: bool = False) -> None:
    """Make an output folder, where one is wanted, before any work is done; a bad one is the option's fault.

    So is one that holds the report already. Ends the program where pictures are wanted and none can be drawn.
    """
    if path is None:
        return
    try:
        if for_pictures:
            need_figures()
    except MissingExtra as missing:
        typer.echo(f"Error: {missing}", err=True)
        raise typer.Exit(2) from missing
    outputs.make_folder(path, option, force, report)


@asynccontextmanager
async def gateway_to_try(
    url: str | None,
    api_key: str | None = None,
    own_key: str | None = None,
    *,
    database_url: str | None = None,
    transport: httpx.AsyncBaseTransport | None = None,
) -> AsyncIterator[tuple[str, GatewayClient]]:
    """A gateway's URL and a client of it, by this transport; without a URL one is started for the block, which asks for
    ``own_key``.
    """
    async with AsyncExitStack() as stack:
        if url is None:
            folder, api_key = Path(stack.enter_context(tempfile.TemporaryDirectory())), own_key
            settings = {} if database_url is None else {"ROBOSAC_DATABASE_URL": database_url}
            url = await stack.enter_async_context(local_gateway(folder / "gateway.log", own_key, settings))
        yield url, await stack.enter_async_context(GatewayClient(url, api_key, transport=transport))


def run(trial: Coroutine[Any, Any, T], console: Console, what: str, *others: type[Exception]) -> T:
    """The outcome of a trial; ends the program where the gateway, whoever waits, or another such error ends it."""
    failures: tuple[type[Exception], ...] = (GatewayError, OSError, *others)

    async def ended_in_order() -> T:
        with cancelled_by_sigterm():
            return await trial

    outputs.spell_what_can_be()
    try:
        return asyncio.run(ended_in_order())
    except asyncio.CancelledError:
        console.print(f"[red]{what} was ended.[/red]")
        sys.exit(143)
    except failures as error:
        unknown = isinstance(error, AccessDenied) and error.status == 401
        hint = f" (by {API_KEY_VARIABLE} or --api-key)" if unknown else ""
        console.print(Text.assemble((f"{what} stopped:", "red"), " ", printable(str(error), lines=True), hint))
        sys.exit(1)


def write(report: Any, out: Path | None, name: str, console: Console) -> None:
    """Write a report to a folder, where one is given, and say so."""
    if out is not None:
        write_text(out / name, json.dumps(report, indent=2) + "\n")
        outputs.tell(console, f"Written: {out / name}")


def percentiles(values: Sequence[float]) -> dict[str, float | None]:
    """The median, 95 % and 99 % of measured figures; None without any."""
    found = np.percentile(values, [50, 95, 99]).tolist() if values else [None] * 3
    return dict(zip(("p50", "p95", "p99"), found, strict=True))


def shown(value: float | None, digits: int) -> str:
    """A figure for a table; a dash without one."""
    return "-" if value is None else f"{value:.{digits}f}"


def a_table(title: str, columns: Sequence[str]) -> Table:
    """An empty table with words on the left and figures beside them."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 0, 0, 1))
    for number, heading in enumerate(columns):
        table.add_column(heading, justify="right" if number else "left", no_wrap=not number)
    return table


def print_whole(console: Console, table: Table) -> None:
    """Print a table without cutting what is in it, however few columns there are: a terminal then breaks the lines."""
    table.width = console.measure(table, options=console.options.update(max_width=1000)).maximum
    console.print(table, crop=False)
