"""``robosac serve``: the gateway on one address."""

from __future__ import annotations

from typing import Annotated

import typer
import uvicorn

HTTP = "service.arriving.connections:BoundedHTTP"
"""By its name, so that uvicorn imports it."""
GRACE_S = 5
"""How long requests in hand may take after a SIGTERM; by their budgets they take less."""
FAILED_START = 3
"""What uvicorn ends with where the application cannot start; it has said why."""


def main(
    host: Annotated[str, typer.Option(help="Address to listen on; other machines need an API key.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8000,
) -> None:
    """Run the gateway, with the settings of the environment (ROBOSAC_...), until SIGTERM or Ctrl-C."""
    try:
        # as uvicorn's own command does, the working directory may hold modules of the user's own detectors
        uvicorn.run("service.app:app", host=host, port=port, http=HTTP, timeout_graceful_shutdown=GRACE_S, app_dir="")
    except SystemExit as end:
        raise SystemExit(2 if end.code == FAILED_START else end.code) from end
