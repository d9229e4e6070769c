"""``rfedge link``: the throughput-limited link as a TCP proxy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff

__all__ = ["Link"]


@dataclass(frozen=True)
class Link:
    """Forward TCP between a vehicle and a server at a limited throughput and with a delay."""

    to: str
    """Where to connect for each accepted connection, HOST:PORT."""
    listen: str = "127.0.0.1:0"
    """Where to accept connections, HOST:PORT; port 0 takes a free one."""
    also: tuple[str, ...] = ()
    """Further servers over the same link, each LISTEN=TO: a radio link shared by several paths."""
    profile: Path | None = None
    """Link profile (TOML, see samples/links): traces, jitter, outages, lost connections."""
    uplink_bps: float | None = None
    """Throughput from the accepting side to `--to`, bit/s; 4e6 without a profile."""
    downlink_bps: float | None = None
    """Throughput of the way back, bit/s; 4e6 without a profile."""
    delay_ms: float | None = None
    """One-way delay in either direction, ms; 20 without a profile."""
    metrics_port: int | None = None
    """Port for Prometheus; 0 takes a free one, none are served without it."""
    metrics_host: str = "127.0.0.1"
    """Address the metrics are served on."""
    report: Path | None = None
    """Write bytes, busy time and timing error here as JSON."""
    ready_file: Path | None = None
    """Write HOST:PORT here once listening."""

    allow_insecure: Annotated[bool, FlagCreatePairsOff] = False
    """Forward plaintext to or from other machines."""

    def run(self) -> None:
        """Forward until SIGTERM or SIGINT."""
        from rfedge.link.proxy import ProxySettings, run_proxy

        run_proxy(
            ProxySettings(
                listen=self.listen,
                to=self.to,
                also=self.also,
                uplink_bps=self.uplink_bps,
                downlink_bps=self.downlink_bps,
                delay_ms=self.delay_ms,
                profile=self.profile,
                metrics_port=self.metrics_port,
                metrics_host=self.metrics_host,
                report=self.report,
                ready_file=self.ready_file,
                allow_insecure=self.allow_insecure,
            )
        )
