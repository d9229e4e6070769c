"""Logs of the services: readable on a terminal, one JSON object a line anywhere else."""

from __future__ import annotations

import logging
from typing import TextIO

import structlog

__all__ = ["configure_logs"]


def configure_logs(stream: TextIO, level: int = logging.INFO) -> None:
    """Send structlog's events to ``stream``; called once, by a command's ``main``."""
    renderer: structlog.types.Processor
    if stream.isatty():
        renderer = structlog.dev.ConsoleRenderer()
    else:
        renderer = structlog.processors.JSONRenderer()
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.PrintLoggerFactory(stream),
        cache_logger_on_first_use=False,
    )
