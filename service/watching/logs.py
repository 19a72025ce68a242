"""Structured logs: one event a line, with its fields; never tensors, tokens or keys.

An exception is logged without local variables, and all of a line in bounded size: the innermost calls of the latest
exceptions of a chain, each with its message in short (`robosac.faults`). Nobody waits until a line is written.
"""

from __future__ import annotations

import logging
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType

import structlog

from robosac.faults import describe, in_short
from service.settings import Settings
from service.watching.lines import Lines

CHAIN = 3
"""Exceptions that are shown of a chain, from the latest."""
CALLS = 8
"""Calls that are shown of each, from the innermost."""
CALL_CHARS = 240
VALUE_CHARS = 1024
"""What is kept of any other field."""
_OWN = ("service", "robosac")
_RUNTIME = ("asyncio", "concurrent.futures", "sqlalchemy")
_SERVER = ("uvicorn", "uvicorn.error", "uvicorn.access")
_SHARED: list[structlog.types.Processor] = [
    structlog.stdlib.add_log_level,
    structlog.stdlib.add_logger_name,
    structlog.processors.TimeStamper(fmt="iso", utc=True),
]

structlog.configure(
    processors=[
        structlog.stdlib.filter_by_level,
        *_SHARED,
        structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
    ],
    logger_factory=structlog.stdlib.LoggerFactory(),
    cache_logger_on_first_use=True,
)


LINES = Lines()
"""Of this process, on their way to standard error."""
PATIENCE_S = 1.0
"""So long a gateway that ends waits for its last lines to be written."""


class _Stderr(logging.Handler):
    """Has lines written to what is standard error at that moment; ``last``, if the process may end after each."""

    def __init__(self, *, last: bool) -> None:
        super().__init__()
        self._last = last

    def emit(self, record: logging.LogRecord) -> None:
        """Have the record's line written, if there is a standard error."""
        if sys.stderr is None:
            return
        try:
            LINES.put(sys.stderr, f"{self.format(record)}\n", self._lost)
        except Exception:
            self.handleError(record)
        if self._last:
            LINES.flush(PATIENCE_S)

    def _lost(self, number: int) -> str:
        text = f"{number} lines of the log were lost: nobody read those before them"
        return f"{self.format(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))}\n"


def log_as_the_gateway(settings: Settings, secrets: Sequence[str] = ()) -> None:
    """Let a server that logs already do so as the gateway does: it has lines of its own before the start and after the
    end of `logging_to_stderr`.
    """
    handler = _handler(settings, secrets, last=True)
    for logger in map(logging.getLogger, _SERVER):
        if logger.handlers:
            logger.handlers = [handler]


@contextmanager
def logging_to_stderr(settings: Settings, secrets: Sequence[str] = ()) -> Iterator[None]:
    """Write the gateway's and the server's events to standard error for the length of a block, but no such secret."""
    handler = _handler(settings, secrets)
    loggers = [logging.getLogger(name) for name in (*_OWN, *_RUNTIME, *_SERVER)]
    before = [(logger, list(logger.handlers), logger.level, logger.propagate) for logger in loggers]
    for logger in loggers:
        if logger.name in _SERVER:
            if logger.handlers or logger.name == "uvicorn":
                logger.handlers = [handler]
        else:
            logger.addHandler(handler)
            if logger.name in _OWN:
                logger.setLevel(settings.log_level.upper())
    try:
        yield
    finally:
        for logger, handlers, level, propagate in before:
            logger.handlers = handlers
            logger.setLevel(level)
            logger.propagate = propagate
        LINES.flush(PATIENCE_S)


def _handler(settings: Settings, secrets: Sequence[str], *, last: bool = False) -> logging.Handler:
    renderer: structlog.types.Processor = (
        structlog.processors.JSONRenderer() if settings.log_format == "json" else structlog.dev.ConsoleRenderer()
    )
    handler = _Stderr(last=last)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[*_SHARED, _message_in_short],
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                structlog.processors.ExceptionRenderer(_traceback),
                _Bounded(secrets),
                renderer,
            ],
        )
    )
    return handler


class _Bounded:
    """Cuts what is long, and takes known secrets out."""

    def __init__(self, secrets: Sequence[str]) -> None:
        longest_first = sorted(filter(None, secrets), key=len, reverse=True)
        self._secrets = re.compile("|".join(map(re.escape, longest_first))) if longest_first else None

    def __call__(self, _: object, __: str, event: structlog.types.EventDict) -> structlog.types.EventDict:
        return {
            name: self._clean(value, VALUE_CHARS if name != "exception" else CHAIN * (CALLS + 1) * CALL_CHARS)
            for name, value in event.items()
        }

    def _clean(self, value: object, most: int) -> object:
        if not isinstance(value, str):
            return value
        if self._secrets is not None:
            value = self._secrets.sub("<...>", value)
        return value if len(value) <= most else value[: most - 3] + "..."


def _message_in_short(_: object, __: str, event: structlog.types.EventDict) -> structlog.types.EventDict:
    """What the runtime says of a failure holds the failure's own message; of a traceback that stands last."""
    text = event["event"]
    if isinstance(text, str) and text.startswith("Traceback "):
        *calls, said = text.strip().splitlines()
        text = "\n".join([said, *calls[-CALLS:]])
    return {**event, "event": in_short(text)}


def _traceback(exc_info: tuple[type[BaseException], BaseException, TracebackType | None]) -> str:
    """The latest exceptions of a chain, each above its innermost calls, the innermost last."""
    parts: list[str] = []
    error: BaseException | None = exc_info[1]
    for _ in range(CHAIN):
        if error is None:
            break
        calls = traceback.extract_tb(error.__traceback__, limit=-CALLS)
        shown = (f"  {call.filename}:{call.lineno} in {call.name}: {call.line}" for call in calls)
        parts.append("\n".join([describe(error), *(line[:CALL_CHARS] for line in shown)]))
        if isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        else:
            error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return "\nfrom ".join(parts)
