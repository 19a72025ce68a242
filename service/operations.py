"""What operators ask the gateway: whether it lives, is ready, and what it counts."""

from __future__ import annotations

from fastapi import APIRouter, Response

from service import description
from service.callers import GatewayDep
from service.errors import Kind, Refused
from service.keeping.patience import within
from service.problems import documented

STORE_PATIENCE_S = 1.0
"""How long readiness waits for the database."""
operations = APIRouter(tags=["operations"], responses=description.AT_THE_DOORS)
_TEXT = "text/plain; version=0.0.4; charset=utf-8"


@operations.head("/healthz", include_in_schema=False)
@operations.get("/healthz", responses=description.status("alive", "It lives."))
async def healthz() -> dict[str, str]:
    """Whether the process lives."""
    return {"status": "alive"}


@operations.head("/readyz", include_in_schema=False)
@operations.get("/readyz", responses={**description.status("ready", "It is ready."), **documented(503)})
async def readyz(gateway: GatewayDep) -> dict[str, str]:
    """Whether the gateway is warm and able to serve, and its database takes changes."""
    gateway.engine.check_ready()
    gateway.sessions.moving.check_open()
    try:
        await within(gateway.store.ping(), STORE_PATIENCE_S)
    except TimeoutError:
        raise Refused(Kind.NOT_READY, f"the database did not answer within {STORE_PATIENCE_S:g} s") from None
    return {"status": "ready"}


@operations.get("/metrics", response_class=Response, responses=description.METRICS)
async def metrics(gateway: GatewayDep) -> Response:
    """Counters and timings for Prometheus."""
    return Response(gateway.metrics.render(), media_type=_TEXT)
