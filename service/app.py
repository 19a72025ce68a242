"""The ASGI application: ``uvicorn service.app:app``."""

from __future__ import annotations

from service.runtime import tune_process

tune_process()  # before anything imports torch

import asyncio  # noqa: E402
import contextlib  # noqa: E402
from collections.abc import AsyncIterator, Callable  # noqa: E402
from importlib.metadata import version  # noqa: E402

from fastapi import FastAPI  # noqa: E402

from service import problems  # noqa: E402
from service.engine import Engine  # noqa: E402
from service.frames import Frames  # noqa: E402
from service.gateway import Gateway  # noqa: E402
from service.limits import BodyLimit  # noqa: E402
from service.metrics import Metrics  # noqa: E402
from service.routes import operations, v1  # noqa: E402
from service.sessions import Sessions  # noqa: E402
from service.settings import Settings  # noqa: E402
from service.store import MemoryStore, new_seed  # noqa: E402


def create_app(settings: Settings | None = None, seeds: Callable[[], str] = new_seed) -> FastAPI:
    """A gateway.

    Parameters
    ----------
    settings : Settings, optional
        From the environment by default.
    seeds : callable
        Seed of each frame's draws, hexadecimal; from the operating system by default. Set it only for tests: whoever
        knows the seed knows which subsets will be sampled.
    """
    settings = settings or Settings()
    engine = Engine(settings.torch_threads, settings.extra_detectors)
    metrics = Metrics()
    sessions = Sessions(settings, MemoryStore(), engine, metrics, seeds)
    gateway = Gateway(engine, metrics, sessions, Frames(settings, sessions, engine, metrics))

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await engine.start()
        if settings.detector not in engine.detectors:
            raise ValueError(
                f"ROBOSAC_DETECTOR: unknown detector {settings.detector!r}; known: {list(engine.detectors)}"
            )
        sweeper = asyncio.create_task(sessions.expire_idle())
        try:
            yield
        finally:
            sweeper.cancel()
            engine.stop()

    app = FastAPI(
        title="Defense gateway for collaborative perception",
        summary="Fuses teammates' feature maps that the ego's own perception does not contradict.",
        version=version("robosac"),
        lifespan=lifespan,
        redirect_slashes=False,
    )
    app.state.gateway = gateway
    problems.install(app)
    app.add_middleware(BodyLimit, limit=settings.max_body_bytes)
    app.include_router(v1)
    app.include_router(operations)
    return app


app = create_app()
