"""``robosac serve --cluster``: the gateway on Ray Serve, which starts replicas and sends each session to one of them.

Each replica is the same application as ``service.app``, in a process of its own. Ray's router chooses it by a header,
and not by the path. A request of a session without that header is refused: it would come to any replica, and a message
would wait where no ego asks for it.
"""

from __future__ import annotations

import itertools
import os
import queue
import re
import signal
from dataclasses import dataclass
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Scope

from robosac.extras import need
from service.arriving.paths import path_of
from service.errors import Kind, Refused
from service.keeping.urls import file_of, read_url
from service.settings import PREFIX, settings_of_environment

SESSION_HEADER = "x-session-id"
"""What Ray's router reads by default."""
_IN_A_SESSION = re.compile(r"/v1/(?:sessions|live)/([^/]+)")
REQUESTS = 10_000
"""In hand of one replica; streams of vehicles that stand by are among them. What it can decide it knows itself, and
refuses the rest as ``overloaded``."""
DRAIN_S = 8.0
"""How long a replica that is to end may take over what it has; then its streams are cut off."""
STORE_BYTES = 2**28
"""Of Ray's own store of objects, in which nothing of the gateway is."""
RAY = {
    "RAY_USAGE_STATS_ENABLED": "0",  # or Ray tells its makers, over the internet
    "RAY_worker_niceness": "0",  # or all else on the machine goes before the replicas
    "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",  # the proxy and the replicas each do all on one thread
    "RAY_SERVE_ENABLE_DIRECT_INGRESS": "0",  # else chosen with it: nothing would send a session to its replica
    "RAY_SERVE_USE_GRPC_BY_DEFAULT": "0",  # likewise: it stalls for seconds where a replica was killed
}
"""What Ray reads of the environment, where nobody has chosen otherwise."""
ROUTER = "ray.serve.experimental.consistent_hash_router.ConsistentHashRouter"
NAME = "gateway"
LOGS = "/tmp/ray/session_latest/logs/serve"
"""Where Ray puts the replicas' logs, unless it is told otherwise."""


class NotDeployed(RuntimeError):
    """The replicas did not start."""


def check_settings() -> None:
    """Refuse settings with which no replica starts, or of which each replica would make a store of its own.

    Raises
    ------
    ValueError
        It names the variable.
    """
    url = read_url(settings_of_environment().database_url)
    if url.get_backend_name() == "sqlite" and file_of(url) is None:
        raise ValueError("ROBOSAC_DATABASE_URL: replicas need a database that they share, not one in memory")


def check_routed(scope: Scope) -> None:
    """Refuse what is of a session and does not say so to the router, which would send it anywhere.

    Raises
    ------
    Refused
        With the kind ``misrouted``.
    """
    found = _IN_A_SESSION.match(path_of(scope))
    if found is not None and Headers(scope=scope).get(SESSION_HEADER) != found[1]:
        detail = f"the header {SESSION_HEADER} must be the session's id, as the cluster finds the session by it"
        raise Refused(Kind.MISROUTED, detail, SESSION_HEADER)


@dataclass(frozen=True)
class Scale:
    """How many replicas: ``least`` to ``most``, as many as give each no more than so many ``vehicles``.

    A vehicle has about one request in hand: the stream by which it stands by, or the frame that it asks about.
    """

    least: int
    most: int
    vehicles: int


def application(scale: Scale, version: int = 0) -> Any:
    """The gateway as an application of Ray Serve, for ``serve.run``; another version replaces replica by replica."""
    from ray import serve  # noqa: PLC0415 (an extra)
    from ray.serve.config import RequestRouterConfig  # noqa: PLC0415

    options: dict[str, Any] = {"num_replicas": scale.least}
    if scale.most > scale.least:
        bounds = {"min_replicas": scale.least, "max_replicas": scale.most}
        options = {"autoscaling_config": {**bounds, "target_ongoing_requests": scale.vehicles}}
    router = RequestRouterConfig(request_router_class=ROUTER, request_router_kwargs={"num_fallback_replicas": 0})

    deployed = serve.deployment(
        name=NAME,
        max_ongoing_requests=REQUESTS,
        max_queued_requests=REQUESTS,
        backpressure_config={"status_code": 503, "retry_after_s": 1},
        request_router_config=router,
        graceful_shutdown_wait_loop_s=0.1,
        graceful_shutdown_timeout_s=DRAIN_S,
        health_check_period_s=1.0,
        health_check_timeout_s=5.0,
        ray_actor_options={"num_cpus": 1, "runtime_env": {"env_vars": {"GATEWAY_VERSION": str(version)}}},
        **options,
    )
    return deployed(serve.ingress(_gateway)()).bind()


def build(asked: dict[str, Any]) -> Any:
    """As `application`, for the ``import_path`` of a configuration of Ray Serve; its ``args`` are those of `Scale`."""
    return application(Scale(**asked))


def _gateway() -> ASGIApp:
    """Made in the replica itself: what holds a database and a detector does not travel."""
    from service.app import app  # noqa: PLC0415
    from service.arriving.doors import Door  # noqa: PLC0415

    app.add_middleware(Door, check=check_routed)
    return app


def run(host: str, port: int, scale: Scale, address: str | None) -> None:
    """Serve until SIGTERM or Ctrl-C. SIGHUP restarts the replicas, one after another.

    Parameters
    ----------
    host, port
        Where Ray's proxy listens.
    scale : Scale
    address : str, optional
        A Ray cluster that is there; by default one is started, on this machine alone.

    Raises
    ------
    MissingExtra
        If Ray is not installed.
    NotDeployed
        If the replicas do not start.
    """
    need("ray", "a cluster")
    for name, value in RAY.items():
        os.environ.setdefault(name, value)
    import ray  # noqa: PLC0415
    from ray import serve  # noqa: PLC0415

    told: queue.SimpleQueue[int] = queue.SimpleQueue()
    own: dict[str, Any] = {"num_cpus": scale.most, "include_dashboard": False, "object_store_memory": STORE_BYTES}
    environment = {"runtime_env": {"env_vars": _settings()}}
    ray.init(address=address, log_to_driver=False, **environment, **({} if address else own))
    try:
        location = "EveryNode" if address else "HeadOnly"
        serve.start(http_options={"host": host, "port": port, "location": location})
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):  # Ray has set its own by now
            signal.signal(number, lambda number, _: told.put(number))
        for version in itertools.count():
            try:
                serve.run(application(scale, version), name=NAME)
            except RuntimeError as error:
                raise NotDeployed(f"the replicas did not start; their logs tell why, see {LOGS}") from error
            print(f"version {version} at http://{host}:{port}", flush=True)
            if told.get() != signal.SIGHUP:
                return
    finally:
        serve.shutdown()
        ray.shutdown()


def _settings() -> dict[str, str]:
    """The gateway's settings, for replicas on other machines."""
    return {name: value for name, value in os.environ.items() if name.startswith((PREFIX, "OMP_", "OTEL_"))}
