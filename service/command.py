"""``robosac serve``: the gateway on one address."""

from __future__ import annotations

import errno
import os
import signal
import socket
from typing import Annotated

import typer
import uvicorn

from robosac.extras import MissingExtra
from service.settings import SettingsError, settings_of_environment

HTTP = "service.arriving.connections:BoundedHTTP"
"""By its name, so that uvicorn imports it."""
GRACE_S = 5
"""How long requests in hand may take after a SIGTERM; by their budgets they take less."""
FAILED_START = 3
"""What uvicorn ends with where the application cannot start; it has said why."""
WORKERS = "WEB_CONCURRENCY"
"""The environment's variable by which uvicorn starts several workers."""
OF_A_CLUSTER = ("replicas", "most_replicas", "vehicles", "address")


def main(
    ctx: typer.Context,
    host: Annotated[str, typer.Option(help="Address to listen on; other machines need an API key.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8000,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="Serve with replicas, on Ray Serve; then SIGHUP restarts them in turn.")
    ] = False,
    replicas: Annotated[int, typer.Option(min=1, help="Of a cluster, at least.")] = 2,
    most_replicas: Annotated[int, typer.Option(min=1, help="At most; more are started as load asks for.")] = 2,
    vehicles: Annotated[int, typer.Option(min=1, help="Vehicles that a replica is to have before that.")] = 100,
    address: Annotated[
        str | None, typer.Option(help="A Ray cluster that is there; by default one is started here.")
    ] = None,
) -> None:
    """Run the gateway, with the settings of the environment (ROBOSAC_...), until SIGTERM, SIGHUP or Ctrl-C."""
    if cluster:
        _serve_on_ray(host, port, (replicas, max(replicas, most_replicas), vehicles), address)
        return
    for name in OF_A_CLUSTER:
        if getattr(ctx.get_parameter_source(name), "name", "DEFAULT") != "DEFAULT":
            raise typer.BadParameter("only with --cluster", param_hint=f"--{name.replace('_', '-')}")
    _check_address(host, port)
    workers = os.environ.get(WORKERS, "")
    if workers.isdecimal() and int(workers) > 1:
        typer.echo(
            f"Error: {WORKERS}: docs/scaling.md has how several gateways share the work; one of them has one "
            f"worker, not {workers}",
            err=True,
        )
        raise typer.Exit(2)
    try:  # before the application is imported, which takes long
        settings_of_environment()
    except SettingsError as fault:
        typer.echo(f"Error: {fault}", err=True)
        raise typer.Exit(2) from fault
    hangup = getattr(signal, "SIGHUP", None)  # not every system has it
    if hangup is not None and signal.getsignal(hangup) is signal.SIG_DFL:  # else, as under nohup, it is passed over
        signal.signal(hangup, lambda *_: signal.raise_signal(signal.SIGTERM))
    try:
        # as uvicorn's own command does, the working directory may hold modules of the user's own detectors
        uvicorn.run(
            "service.app:app",
            host=host,
            port=port,
            http=HTTP,
            workers=1,
            timeout_graceful_shutdown=GRACE_S,
            app_dir="",
        )
    except SystemExit as end:
        raise SystemExit(2 if end.code == FAILED_START else end.code) from end


def _check_address(host: str, port: int) -> None:
    """Refuse an address on which nobody can listen, before anything is loaded."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "no name of a host"
        if isinstance(error, OSError) and error.errno in (errno.EADDRINUSE, errno.EACCES):
            raise typer.BadParameter(f"{port}: {why}", param_hint="--port") from error
        raise typer.BadParameter(f"{host}: {why}", param_hint="--host") from error


def _serve_on_ray(host: str, port: int, scale: tuple[int, int, int], address: str | None) -> None:
    """Serve with replicas; what keeps them from starting is said in a line."""
    from service import cluster as on_ray  # noqa: PLC0415 (others do without)

    try:
        on_ray.check_settings()
    except ValueError as fault:
        typer.echo(f"Error: {fault}", err=True)
        raise typer.Exit(2) from fault
    try:
        on_ray.run(host, port, on_ray.Scale(*scale), address)
    except MissingExtra as missing:
        raise typer.BadParameter(str(missing), param_hint="--cluster") from missing
    except on_ray.NotDeployed as failed:
        typer.echo(f"Error: {failed}", err=True)
        raise typer.Exit(1) from failed
