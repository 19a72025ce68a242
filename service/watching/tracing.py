"""OpenTelemetry traces, where they are configured: a span for each request, and in it the stages of a frame.

Configured by OpenTelemetry's own environment variables; without ``OTEL_EXPORTER_OTLP_ENDPOINT`` (or its variant for
traces) nothing is recorded and the packages need not be there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from robosac.answers import FrameAnswer

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.trace import Tracer

_ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
_STAGES = ("receive", "gather", "queue", "prepare", "testimony", "ego_only", "hypotheses", "consensus", "store")


def provider_from_environment() -> TracerProvider | None:
    """What records and exports spans; None where the environment names no endpoint.

    Raises
    ------
    ValueError
        If it names one, but the packages are not installed.
    """
    if not any(os.environ.get(name) for name in _ENDPOINTS):
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter  # noqa: PLC0415 (optional)
        from opentelemetry.sdk.resources import Resource  # noqa: PLC0415
        from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
        from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415
    except ImportError as error:
        detail = f"traces are configured, but {error.name} is missing: pip install 'robosac[tracing]'"
        raise ValueError(detail) from error
    provider = TracerProvider(resource=Resource.create({"service.name": "robosac-gateway"}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return provider


class Tracing:
    """Records spans with a provider, or nothing without one."""

    def __init__(self, provider: TracerProvider | None) -> None:
        self._provider = provider
        self.tracer: Tracer | None = provider.get_tracer("robosac") if provider else None

    def frame(self, session_id: str, answer: FrameAnswer, timings_ms: Mapping[str, float]) -> None:
        """Add the stages of an answered frame to the request's span, one after another.

        Decoding and matching of the hypotheses take turns in truth; each is shown as one stretch.
        """
        if self.tracer is None:
            return
        from opentelemetry import trace  # noqa: PLC0415 (optional)

        trace.get_current_span().set_attributes(
            {
                "robosac.session_id": session_id,
                "robosac.frame": answer.frame,
                "robosac.source": answer.source.value,
                "robosac.sampling_steps": answer.sampling_steps,
                "robosac.accepted": len(answer.accepted),
                "robosac.deadline_met": answer.deadline_met,
            }
        )
        spent = [(stage, int(timings_ms.get(stage, 0.0) * 1e6)) for stage in _STAGES]
        start = time.time_ns() - sum(nanoseconds for _, nanoseconds in spent)
        for stage, nanoseconds in spent:
            if nanoseconds:
                self.tracer.start_span(stage, start_time=start).end(start + nanoseconds)
            start += nanoseconds

    def close(self) -> None:
        """Export what is left."""
        if self._provider is not None:
            self._provider.shutdown()


class Traced:
    """Middleware that serves every request within a span, of the caller's trace where its headers name one."""

    def __init__(self, app: ASGIApp, tracing: Tracing) -> None:
        self._app = app
        self._tracer = tracing.tracer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._tracer is None or scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        from opentelemetry import propagate, trace  # noqa: PLC0415 (optional)

        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        attributes = {"http.request.method": scope["method"], "url.path": scope["path"]}
        context = propagate.extract(headers)
        kind = trace.SpanKind.SERVER
        with self._tracer.start_as_current_span(scope["method"], context, kind, attributes) as span:

            async def noting(message: Message) -> None:
                if message["type"] == "http.response.start":
                    span.set_attribute("http.response.status_code", message["status"])
                    route = scope.get("route")
                    if route is not None:
                        span.update_name(f"{scope['method']} {route.path}")
                await send(message)

            await self._app(scope, receive, noting)
