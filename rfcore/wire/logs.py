"""Logs of the services: readable on a terminal, one JSON object a line anywhere else.

Keys are the same in both: ``vehicle``, ``session``, ``camera``, ``epoch`` and ``seq`` say what a
line is about, ``event`` what happened, and ``reason`` is a word that can be counted.
"""

from __future__ import annotations

import logging
from enum import StrEnum
from typing import TextIO

import structlog

__all__ = ["LogForm", "configure_logs"]


class LogForm(StrEnum):
    """How log lines look; ``auto`` is console on a terminal and json elsewhere."""

    AUTO = "auto"
    CONSOLE = "console"
    JSON = "json"


def configure_logs(stream: TextIO, form: LogForm = LogForm.AUTO, level: int = logging.INFO) -> None:
    """Send structlog's events to ``stream``; called once, by a command's ``main``."""
    renderer: structlog.types.Processor
    on_console = stream.isatty() if form is LogForm.AUTO else form is LogForm.CONSOLE
    if on_console:
        renderer = structlog.dev.ConsoleRenderer(colors=stream.isatty())
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
