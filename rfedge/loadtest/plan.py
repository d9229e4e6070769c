"""The plan of a load test: the load on a server, and the bounds within which it is held."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.wire.checks import MAX_CAMERAS, MAX_PAYLOAD_BYTES
from rfcore.wire.settings import RenderSettings

__all__ = ["Bounds", "Load", "Mode", "Vehicles"]


class Mode(StrEnum):
    """The part of its work that the server does for each frame.

    ``transport``: everything but the numerical work; frames are parsed, checked (order, CRC),
    queued to a worker (there is one), acknowledged and counted. ``receiver``: decoding too, against
    renders cached by pose. ``full``: ``mec-server`` as it is.
    """

    TRANSPORT = "transport"
    RECEIVER = "receiver"
    FULL = "full"


class Vehicles(StrEnum):
    """``prerecorded`` vehicles replay coded packets; ``live`` ones render and encode."""

    PRERECORDED = "prerecorded"
    LIVE = "live"


@dataclass(frozen=True)
class Bounds:
    """The bounds of a load that is held."""

    deadline_ms: float = 100.0
    """Limit of a picture's latency, and of the 99th percentile of those acknowledged."""
    on_time_percent: float = 99.0
    """Least share of all pictures due that are acknowledged within the deadline."""
    fairness: float = 0.5
    """Least ratio of the worst vehicle's share on time to the best vehicle's."""
    growth_mb_per_minute: float = 1.0
    """Largest growth of the server's memory, beyond ``settling_mb``."""
    settling_mb: float = 8.0
    """Memory that the server's allocators may take at any time."""

    def __post_init__(self) -> None:
        if not self.deadline_ms > 0:
            raise InvalidInput("deadline-ms", f"{self.deadline_ms:g} must be above 0 ms")
        if not 0 <= self.on_time_percent <= 100:
            raise InvalidInput("on-time-percent", f"{self.on_time_percent:g} is outside 0..100")
        if not 0 <= self.fairness <= 1:
            raise InvalidInput("fairness", f"{self.fairness:g} is outside 0..1")


@dataclass(frozen=True)
class Load:
    """A number of vehicles that send pictures to a server for some time."""

    mode: Mode
    vehicles: int
    hz: float
    """Pictures per second of each camera."""
    duration_s: float = 20.0
    """Time that is measured."""
    warm_up_s: float = 10.0
    """Time before it that is not: a server keeps the pictures of the last 7 s
    (``mec_server.twin.state``), and its memory grows until it has them."""
    cameras: int = 1
    """Cameras of each vehicle."""
    size_bytes: int = 4096
    """Payload of a frame in transport mode; other modes send the frames of a coded drive."""
    link: Path | None = None
    """Profile of the link of each vehicle; None: loopback."""
    kind: Vehicles = Vehicles.PRERECORDED
    vehicle_ms: float = 0.0
    """Time that a prerecorded vehicle waits before it sends a picture, in place of encoding."""
    admission: bool = False
    """Whether the server may refuse vehicles or lower their rate; otherwise its limit shows."""
    render: RenderSettings = RenderSettings()
    """Threads and renderer of a server in full mode and of live vehicles."""
    bounds: Bounds = Bounds()

    def __post_init__(self) -> None:
        if not 1 <= self.vehicles <= 1000:
            raise InvalidInput("vehicles", f"{self.vehicles} is outside 1..1000")
        if not 0.1 <= self.hz <= 1000:
            raise InvalidInput("hz", f"{self.hz:g} is outside 0.1..1000 Hz")
        if not 1 <= self.duration_s <= 86_400:
            raise InvalidInput("duration", f"{self.duration_s:g} is outside 1..86400 s")
        if not 0 <= self.warm_up_s <= 600:
            raise InvalidInput("warm-up", f"{self.warm_up_s:g} is outside 0..600 s")
        if not 1 <= self.cameras <= MAX_CAMERAS:
            raise InvalidInput("cameras", f"{self.cameras} is outside 1..{MAX_CAMERAS}")
        if not 1 <= self.size_bytes <= MAX_PAYLOAD_BYTES:
            raise InvalidInput("size", f"{self.size_bytes} is outside 1..{MAX_PAYLOAD_BYTES} bytes")
        if not 0 <= self.vehicle_ms < 1e3 * 60:
            raise InvalidInput("vehicle-ms", f"{self.vehicle_ms:g} is outside 0..60000 ms")
        self._check_kind()

    def _check_kind(self) -> None:
        if self.mode is not Mode.FULL:
            if self.admission:
                raise InvalidInput("admission", f"needs mode full, not {self.mode}")
            if self.render != RenderSettings():
                raise InvalidInput(
                    "render", f"threads and renderer need mode full, not {self.mode}"
                )
        if self.kind is Vehicles.PRERECORDED:
            return
        if self.mode is not Mode.FULL:
            raise InvalidInput("live", f"live vehicles need mode full, not {self.mode}")
        if self.cameras != 1:
            raise InvalidInput("cameras", f"{self.cameras}: a live vehicle has one camera")
