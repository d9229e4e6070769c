"""The load on a server, the bounds within which it is held, and the verdict on a run.

A frame is on time when its Ack arrives within the deadline, counted from the moment the picture
was due. Frames that were dropped, refused or not answered are late.

Every resource has a utilisation above which work queues up for it. If a bound was broken, the first
resource above its limit is named, otherwise the resource nearest to its limit. The load generator
comes first: where the test's own vehicles are the limit, the run says nothing about the server.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from statistics import NormalDist

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.wire.settings import RenderSettings
from rfcore.wire.values import MAX_CAMERAS, MAX_PAYLOAD_BYTES


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


SETTLING_S = 10.0
"""Time from the first pictures in which a server's memory grows by itself: it keeps the pictures of
the last 7 s (``mec_server.twin.state``), and each worker allocates what it renders and decodes in.
"""


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
    """Time before it that is not."""
    cameras: int = 1
    """Cameras of each vehicle."""
    payload_bytes: int = 4096
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
        if not 1 <= self.payload_bytes <= MAX_PAYLOAD_BYTES:
            raise InvalidInput(
                "payload-bytes", f"{self.payload_bytes} is outside 1..{MAX_PAYLOAD_BYTES} bytes"
            )
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


BUSY = 0.85
"""Utilisation of a core, a link or a worker above which work queues up.

At 85 % the mean queue of an M/D/1 server is already three services long."""
MACHINE_BUSY = 0.95
OTHERS = 0.3
"""Cores used by other processes above which a run is not that of an idle machine."""
LAG_MS = 20.0
"""Lateness of the generator's event loop above which the run measures the generator itself."""


@dataclass(frozen=True)
class Resources:
    """The utilisation of every resource, 0..1, and how late the generator was."""

    server_loop: float
    """The server's event loop, as a share of one core."""
    workers: float
    """The server's other threads, as a share of the cores that they can have."""
    link: float
    """The uplink of the busiest vehicle."""
    generator: float
    """The busiest process that plays vehicles or links, as a share of one core; 0 for live
    vehicles, which are a part of what is tested."""
    machine: float
    """All cores of the machine."""
    test: float
    """The share of the machine that the test's own processes used."""
    others: float
    """Cores that other processes used."""
    generator_lag_ms: float


@dataclass(frozen=True)
class Utilisation:
    """Utilisation of one resource, its limit, and a text for both."""

    text: str
    share: float
    limit: float

    @property
    def is_over(self) -> bool:
        """Whether work queued up for it."""
        return self.share > self.limit


def limit(resources: Resources) -> str:
    """Name the first resource above its limit, or the one nearest to it, with its utilisation.

    A link that is full is named before the machine. Where other programs kept the machine busy, and
    the test alone would not have, these are named.
    """
    r = resources
    machine = Utilisation(
        f"CPU of the machine, at {_percent(r.machine)}{_beside(r)}", r.machine, MACHINE_BUSY
    )
    if (link := _link(r)).is_over:  # no machine would help
        return link.text
    if r.others > OTHERS and r.machine > BUSY >= r.test:
        return (
            f"other programs on this machine: they took {r.others:.1f} cores of it, the test "
            f"{_percent(r.test)} of all"
        )
    uses = (_lag(r), *_on_one_core(r), machine, _workers(r))
    over = next((use for use in uses if use.is_over), None)
    return over.text if over is not None else f"nearest: {_fullest(uses)}"


def nearest(resources: Resources) -> str:
    """Name the resource that limits a load that was held, with its utilisation.

    Other processes on the machine are left out, since they are no part of the test.
    """
    r = resources
    machine = Utilisation(f"CPU of the machine, at {_percent(r.test)}", r.test, MACHINE_BUSY)
    return f"nearest: {_fullest((*_on_one_core(r), machine, _workers(r)))}"


def _fullest(uses: Sequence[Utilisation]) -> str:
    return max(uses, key=lambda use: use.share / use.limit).text


def _on_one_core(r: Resources) -> tuple[Utilisation, ...]:
    generator = f"vehicles of the test, at {_percent(r.generator)} of a core"
    loop = f"server's event loop, at {_percent(r.server_loop)} of a core"
    return (
        Utilisation(generator, r.generator, BUSY),
        _link(r),
        Utilisation(loop, r.server_loop, BUSY),
    )


def _link(r: Resources) -> Utilisation:
    return Utilisation(f"link of the busiest vehicle, at {_percent(r.link)}", r.link, BUSY)


def _workers(r: Resources) -> Utilisation:
    return Utilisation(f"server's workers, at {_percent(r.workers)}", r.workers, BUSY)


def _lag(r: Resources) -> Utilisation:
    """Return the lateness of the generator, or 0 if the whole machine was busy."""
    late = r.generator_lag_ms if r.machine < MACHINE_BUSY else 0.0
    return Utilisation(f"vehicles of the test, {late:.0f} ms late themselves", late, LAG_MS)


def _beside(r: Resources) -> str:
    return f", {r.others:.1f} cores of it by others" if r.others > OTHERS else ""


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


DEVIATIONS = NormalDist().inv_cdf(0.975)
"""Standard deviations on either side of the mean that hold 95 % of a normal distribution."""


@dataclass(frozen=True)
class VehicleReport:
    """One vehicle in the measured part of a run."""

    due: int
    """Number of pictures that were due."""
    latency_ms: Sequence[float]
    """Latencies of the pictures that were acknowledged."""
    nacked: int = 0
    """Number of pictures that the server refused."""
    granted_hz: float = 0.0
    """Rate that the server admitted; 0: any."""
    refused: str = ""
    """Reason why the server did not admit the vehicle; empty if it did."""
    failed: str = ""
    """Reason why the vehicle lost its stream; empty if it did not."""

    def on_time(self, deadline_ms: float) -> int:
        """Return how many pictures were acknowledged within the deadline."""
        return sum(ms <= deadline_ms for ms in self.latency_ms)


@dataclass(frozen=True)
class Measured:
    """The measurements of one run that are judged."""

    vehicles: Sequence[VehicleReport]
    wanted_vehicles: int
    growth_mb: float | None
    """Growth of the server's memory over the last ``minutes``; None if it had no time to settle."""
    minutes: float
    resources: Resources
    instant_ms: float = 0.0
    """Mean time that the uplink transmits the pictures of one instant; 0 without a link."""


@dataclass(frozen=True)
class Verdict:
    """The judgement of one run."""

    broken: Sequence[str]
    """The bounds that were not kept; the load is held if there are none."""
    p50_ms: float
    p99_ms: float
    due: int
    """Number of pictures that were due."""
    answered: int
    """Number of them that were acknowledged, of which the percentiles are."""
    on_time_percent: float
    on_time_at_least_percent: float
    fairness: float | None
    limited_by: str

    @property
    def held(self) -> bool:
        """Whether every bound was kept."""
        return not self.broken


def judge(measured: Measured, bounds: Bounds) -> Verdict:
    """Compare a run with its bounds."""
    due = sum(vehicle.due for vehicle in measured.vehicles)
    on_time = sum(vehicle.on_time(bounds.deadline_ms) for vehicle in measured.vehicles)
    latency_ms = [ms for vehicle in measured.vehicles for ms in vehicle.latency_ms]
    p50_ms, p99_ms = _percentiles(latency_ms)
    percent = 100.0 * on_time / due if due else 0.0
    fairness = _fairness(measured.vehicles, bounds.deadline_ms)
    allowed_mb = bounds.settling_mb + bounds.growth_mb_per_minute * measured.minutes
    checks = (
        (
            len(measured.vehicles) < measured.wanted_vehicles,
            f"{measured.wanted_vehicles - len(measured.vehicles)} of {measured.wanted_vehicles} "
            "vehicles were not admitted",
        ),
        (p99_ms > bounds.deadline_ms, f"p99 {p99_ms:.0f} ms above {bounds.deadline_ms:g} ms"),
        (
            percent < bounds.on_time_percent,
            f"{percent:.2f} % on time, below {bounds.on_time_percent:g} %",
        ),
        (
            fairness is not None and fairness < bounds.fairness,
            f"fairness {fairness or 0.0:.2f} below {bounds.fairness:g}",
        ),
        (
            (measured.growth_mb or 0.0) > allowed_mb,
            f"memory grew {measured.growth_mb or 0.0:.1f} MB, {allowed_mb:.1f} may be",
        ),
    )
    broken = tuple(problem for is_broken, problem in checks if is_broken)
    return Verdict(
        broken=broken,
        p50_ms=p50_ms,
        p99_ms=p99_ms,
        due=due,
        answered=len(latency_ms),
        on_time_percent=percent,
        on_time_at_least_percent=100.0 * share_at_least(on_time, due),
        fairness=fairness,
        limited_by=_limited_by(measured, bounds) if broken else nearest(measured.resources),
    )


def _limited_by(measured: Measured, bounds: Bounds) -> str:
    """Name what kept a load from being held; no machine makes up for a link that is too slow."""
    if measured.instant_ms > bounds.deadline_ms:
        return (
            f"link of the busiest vehicle: an instant's pictures take {measured.instant_ms:.0f} ms "
            "of it"
        )
    return limit(measured.resources)


def share_at_least(successes: int, trials: int) -> float:
    """Return the lower end of Wilson's 95 % interval of a share; 0 without trials.

    Frames of one vehicle are late together, so the true interval is wider.
    """
    if not trials:
        return 0.0
    share, spread = successes / trials, DEVIATIONS**2 / trials
    half = math.sqrt(spread * (share * (1 - share) + spread / 4))
    return max(0.0, (share + spread / 2 - half) / (1 + spread))


def _percentiles(latency_ms: Sequence[float]) -> tuple[float, float]:
    """Return the 50th and the 99th percentile; infinity of an empty list."""
    if not latency_ms:
        return math.inf, math.inf
    p50_ms, p99_ms = np.percentile(np.array(latency_ms), (50, 99))
    return float(p50_ms), float(p99_ms)


def _fairness(vehicles: Sequence[VehicleReport], deadline_ms: float) -> float | None:
    """Return the worst vehicle's share on time over the best one's; None where there are no two, or
    none had a picture on time."""
    shares = [vehicle.on_time(deadline_ms) / vehicle.due for vehicle in vehicles if vehicle.due]
    best = max(shares, default=0.0)
    return min(shares) / best if best and len(shares) > 1 else None
