"""What the agent can be told; parsed once, in ``__main__``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from rfcore.codec.config import CRF_RANGE, PRESETS
from rfcore.errors import InvalidInput
from rfcore.wire.checks import check_field_id, check_name
from rfcore.wire.logs import LogForm
from rfcore.wire.tls import TlsFiles

__all__ = ["AgentConfig", "AgentLimits", "PaceKind"]


@dataclass(frozen=True)
class AgentLimits:
    """Deadlines in seconds, and how many pictures may wait for the encoder.

    ``answer_s``: from encoding to Ack or Nack; then the stream is given up. ``give_up_s``: without
    any connection; 0 means never.
    """

    greeting_s: float = 10.0
    answer_s: float = 5.0
    give_up_s: float = 30.0
    drain_s: float = 5.0
    slot_frames: int = 1

    def __post_init__(self) -> None:
        for name in ("greeting_s", "answer_s"):
            if not getattr(self, name) > 0:
                raise InvalidInput(f"limits.{name}", f"{getattr(self, name)} must be above 0 s")
        for name in ("give_up_s", "drain_s"):
            if not getattr(self, name) >= 0:
                raise InvalidInput(f"limits.{name}", f"{getattr(self, name)} must not be negative")
        if not 1 <= self.slot_frames <= 2:
            raise InvalidInput("limits.slot_frames", f"{self.slot_frames} is outside 1..2")


class PaceKind(StrEnum):
    """When the next picture is captured."""

    LOCKSTEP = "lockstep"
    REALTIME = "realtime"


@dataclass(frozen=True)
class AgentConfig:
    """One vehicle process with one camera.

    ``drive``: a dataset in time order. ``fields``: directory of field archives; one the server has
    and it lacks is fetched into it. ``field``: which one; the server's only one when not given.
    ``report``: file for one JSON line per picture. ``threads`` per render. ``isa`` forces an
    instruction set. ``tls``: without it the stream is plaintext.
    """

    server: str
    drive: Path
    fields: Path
    camera: str = "front"
    rate: float = 10.0
    loop: bool = False
    pace: PaceKind = PaceKind.REALTIME
    field: str | None = None
    vehicle: str = "cav-1"
    crf: float = 23.0
    preset: str = "medium"
    threads: int = 1
    isa: str | None = None
    metrics_port: int | None = None
    metrics_host: str = "127.0.0.1"
    metrics_per_vehicle: bool = False
    report: Path | None = None
    log: LogForm = LogForm.AUTO
    tls: TlsFiles | None = None
    allow_insecure: bool = False
    limits: AgentLimits = AgentLimits()

    def __post_init__(self) -> None:
        check_name("camera", self.camera)
        check_name("vehicle", self.vehicle)
        if self.field is not None:
            check_field_id("field", self.field)
        if not 0.01 <= self.rate <= 1000:
            raise InvalidInput("rate", f"{self.rate} Hz is outside 0.01..1000 Hz")
        if not CRF_RANGE[0] <= self.crf <= CRF_RANGE[1]:
            raise InvalidInput("crf", f"{self.crf} is outside {CRF_RANGE[0]:g}..{CRF_RANGE[1]:g}")
        if self.preset not in PRESETS:
            raise InvalidInput("preset", f"{self.preset!r} is none of {', '.join(PRESETS)}")
        if not 1 <= self.threads <= 256:
            raise InvalidInput("threads", f"{self.threads} is outside 1..256")
        if self.metrics_port is not None and not 0 <= self.metrics_port <= 65535:
            raise InvalidInput("metrics_port", f"{self.metrics_port} is outside 0..65535")
