"""``rfedge link``: a throughput-limited link between a real vehicle and a real server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Suppress, arg

from rfcore.errors import InvalidInput
from rfedge.arguments import ADDRESS, JSON

if TYPE_CHECKING:
    from rfcore.link.plan import DirectionPlan, LinkPlan
    from rfcore.wire.address import Address

__all__ = ["SPIN_S", "LinkSettings"]

DEFAULT_BPS = 4e6
DEFAULT_DELAY_MS = 20.0
SPIN_S = 0.0002
"""Time before a release at which the pump stops sleeping and yields in a loop: the kernel's timer
slack of 50 us and the loop's own time. Longer would make the scheduler see a busy process and
interrupt it just when it matters. Many links in one process would spin all the time, so they use
0."""


@dataclass(frozen=True)
class LinkSettings:
    """Forward TCP between a vehicle and a server at a limited throughput and with a delay."""

    to: Annotated[str, ADDRESS]
    """Address to connect to for each accepted connection, HOST:PORT."""
    listen: Annotated[str, ADDRESS] = "127.0.0.1:0"
    """Address to accept connections on, HOST:PORT; port 0 takes a free one."""
    also: Annotated[tuple[str, ...], arg(metavar="LISTEN=TO ...")] = ()
    """Further servers over the same link, each LISTEN=TO: a radio link shared by several paths."""
    profile: Annotated[Path | None, arg(metavar="FILE.toml")] = None
    """Link profile (TOML, see samples/links): traces, jitter, outages, lost connections."""
    uplink_bps: float | None = None
    """Throughput from the accepting side to `--to`, bit/s; 4e6 without a profile."""
    downlink_bps: float | None = None
    """Throughput of the way back, bit/s; 4e6 without a profile."""
    delay_ms: float | None = None
    """One-way delay in either direction, ms; 20 without a profile."""
    loss: Annotated[float | None, arg(metavar="PERCENT")] = None
    """Share of the packets to lose in either direction, percent; also beside a profile. TCP sends
    them again: nothing is damaged, what comes is late and less."""
    loss_burst: Annotated[float, arg(metavar="PACKETS")] = 1.0
    """Packets that `--loss` takes in a row, on average."""
    jitter_ms: Annotated[float | None, arg(metavar="MS")] = None
    """Longest random delay on top of the constant one, in either direction, ms; also beside a
    profile, in place of its jitter. Uniform from 0; what is behind waits."""
    metrics_port: Annotated[int | None, arg(metavar="PORT")] = None
    """Port for Prometheus; 0 takes a free one, none are served without it."""
    metrics_host: Annotated[str, arg(metavar="HOST")] = "127.0.0.1"
    """Address the metrics are served on."""
    report: Annotated[Path | None, JSON] = None
    """Write bytes, busy time and timing error here as JSON."""
    ready_file: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write HOST:PORT here once listening."""
    allow_insecure: bool = False
    """Forward plaintext to or from other machines."""
    spin_s: Annotated[float, Suppress] = SPIN_S

    def run(self) -> None:
        """Forward until SIGTERM or SIGINT."""
        from rfedge.link.proxy import run_proxy

        run_proxy(self)

    def check(self) -> None:
        """Raise ``InvalidInput`` for a setting that is none."""
        for listen, to in self.paths():
            listen.require_private("listen", self.allow_insecure)
            to.require_private("to", self.allow_insecure)
        if self.metrics_port is not None and not 0 <= self.metrics_port <= 65535:
            raise InvalidInput("metrics_port", f"{self.metrics_port} is outside 0..65535")
        if self.profile is None:
            self.plan()
        for name in ("uplink_bps", "downlink_bps", "delay_ms"):
            if self.profile is not None and getattr(self, name) is not None:
                raise InvalidInput(name, f"is given beside the profile {self.profile}; give one")

    def paths(self) -> list[tuple[Address, Address]]:
        """Return where to listen for what, the path of ``listen`` and ``to`` first."""
        from rfcore.wire.address import Address

        paths = [(Address.parse("listen", self.listen), Address.parse("to", self.to))]
        for text in self.also:
            listen, _, to = text.partition("=")
            paths.append((Address.parse("also", listen), Address.parse("also", to)))
        return paths

    def plan(self) -> LinkPlan:
        """Return what the link is made of; raise what reading ``profile`` raises."""
        from rfcore.link.lossy import PacketLoss
        from rfcore.link.plan import Jitter, LinkPlan, read_link

        if self.profile is not None:
            plan = read_link(self.profile)
        else:
            plan = LinkPlan(self._constant(self.uplink_bps), self._constant(self.downlink_bps))
        if self.loss:
            plan = plan.with_loss(PacketLoss(self.loss, self.loss_burst))
        return plan if self.jitter_ms is None else plan.with_jitter(Jitter(self.jitter_ms / 1e3))

    def _constant(self, rate_bps: float | None) -> DirectionPlan:
        from rfcore.link.plan import DirectionPlan
        from rfcore.link.shaper import LinkProfile

        rate_bps = DEFAULT_BPS if rate_bps is None else rate_bps
        delay_ms = DEFAULT_DELAY_MS if self.delay_ms is None else self.delay_ms
        return DirectionPlan(LinkProfile(rate_bps, delay_ms / 1e3))
