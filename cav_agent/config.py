"""The agent's options and limits; parsed and checked once, in ``__main__``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from tyro.conf import Suppress

from rfcore.codec.h264.config import CRF_RANGE, PRESETS
from rfcore.codec.sender.steering import SteeringSettings
from rfcore.errors import InvalidInput
from rfcore.wire.checks import check_field_id, check_name
from rfcore.wire.settings import LogForm, MetricsSettings, RenderSettings, TransportSettings

__all__ = ["AgentConfig", "AgentLimits", "PaceKind"]


@dataclass(frozen=True)
class AgentLimits:
    """Time limits in seconds, and how many pictures may wait for the encoder.

    ``greeting_s``: from Hello to Welcome. ``answer_s``: from encoding to Ack or Nack, before the
    stream is given up; less once the server's usual time is known (``AnswerTimeout``).
    ``give_up_s``: without any connection, before the drive ends with an error; 0 means never.
    ``drain_s``: for the last frames, after ``stop`` and at the end of the drive.
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
    """Send a drive to an edge server, as differences to a radiance field that both hold."""

    server: str
    """HOST:PORT of mec-server (or of `rfedge link` in front of it)."""
    drive: Path
    """Dataset in time order: a transforms.json, or the folder of the only one."""
    fields: Path = Path("~/.cache/rfedge/fields")
    """Directory of field archives; a field the server has is fetched into it."""
    neighbours: tuple[str, ...] = ()
    """HOST:PORT of further servers along the drive: the vehicle is handed over from tile to tile,
    and to a neighbour whose tile covers it when a server is lost."""
    camera: str = "front"
    """Name of the camera on the wire."""
    rate: float = 10.0
    """Pictures per second in realtime pace."""
    loop: bool = False
    """Begin again after the last picture."""
    pace: PaceKind = PaceKind.REALTIME
    """realtime: capture at the rate, drop what the link cannot take. lockstep: capture the next
    picture when the previous was answered."""
    field: str | None = None
    """Field id (sha256); without it, what servers publish or the only field they have."""
    vehicle: str = "cav-1"
    """Name of the vehicle on the wire."""
    crf: float = 23.0
    """H.264 quality, 1 (best) to 51; 23 is x264's default."""
    preset: str = "medium"
    """x264 preset, ultrafast to veryslow."""
    max_delay_ms: float | None = None
    """Longest time from capture to Ack; quality falls below --crf to keep it, and pictures are
    dropped when the lowest quality cannot. Without it every frame has --crf."""
    deadline_ms: float | None = None
    """Milliseconds a frame may take on this machine, from the picture to the packet: the best rung
    of the ladder that keeps it is used, a lower one under load, in place of the preset."""
    ladder: Path = Path("results/ladder.json")
    """Times and rates of the rungs, as `rfedge eval ladder` measured them."""
    steering: SteeringSettings = SteeringSettings()
    log: LogForm = LogForm.AUTO
    """console lines, json lines, or auto: console on a terminal."""
    report: Path | None = None
    """File for one JSON line per picture."""
    render: RenderSettings = RenderSettings()
    metrics: MetricsSettings = MetricsSettings()
    transport: TransportSettings = TransportSettings()
    limits: Annotated[AgentLimits, Suppress] = AgentLimits()

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
        if self.max_delay_ms is not None and not 10 <= self.max_delay_ms <= 60_000:
            raise InvalidInput("max_delay_ms", f"{self.max_delay_ms} ms is outside 10..60000 ms")
        if self.deadline_ms is not None and not 1 <= self.deadline_ms <= 60_000:
            raise InvalidInput("deadline_ms", f"{self.deadline_ms} ms is outside 1..60000 ms")
