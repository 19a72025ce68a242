"""The ASGI application: ``uvicorn service.app:app``."""

from __future__ import annotations

from service.runtime import tune_process

tune_process()  # before anything imports torch

import asyncio  # noqa: E402
import contextlib  # noqa: E402
from collections.abc import AsyncIterator, Callable  # noqa: E402
from importlib.metadata import version  # noqa: E402
from typing import TYPE_CHECKING  # noqa: E402

import structlog  # noqa: E402
from fastapi import FastAPI  # noqa: E402

from robosac.extras import MissingExtra  # noqa: E402
from service import problems  # noqa: E402
from service.arriving.frames import Frames  # noqa: E402
from service.arriving.limits import BodyLimit, HeadLimit  # noqa: E402
from service.deciding.admission import Admission, Gate  # noqa: E402
from service.deciding.answering import Deciding  # noqa: E402
from service.engine import Engine  # noqa: E402
from service.gateway import Gateway  # noqa: E402
from service.keeping.sql_store import SqlStore  # noqa: E402
from service.keeping.store import new_seed  # noqa: E402
from service.routes import operations, v1  # noqa: E402
from service.sessions.identity import ApiKeys, LoopbackOnly, Tokens  # noqa: E402
from service.sessions.opening import Opening  # noqa: E402
from service.sessions.sessions import Sessions  # noqa: E402
from service.sessions.teams import Teams  # noqa: E402
from service.settings import Settings  # noqa: E402
from service.watching.logs import logging_to_stderr  # noqa: E402
from service.watching.metrics import Metrics  # noqa: E402
from service.watching.tracing import Traced, Tracing, provider_from_environment  # noqa: E402

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

logger = structlog.stdlib.get_logger(__name__)


def create_app(
    settings: Settings | None = None,
    seeds: Callable[[], str] = new_seed,
    spans: TracerProvider | None = None,
) -> FastAPI:
    """A gateway.

    Parameters
    ----------
    settings : Settings, optional
        From the environment by default.
    seeds : callable
        Seed of each frame's draws, hexadecimal; from the operating system by default. Set it only for tests: whoever
        knows the seed knows which subsets will be sampled.
    spans : TracerProvider, optional
        Takes the traces; by default what the environment says, see `service.watching.tracing`.
    """
    settings = settings or Settings()
    engine = Engine(settings.torch_threads, settings.extra_detectors)
    metrics = Metrics()
    store = SqlStore(settings.database_url)
    keys = ApiKeys.read(settings)
    api_keys, tokens = ApiKeys(keys), Tokens.configured(settings)
    sessions = Sessions(settings, store, engine, metrics, tokens, seeds)
    teams = Teams(settings, sessions, store, tokens)
    admission = Admission()
    tracing = Tracing(provider_from_environment() if spans is None else spans)
    deciding = Deciding(sessions, engine, metrics, admission, tracing)
    frames = Frames(sessions, deciding, metrics, admission)
    opening = Opening(settings, store, engine, metrics, tokens, sessions)
    gateway = Gateway(admission, engine, metrics, opening, sessions, teams, frames, api_keys)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        secrets = [*keys, *(secret.get_secret_value() for secret in settings.token_secrets)]
        with logging_to_stderr(settings, secrets):
            if not api_keys:
                logger.warning("no API key is set (ROBOSAC_API_KEYS): only requests from this machine are served")
            try:
                await asyncio.gather(store.start(), engine.start())
                await tokens.start(store)
                metrics.sessions.set(await store.count())
                if settings.detector not in engine.detectors:
                    raise ValueError(
                        f"ROBOSAC_DETECTOR: unknown detector {settings.detector!r}; known: {list(engine.detectors)}"
                    )
                sweeper = asyncio.create_task(sessions.expire_idle())
                logger.info("gateway ready", version=version("robosac"), detectors=list(engine.detectors))
                try:
                    yield
                finally:
                    sweeper.cancel()
            finally:
                engine.stop()
                await store.close()
                tracing.close()
                logger.info("gateway stopped")

    app = FastAPI(
        title="Defense gateway for collaborative perception",
        summary="Fuses teammates' feature maps that the ego's own perception does not contradict.",
        version=version("robosac"),
        lifespan=lifespan,
        redirect_slashes=False,
    )
    app.state.gateway = gateway
    problems.install(app)
    app.add_middleware(BodyLimit, limit=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
    app.add_middleware(Gate, admission=admission, budget_s=sessions.budget_s)
    if not api_keys:
        app.add_middleware(LoopbackOnly)
    app.add_middleware(Traced, tracing=tracing)
    app.add_middleware(HeadLimit)
    app.include_router(v1)
    app.include_router(operations)
    return app


try:
    app = create_app()
except MissingExtra as missing:
    raise SystemExit(f"Error: {missing}") from missing
