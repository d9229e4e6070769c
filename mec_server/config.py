"""What the edge server can be told; parsed once, in ``__main__``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.wire.logs import LogForm
from rfcore.wire.tls import TlsFiles

__all__ = ["ConsumerLimits", "DecoderKind", "ServerConfig", "SessionLimits", "VehicleQuota"]


class DecoderKind(StrEnum):
    """Where packets are decoded; AUTO: in the server if only this machine can reach it, else under
    bubblewrap where that works, else in processes with limits."""

    AUTO = "auto"
    IN_PROCESS = "in-process"
    CHILD = "child"
    BUBBLEWRAP = "bubblewrap"


@dataclass(frozen=True)
class SessionLimits:
    """Deadlines in seconds and the window of one session.

    ``window_frames``: frames of one camera on their way or being decoded; two keep the link busy
    while one is decoded, more would only be older.
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
    """What one vehicle may use at most, over all its streams: far above what an honest one does,
    far below what would starve the others."""

    streams: int = 8
    frames_per_s: float = 500.0
    bytes_per_s: float = 32e6

    def __post_init__(self) -> None:
        if not 1 <= self.streams <= 1000:
            raise InvalidInput("quota.streams", f"{self.streams} is outside 1..1000")
        for name in ("frames_per_s", "bytes_per_s"):
            value = getattr(self, name)
            if not 1 <= value <= 1e12:
                raise InvalidInput(f"quota.{name}", f"{value} is outside 1..1e12")


@dataclass(frozen=True)
class ConsumerLimits:
    """``consumers`` may watch at once; one that takes nothing for ``patience_s`` is let go."""

    consumers: int = 8
    patience_s: float = 10.0

    def __post_init__(self) -> None:
        if not 0 <= self.consumers <= 1000:
            raise InvalidInput("consumers", f"{self.consumers} is outside 0..1000")
        if not self.patience_s > 0:
            raise InvalidInput("patience_s", f"{self.patience_s} must be above 0 s")


@dataclass(frozen=True)
class ServerConfig:
    """One edge server process.

    ``fields``: directory of field archives. ``save``: directory for reconstructed pictures, none
    are written without it. ``listen`` and ``metrics_port``: port 0 takes a free one; no metrics are
    served without a port, and ``metrics_per_vehicle`` tells vehicles apart in them. ``threads`` per
    render, ``workers`` frames at once. ``isa`` forces an instruction set. ``ready_file`` receives
    the address once connections are accepted. ``tls``: only clients with a certificate are let in.
    ``decoder``: where packets are decoded. ``max_streams`` may be open, ``quota`` of them and what
    they carry be one vehicle's.
    """

    fields: Path
    listen: str = "127.0.0.1:50051"
    save: Path | None = None
    metrics_port: int | None = None
    metrics_host: str = "127.0.0.1"
    metrics_per_vehicle: bool = False
    threads: int = 1
    workers: int = 2
    isa: str | None = None
    ready_file: Path | None = None
    tls: TlsFiles | None = None
    log: LogForm = LogForm.AUTO
    consumers: ConsumerLimits = ConsumerLimits()
    decoder: DecoderKind = DecoderKind.AUTO
    max_streams: int = 256
    quota: VehicleQuota = VehicleQuota()
    allow_insecure: bool = False
    drain_s: float = 5.0
    limits: SessionLimits = SessionLimits()

    def __post_init__(self) -> None:
        for name, highest in (("threads", 256), ("workers", 256), ("max_streams", 100_000)):
            value = getattr(self, name)
            if not 1 <= value <= highest:
                raise InvalidInput(name, f"{value} is outside 1..{highest}")
        if self.metrics_port is not None and not 0 <= self.metrics_port <= 65535:
            raise InvalidInput("metrics_port", f"{self.metrics_port} is outside 0..65535")
        if not self.fields.is_dir():
            raise InvalidInput("fields", f"{self.fields} is not a directory")
        if not self.drain_s >= 0:
            raise InvalidInput("drain_s", f"{self.drain_s} must not be negative")
