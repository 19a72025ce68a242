"""Pages for people: the live page with what feeds it, and the API's description. They load nothing from elsewhere."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Mapping
from importlib.resources import files
from mimetypes import guess_type
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, Query, Request
from fastapi.openapi.docs import get_redoc_html, get_swagger_ui_html
from fastapi.responses import HTMLResponse, JSONResponse, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from service import description
from service.arriving.bodies import JSON, STREAMED
from service.callers import GatewayDep
from service.schemas import WatchableList
from service.viewing.feed import Feed
from service.viewing.viewers import Viewer

STATIC = Path(__file__).parent / "viewing" / "static"
_FILES = {path.name: path.read_bytes() for path in STATIC.iterdir()}
_COMMON = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_NOWHERE_ELSE = "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
LIVE_HEADERS = {
    **_COMMON,
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    f"connect-src 'self'; {_NOWHERE_ELSE}",
}
API_HEADERS = {
    **_COMMON,
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' "
    f"'unsafe-inline'; img-src 'self' data:; connect-src 'self'; worker-src blob:; {_NOWHERE_ELSE}",
}
"""Both pages of the API hold inline scripts and styles; ReDoc would load a logo from its maker."""
API_FILES = "/api-pages"
OPENAPI = "/openapi.json"

pages = APIRouter(tags=["live"], responses=description.AT_THE_DOORS)
_bearer = HTTPBearer(
    auto_error=False, scheme_name="ViewerToken", description="A viewer's token, where the gateway asks for one."
)


async def _check_viewer(
    gateway: GatewayDep, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> None:
    gateway.viewer_tokens.check(credentials.credentials if credentials else None)


async def _viewer(sid: str, gateway: GatewayDep, _: Annotated[None, Depends(_check_viewer)]) -> AsyncIterator[Viewer]:
    with gateway.feed.watching(sid) as viewer:
        yield viewer


def _file(name: str) -> Response:
    return Response(_FILES[name], media_type=guess_type(name)[0], headers=LIVE_HEADERS)


@pages.get("/", include_in_schema=False)
async def live_page() -> Response:
    """The page that shows what the gateway decides."""
    return _file("index.html")


@pages.get("/live/{name}", include_in_schema=False)
async def live_file(name: str) -> Response:
    """A file of that page."""
    if name not in _FILES:
        raise HTTPException(404)
    return _file(name)


@pages.get("/v1/live", dependencies=[Depends(_check_viewer)], responses=description.WATCHABLE)
async def list_watchable(gateway: GatewayDep) -> WatchableList:
    """Sessions whose latest frames can be watched, the one that was answered last first."""
    return WatchableList.model_validate({"sessions": gateway.feed.sessions()})


@pages.get(
    "/v1/live/{sid}",
    response_class=Response,
    responses=description.WATCHED,
)
async def watch(
    sid: str,
    viewer: Annotated[Viewer, Depends(_viewer)],
    gateway: GatewayDep,
    after: Annotated[int, Query(ge=-1, le=2**53)] = -1,
) -> EventSourceResponse:
    """The session's frames as server-sent events: those that are kept and numbered above `after`, then what comes."""
    return EventSourceResponse(_events(sid, after, viewer, gateway.feed), headers=STREAMED)


async def _events(sid: str, after: int, viewer: Viewer, feed: Feed) -> AsyncIterator[bytes]:
    """What one viewer is sent. Not as FastAPI's own events, which it would encode for each viewer anew."""
    yield _event("session", feed.about(sid))
    yield (await feed.latest(sid, after)).event
    async for batch, dropped in viewer.batches():
        if dropped:
            yield _event("dropped", {"frames": dropped})
        yield KEEPALIVE_COMMENT if batch is None else batch.event
    yield _event("end", {})


def frames_event(text: str) -> bytes:
    """Frames as an event, the same bytes for all who watch."""
    return format_sse_event(event="frames", data_str=text)


def _event(name: str, data: Mapping[str, Any]) -> bytes:
    return format_sse_event(event=name, data_str=json.dumps(data))


def api_pages(app: FastAPI) -> None:
    """Serve what describes an app's API: as OpenAPI, and the pages for people, with all that they load."""
    static = str(files("fastapi_offline") / "static")
    app.mount(API_FILES, StaticFiles(directory=static), name="api-pages")

    written: dict[str, bytes] = {}
    writing = asyncio.Lock()

    @app.get(OPENAPI, include_in_schema=False)
    async def openapi(request: Request) -> Response:
        root = request.scope.get("root_path", "")
        async with writing:
            if root not in written:  # in a thread: to make it takes a tenth of a second, and to write it milliseconds
                written.clear()
                written[root] = await asyncio.to_thread(_described, app, {"servers": [{"url": root}]} if root else {})
        return Response(written[root], media_type=JSON)

    @app.get("/docs", include_in_schema=False)
    async def docs(request: Request) -> Response:
        root = request.scope.get("root_path", "")
        page = get_swagger_ui_html(
            openapi_url=f"{root}{OPENAPI}",
            title=app.title,
            swagger_js_url=f"{root}{API_FILES}/swagger-ui-bundle.js",
            swagger_css_url=f"{root}{API_FILES}/swagger-ui.css",
            swagger_favicon_url=f"{root}/live/icon.svg",
        )
        return _framed(page)

    @app.get("/redoc", include_in_schema=False)
    async def redoc(request: Request) -> Response:
        root = request.scope.get("root_path", "")
        page = get_redoc_html(
            openapi_url=f"{root}{OPENAPI}",
            title=app.title,
            redoc_js_url=f"{root}{API_FILES}/redoc.standalone.js",
            redoc_favicon_url=f"{root}/live/icon.svg",
            with_google_fonts=False,
        )
        return _framed(page)


def _described(app: FastAPI, more: Mapping[str, Any]) -> bytes:
    return bytes(JSONResponse({**app.openapi(), **more}).body)


def _framed(page: HTMLResponse) -> Response:
    page.headers.update(API_HEADERS)
    return page
