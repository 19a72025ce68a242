"""The ASGI application: ``uvicorn service.app:app``."""

from __future__ import annotations

from service.runtime import keep_what_is_loaded, tune_process

tune_process()  # before anything imports torch

import asyncio  # noqa: E402
import contextlib  # noqa: E402
import itertools  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import AsyncIterator, Callable  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

import structlog  # noqa: E402
from fastapi import FastAPI  # noqa: E402

from robosac import __version__  # noqa: E402
from service import problems  # noqa: E402
from service.alone import check_alone  # noqa: E402
from service.arriving.arrival import Arrival  # noqa: E402
from service.arriving.doors import Door, capacity_check, check_head, check_local, host_check  # noqa: E402
from service.arriving.frames import Frames  # noqa: E402
from service.arriving.giving_way import GivesWay, Line  # noqa: E402
from service.arriving.hanging_up import HangingUp  # noqa: E402
from service.arriving.limits import BodyLimit, Unfinished  # noqa: E402
from service.arriving.metering import Metered  # noqa: E402
from service.arriving.pacing import Pacing  # noqa: E402
from service.arriving.parties import Parties  # noqa: E402
from service.arriving.reading import Reading  # noqa: E402
from service.deciding.admission import KEY_FRAMES, Admission  # noqa: E402
from service.deciding.answering import Deciding  # noqa: E402
from service.deciding.keeping import Keeping  # noqa: E402
from service.description import TAGS, completed  # noqa: E402
from service.engine import Engine  # noqa: E402
from service.gateway import Gateway  # noqa: E402
from service.keeping.gateway_keys import GatewayKeys  # noqa: E402
from service.keeping.limits import Limits  # noqa: E402
from service.keeping.record import new_seed  # noqa: E402
from service.keeping.store import Store  # noqa: E402
from service.keeping.urls import file_of, read_url  # noqa: E402
from service.operations import operations  # noqa: E402
from service.pages import api_pages, frames_event, pages  # noqa: E402
from service.recording.recorder import Recorder  # noqa: E402
from service.routes import v1  # noqa: E402
from service.sessions.identity import ApiKeys, Tokens  # noqa: E402
from service.sessions.opening import Opening  # noqa: E402
from service.sessions.possession import Possession  # noqa: E402
from service.sessions.room import Room  # noqa: E402
from service.sessions.sessions import Sessions  # noqa: E402
from service.sessions.teams import Teams  # noqa: E402
from service.sessions.viewers import ViewerTokens  # noqa: E402
from service.settings import Settings, settings_of_environment  # noqa: E402
from service.viewing.ending import on_stop_signal  # noqa: E402
from service.viewing.feed import Feed  # noqa: E402
from service.watching.logs import log_as_the_gateway, logging_to_stderr  # noqa: E402
from service.watching.metrics import Metrics  # noqa: E402
from service.watching.stalls import LoopWatch  # noqa: E402
from service.watching.starting import Starting, asked_by, blamed_on  # noqa: E402
from service.watching.tracing import Traced, Tracing, provider_from_environment  # noqa: E402

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

logger = structlog.stdlib.get_logger(__name__)


def create_app(
    settings: Settings | None = None,
    seeds: Callable[[], str] = new_seed,
    spans: TracerProvider | None = None,
    clock: Callable[[], float] = time.time,
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
    clock : callable
        Unix time, seconds, by which tokens expire.
    """
    settings = settings or settings_of_environment()
    keys = ApiKeys.read(settings)
    tokens = Tokens(settings, clock)
    tracing = Tracing(provider_from_environment() if spans is None else spans)
    gateway = _built(settings, ApiKeys(keys), tokens, seeds, tracing)
    secrets = [*keys, *(s.get_secret_value() for s in (*settings.token_secrets, *settings.viewer_tokens))]
    log_as_the_gateway(settings, secrets)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        with logging_to_stderr(settings, secrets):
            check_alone()
            if not keys:
                logger.warning("no API key is set (ROBOSAC_API_KEYS): only requests from this machine are served")
            async with _running(gateway, settings, tokens, tracing):
                yield

    app = _App(
        title="Defense gateway for collaborative perception",
        summary="Fuses teammates' feature maps that the ego's own perception does not contradict.",
        version=__version__,
        lifespan=lifespan,
        routes=[*v1.routes, *operations.routes, *pages.routes],  # included, each request would look for its route twice
        redirect_slashes=False,
        openapi_tags=TAGS,
        openapi_url=None,  # FastAPI makes it on the loop; `api_pages` serves it
        docs_url=None,  # these pages load from elsewhere; `api_pages` are the same from here
        redoc_url=None,
    )
    app.state.gateway = gateway
    problems.install(app)
    parties, line = gateway.parties, Line(lambda: gateway.admission.busy)
    app.add_middleware(GivesWay, line=line, party_of=parties, is_vehicle=parties.is_vehicle)
    app.add_middleware(HangingUp)
    app.add_middleware(
        BodyLimit, settings.max_body_bytes, timeout_s=settings.body_timeout_s, unfinished=gateway.unfinished
    )
    app.add_middleware(Door, check=capacity_check(gateway.admission, gateway.sessions.in_use))
    if not keys or settings.allowed_hosts:
        app.add_middleware(Door, check=host_check(settings.hosts))
    if not keys:
        app.add_middleware(Door, check=check_local)
    app.add_middleware(Traced, tracing=tracing)
    app.add_middleware(Door, check=check_head)
    app.add_middleware(Metered, pacing=gateway.frames.reading.pacing)
    app.add_middleware(Arrival, watch=gateway.watch)
    app.add_middleware(Starting)
    api_pages(app)
    return app


class _App(FastAPI):
    """Describes bodies of tensors as those detectors want them that are loaded."""

    def openapi(self) -> dict[str, Any]:
        gateway: Gateway = self.state.gateway
        return completed(super().openapi(), [detector.info for detector in gateway.engine.detectors.values()])


def _built(
    settings: Settings, api_keys: ApiKeys, tokens: Tokens, seeds: Callable[[], str], tracing: Tracing
) -> Gateway:
    engine, metrics = Engine(settings.torch_threads, settings.extra_detectors, settings.device), Metrics()
    admission = Admission(settings.max_hypotheses, engine, KEY_FRAMES if len(api_keys) > 1 else None)
    with asked_by("ROBOSAC_DATABASE_URL"):
        store = Store(
            settings.database_url,
            full_every=settings.audit_full_every,
            most_records=settings.audit_max_records,
            limits=Limits(settings.database_connections, settings.database_statement_s),
        )
    with asked_by("ROBOSAC_RECORD"):
        recorder = Recorder(settings, metrics)
    keys = GatewayKeys(settings.gateway_key_file)
    sessions = Sessions(settings, store, engine, metrics, tokens, keys, len(api_keys) > 1, seeds, recorder.end)
    feed = Feed(store.audit, settings.max_viewers, frames_event)
    keeping = Keeping(sessions, store, settings.keep_frames)
    deciding = Deciding(sessions, keeping, engine, metrics, admission, tracing, feed)
    of_key = settings.max_inflight_bytes_per_key if len(api_keys) > 1 else None  # one key has all to itself
    viewer_tokens = ViewerTokens(settings, open_to_all=not api_keys)
    parties = Parties(api_keys, viewer_tokens, store.seen, tokens.signed)
    pacing = Pacing(parties.of_loop, lambda: itertools.starmap(parties.of_session, admission.wanted_by()))
    return Gateway(
        admission=admission,
        keys=keys,
        engine=engine,
        metrics=metrics,
        store=store,
        opening=Opening(settings, store, engine, metrics, tokens, sessions),
        sessions=sessions,
        teams=Teams(settings, sessions, store, tokens),
        possession=Possession(store, sessions.journal, tokens.clock, settings.public_url),
        parties=parties,
        frames=Frames(sessions, deciding, metrics, admission, settings.max_frame_jump, Reading(engine, pacing)),
        bodies=Room(settings.max_inflight_bytes, of_key, "ROBOSAC_MAX_INFLIGHT_BYTES"),
        unfinished=Unfinished(),
        api_keys=api_keys,
        watch=LoopWatch(),
        feed=feed,
        viewer_tokens=viewer_tokens,
        recorder=recorder,
    )


@contextlib.asynccontextmanager
async def _running(gateway: Gateway, settings: Settings, tokens: Tokens, tracing: Tracing) -> AsyncIterator[None]:
    """Start what a gateway needs, and stop it after the block or when the start fails."""
    store, engine = gateway.store, gateway.engine
    try:
        await blamed_on("ROBOSAC_DEVICE", engine.find_device())
        await asyncio.gather(
            blamed_on("ROBOSAC_DATABASE_URL", store.start(), file_of(read_url(settings.database_url))),
            blamed_on("ROBOSAC_EXTRA_DETECTORS", engine.start()),
        )
        gateway.recorder.start()
        for reads in (tokens.start, gateway.keys.start, gateway.sessions.quota.look):
            await blamed_on("ROBOSAC_DATABASE_URL", reads(store))
        gateway.metrics.sessions.set(await blamed_on("ROBOSAC_DATABASE_URL", store.count()))
        if settings.detector not in engine.detectors:
            known = list(engine.detectors)
            raise ValueError(f"ROBOSAC_DETECTOR: unknown detector {settings.detector!r}; known: {', '.join(known)}")
        keep_what_is_loaded()
        gateway.watch.start()
        sweeper = asyncio.create_task(gateway.sessions.expire_idle())
        logger.info(
            "gateway ready",
            version=__version__,
            detectors=list(engine.detectors),
            device=settings.device,
            gateway=gateway.sessions.moving.name,
        )
        try:
            with on_stop_signal(gateway.stop):
                yield
        finally:
            gateway.stop()
            sweeper.cancel()
            gateway.watch.stop()
    finally:
        engine.stop()
        await gateway.frames.deciding.keeping.close()
        await asyncio.to_thread(gateway.recorder.stop)
        await store.close()
        tracing.close()
        logger.info("gateway stopped")


try:
    app = create_app()
except ValueError as fault:  # a setting, named in the message
    print(f"Error: {fault}", file=sys.stderr)
    raise SystemExit(2) from fault
