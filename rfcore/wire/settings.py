"""Settings that both services take on their command lines, and the form of their logs.

Each group of settings is one box of ``--help``. Option names are flat (``--metrics-port``,
``--tls-cert``), as operators write them in unit files.

Logs are readable lines on a terminal and one JSON object per line elsewhere, with the same keys:
``vehicle``, ``session``, ``camera``, ``epoch`` and ``seq`` say what a line is about, ``event`` what
happened, and ``reason`` is a word that can be counted.
"""

from __future__ import annotations

import logging
import tomllib
from argparse import ArgumentParser
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from typing import Annotated, TextIO

import structlog
from tyro.conf import arg

from rfcore.errors import InvalidInput
from rfcore.files import DECODED_BYTES
from rfcore.raster.renderers import CPU, renderer_isa
from rfcore.wire.tls import TlsFiles

PORT_MAX = 65535
OPTIONS_FILE = arg(metavar="FILE.toml")
NEAR = 0.7
"""Similarity from which an option is named for a key that is none (``difflib``)."""


def words_of_command_line(words: Sequence[str], known: Collection[str]) -> list[str]:
    """Return a service's command line with the options of its ``--config FILE.toml`` in front.

    A key of the file is one of the ``known`` options without its dashes, ``_`` or ``-`` between
    words; true sets a flag, a list gives several values. Options of the command line come later,
    and win. Raises ``InvalidInput`` naming the file and the key that is no option or has no value
    of one.
    """
    finder = ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", nargs="?")
    name = finder.parse_known_args(words)[0].config
    if not name:
        return list(words)
    try:
        options = tomllib.loads(Path(name).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidInput("config", f"{name} cannot be read: {error}") from error
    words_of_file = []
    for key, value in options.items():
        option = key.replace("_", "-")
        if option not in known:
            near = get_close_matches(option, known, 1, NEAR)
            remedy = f"the nearest key is {near[0]}" if near else "keys are options without dashes"
            raise InvalidInput("config", f"{name}: {key}: is no option; {remedy}")
        values = value if isinstance(value, list) else [value]
        if not values or any(isinstance(each, dict | list) for each in values):
            problem = f"{value!r} is no value of an option; tables and empty lists are none"
            raise InvalidInput("config", f"{name}: {key}: {problem}")
        if value is not False:
            words_of_file.append(f"--{option}")
            words_of_file += [] if value is True else [str(each) for each in values]
    return [*words_of_file, *words]


@dataclass(frozen=True)
class MetricsSettings:
    """Address at which Prometheus may collect metrics."""

    port: Annotated[int | None, arg(name="metrics-port")] = None
    """Port for Prometheus; 0 takes a free one. Without it no metrics are served."""
    host: Annotated[str, arg(name="metrics-host")] = "127.0.0.1"
    """Address the metrics are served on."""
    per_vehicle: Annotated[bool, arg(name="metrics-per-vehicle")] = False
    """Tell vehicles apart in the metrics; each costs its own time series."""

    def __post_init__(self) -> None:
        if self.port is not None and not 0 <= self.port <= PORT_MAX:
            raise InvalidInput("metrics_port", f"{self.port} is outside 0..{PORT_MAX}")


@dataclass(frozen=True)
class RenderSettings:
    """Rendering of fields; the pictures do not depend on these options."""

    threads: int = 1
    """Threads per render."""
    isa: str | None = None
    """Instruction set to force (avx512, avx2, scalar); the best of this machine without it."""
    max_field_gb: Annotated[float, arg(name="max-field-gb")] = DECODED_BYTES / 1e9
    """Memory that the splats of a field may take; a small file can hold very many."""
    renderer: Annotated[str, arg(metavar="cpu|opencl[:DEVICE]")] = CPU
    """Draw splats by the CPU, or by an OpenCL device, named by its number or a part of its name;
    `opencl` alone takes the first GPU. A device that makes other bytes than the CPU is refused."""

    @property
    def field_isa(self) -> str | None:
        """Instruction set or OpenCL device with which fields are opened."""
        return renderer_isa(self.renderer, self.isa)

    def check(self) -> None:
        """Raise ``BackendUnavailable`` for what this machine lacks; opens an OpenCL device."""
        from rfcore.raster.native import check_renderer  # numpy, which --help does without

        check_renderer(self.threads, self.field_isa)

    @property
    def max_field_bytes(self) -> int:
        """``max_field_gb`` in bytes."""
        return round(self.max_field_gb * 1e9)

    def __post_init__(self) -> None:
        if not 0.001 <= self.max_field_gb <= 1000:
            raise InvalidInput("max-field-gb", f"{self.max_field_gb:g} is outside 0.001..1000")
        if not 1 <= self.threads <= 256:
            raise InvalidInput("threads", f"{self.threads} is outside 1..256")
        renderer_isa(self.renderer, self.isa)


@dataclass(frozen=True)
class TransportSettings:
    """Certificates of this process and of the authority; plaintext without them."""

    certificate: Annotated[Path | None, arg(name="tls-cert")] = None
    """Certificate of this process (PEM); that of a vehicle names its --vehicle."""
    key: Annotated[Path | None, arg(name="tls-key")] = None
    """Its private key."""
    authority: Annotated[Path | None, arg(name="tls-ca")] = None
    """Certificate of the authority that vouches for the other end."""
    allow_insecure: bool = False
    """Allow plaintext to and from other machines."""

    def __post_init__(self) -> None:
        self.tls()

    def tls(self) -> TlsFiles | None:
        """Return the files mutual TLS needs, or None when plaintext is spoken.

        Raises ``InvalidInput`` when only some of the three are given, or one cannot be used.
        """
        return TlsFiles.of(self.certificate, self.key, self.authority)


class LogForm(StrEnum):
    """Form of log lines; ``auto`` is console on a terminal and json elsewhere."""

    AUTO = "auto"
    CONSOLE = "console"
    JSON = "json"


def configure_logs(stream: TextIO, form: LogForm = LogForm.AUTO) -> None:
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
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.PrintLoggerFactory(stream),
        cache_logger_on_first_use=False,
    )
