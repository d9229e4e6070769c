"""The edge server's configuration; parsed once, in ``__main__``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from tyro.conf import Suppress, arg

from rfcore.errors import InvalidInput
from rfcore.wire.checks import MAX_RATE_HZ
from rfcore.wire.settings import LogForm, MetricsSettings, RenderSettings, TransportSettings

__all__ = [
    "AdmissionLimits",
    "ConsumerLimits",
    "DecoderKind",
    "ServerConfig",
    "SessionLimits",
    "VehicleQuota",
]


class DecoderKind(StrEnum):
    """Where packets are decoded; AUTO: in the server if only this machine can reach it, otherwise
    under bubblewrap where that works, otherwise in processes with limits."""

    AUTO = "auto"
    IN_PROCESS = "in-process"
    CHILD = "child"
    BUBBLEWRAP = "bubblewrap"


@dataclass(frozen=True)
class SessionLimits:
    """Deadlines in seconds and the window of one session.

    ``window_frames``: frames of one camera in flight or being decoded; two keep the link busy
    while one is decoded, more would only add delay.
    """

    hello_s: float = 5.0
    idle_s: float = 60.0
    window_frames: int = 2

    def __post_init__(self) -> None:
        for name in ("hello_s", "idle_s"):
            if not getattr(self, name) > 0:
                raise InvalidInput(f"limits.{name}", f"{getattr(self, name)} must be above 0 s")
        if not 1 <= self.window_frames <= 64:
            raise InvalidInput("limits.window_frames", f"{self.window_frames} is outside 1..64")


@dataclass(frozen=True)
class VehicleQuota:
    """What one vehicle may use at most, over all its streams: far above what a correct one uses,
    far below what would starve the others."""

    streams: Annotated[int, arg(name="vehicle-streams")] = 8
    """How many streams one vehicle may have."""
    frames_per_s: Annotated[float, arg(name="vehicle-frames-per-s")] = 500.0
    """How many frames it may send, over all its streams."""
    bytes_per_s: Annotated[float, arg(name="vehicle-bytes-per-s")] = 32e6
    """How many bytes these may have."""

    def __post_init__(self) -> None:
        if not 1 <= self.streams <= 1000:
            raise InvalidInput("quota.streams", f"{self.streams} is outside 1..1000")
        for name in ("frames_per_s", "bytes_per_s"):
            value = getattr(self, name)
            if not 1 <= value <= 1e12:
                raise InvalidInput(f"quota.{name}", f"{value} is outside 1..1e12")


@dataclass(frozen=True)
class AdmissionLimits:
    """How much of the workers' time is promised to vehicles (see ``mec_server.admission``)."""

    load: Annotated[float, arg(name="max-load")] = 0.8
    """Share of the workers' time that vehicles are promised; beyond it they get a lower rate, or
    are asked to come again. 0: every vehicle is let in."""
    lowest_hz: Annotated[float, arg(name="lowest-rate")] = 2.0
    """Lowest rate in pictures per second; a vehicle that can be given less is refused."""
    retry_s: Annotated[float, Suppress] = 5.0

    def __post_init__(self) -> None:
        if not 0 <= self.load <= 1:
            raise InvalidInput("max-load", f"{self.load:g} is outside 0..1")
        if not 0 < self.lowest_hz <= MAX_RATE_HZ:
            raise InvalidInput("lowest-rate", f"{self.lowest_hz:g} is outside 0..{MAX_RATE_HZ:g}")
        if not self.retry_s > 0:
            raise InvalidInput("retry_s", f"{self.retry_s:g} must be above 0 s")


@dataclass(frozen=True)
class ConsumerLimits:
    """Consumers of the twin (`rfedge watch`); the stream of one that stops reading is ended."""

    consumers: Annotated[int, arg(name="max-consumers")] = 8
    """How many may watch at once."""
    stalled_s: Annotated[float, Suppress] = 10.0
    """A consumer that took nothing for so long is too slow."""

    def __post_init__(self) -> None:
        if not 0 <= self.consumers <= 1000:
            raise InvalidInput("consumers", f"{self.consumers} is outside 0..1000")
        if not self.stalled_s > 0:
            raise InvalidInput("stalled_s", f"{self.stalled_s} must be above 0 s")


@dataclass(frozen=True)
class ServerConfig:
    """Reconstruct what vehicles see, against the radiance fields held here."""

    fields: Path
    """Directory of field archives (.rff)."""
    listen: str = "127.0.0.1:50051"
    """HOST:PORT to accept vehicles on; port 0 takes a free one."""
    save: Path | None = None
    """Directory for reconstructed pictures (PNG) and their index; none without it."""
    workers: int = 2
    """Frames reconstructed at once."""
    decoder: DecoderKind = DecoderKind.AUTO
    """Where packets are decoded. in-process: in the server. child: in processes with limits, one a
    camera. bubblewrap: in sandboxes. auto: in-process if only this machine can reach the server,
    else bubblewrap where it works, else child."""
    log: LogForm = LogForm.AUTO
    """console lines, json lines, or auto: console on a terminal."""
    ready_file: Path | None = None
    """File that receives HOST:PORT once vehicles are accepted."""
    render: RenderSettings = RenderSettings()
    metrics: MetricsSettings = MetricsSettings()
    transport: TransportSettings = TransportSettings()
    consumers: ConsumerLimits = ConsumerLimits()
    max_streams: int = 256
    """How many streams of vehicles may be open at once."""
    quota: VehicleQuota = VehicleQuota()
    admission: AdmissionLimits = AdmissionLimits()
    drain_s: Annotated[float, Suppress] = 5.0
    limits: Annotated[SessionLimits, Suppress] = SessionLimits()

    def __post_init__(self) -> None:
        for name, highest in (("workers", 256), ("max_streams", 100_000)):
            value = getattr(self, name)
            if not 1 <= value <= highest:
                raise InvalidInput(name, f"{value} is outside 1..{highest}")
        if not self.fields.is_dir():
            raise InvalidInput("fields", f"{self.fields} is not a directory")
        if not self.drain_s >= 0:
            raise InvalidInput("drain_s", f"{self.drain_s} must not be negative")
