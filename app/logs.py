"""Log lines: readable on a terminal, JSON elsewhere; never a secret, never a pose."""

import logging
import sys
from typing import TextIO

import structlog
from structlog.typing import Processor

from app.settings import Settings

_QUIET = ("uvicorn.error", "uvicorn.access", "asyncio", "alembic", "websockets")
"""Libraries that tell of every step; what they warn of is kept."""


def configure_logs(settings: Settings, *, stream: TextIO | None = None) -> None:
    """Send the service's own lines and those of its libraries through one format."""
    target = stream or sys.stderr
    as_json = settings.log_format == "json" or (
        settings.log_format == "auto" and not target.isatty()
    )
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    structlog.configure(
        processors=[
            structlog.stdlib.filter_by_level,
            *shared,
            structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
        ],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=False,
    )
    handler = logging.StreamHandler(target)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                *_renderers(as_json=as_json, colors=target.isatty()),
            ],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(settings.log_level.upper())
    for name in _QUIET:
        logging.getLogger(name).setLevel(logging.WARNING)


def _renderers(*, as_json: bool, colors: bool) -> list[Processor]:
    if as_json:
        return [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    plain = structlog.dev.plain_traceback  # the rich one prints local variables: poses, keys
    return [structlog.dev.ConsoleRenderer(colors=colors, exception_formatter=plain)]
