"""Estimate the uplink and the processor time that a vehicle's cameras need.

The figures hold for the steady state. A first frame, and a camera that is lost, cost more.

The rate at which frames arrive in time follows the link model of the paper. The cameras of a
vehicle take their pictures at the same instant and share the link first come, first served: a frame
of b bytes occupies it for 8 b / rate (the delay tau of NetworkTX). The sizes of the measured clip's
frames are repeated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle, islice
from typing import Annotated

from tyro.conf import arg

from rfcore.errors import InvalidInput
from rfedge.sizing.tables import (
    CameraDemand,
    SizingCell,
    SizingTables,
    check_reach,
    is_measured,
    log_at,
)

INSTANTS = 400
"""Length of the simulation, in pictures of a camera."""
PRECISION = 1.005
MOST_BPS = 1e12
HEXAGON = math.sqrt(3) / 2
"""Area of a site's hexagon over the square of the distance between sites."""


@dataclass(frozen=True)
class Demand:
    """A number of vehicles, the cameras of each, the wanted quality, and optionally the time that a
    frame may take.

    ``psnr_db``: luma PSNR of the mean squared error. ``delay_ms``: from a picture to its
    reconstruction, for a ``share`` of the frames; None: only the mean rate is asked about.
    """

    cameras: int
    width_px: int
    height_px: int
    hz: float
    psnr_db: float
    delay_ms: float | None = None
    share: float = 0.99
    vehicles: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.vehicles <= 1_000_000:
            raise InvalidInput("vehicles", f"{self.vehicles} is outside 1..1000000")
        if not 1 <= self.cameras <= 1000:
            raise InvalidInput("cameras", f"{self.cameras} is outside 1..1000")
        if min(self.width_px, self.height_px) < 1:
            raise InvalidInput("size", f"{self.width_px}x{self.height_px} has no pixels")
        if not 0 < self.hz <= 1000:
            raise InvalidInput("hz", f"{self.hz:g} is outside 0..1000")
        if not math.isfinite(self.psnr_db):
            raise InvalidInput("db", f"{self.psnr_db} is not finite")
        if self.delay_ms is not None and not 0 < self.delay_ms <= 60_000:
            raise InvalidInput("delay-ms", f"{self.delay_ms:g} is outside 0..60000")
        if not 0.5 <= self.share < 1:
            raise InvalidInput("share", f"{self.share:g} is outside 0.5..1 (1 itself excluded)")

    @property
    def wanted(self) -> CameraDemand:
        """The demand of one camera."""
        return CameraDemand(self.width_px, self.height_px, self.hz, self.psnr_db)


@dataclass(frozen=True)
class Assumptions:
    """Assumptions about the transport, the cell and the distance between sites."""

    overhead_percent: float = 4.0
    """Bytes of transport headers over those of frames: 40 bytes of RTP, UDP and IPv4 on packets of
    1000 to 1200 bytes are 3.3 to 4 %."""
    propagation_ms: float = 20.0
    """One-way delay from the vehicle to the server on an empty link, ms."""
    bandwidth_mhz: float = 100.0
    """Bandwidth of the cell; 100 MHz is the widest of 3GPP TS 38.101-1 in band n78."""
    uplink_share: Annotated[float, arg(name="uplink-share")] = 0.23
    """Share of the time for uplink; 0.23 is the slot pattern DDDSU."""
    bits_per_hz: float = 5.4
    """Average uplink spectral efficiency of a cell, bit/s/Hz; ITU-R M.2410 requires 5.4 in dense
    urban and 1.6 in rural areas."""
    cell_mbps: float | None = None
    """Mbit/s of a cell's uplink; replaces its bandwidth, uplink share and bit/s/Hz."""
    utilisation: float = 0.7
    """Share of a cell's capacity to plan with, and of a vehicle's link that the mean rate may use:
    frames of other streets vary more than those of the short clips that were measured."""
    inter_site_m: float = 200.0
    """Distance between sites, m; ITU-R M.2412 has 200 for dense urban and 1732 for rural areas."""
    sectors: int = 3
    """Number of cells of a site."""

    def __post_init__(self) -> None:
        for name in ("bandwidth_mhz", "bits_per_hz", "inter_site_m", "sectors"):
            if not 0 < getattr(self, name) <= 1e6:
                raise InvalidInput(name, f"{getattr(self, name):g} is outside 0..1e6")
        for name in ("uplink_share", "utilisation"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidInput(name, f"{getattr(self, name):g} is outside 0..1")
        if self.cell_mbps is not None and not 0 < self.cell_mbps <= 1e6:
            raise InvalidInput("cell-mbps", f"{self.cell_mbps:g} is outside 0..1e6")
        for name in ("overhead_percent", "propagation_ms"):
            if not 0 <= getattr(self, name) <= 1000:
                raise InvalidInput(name, f"{getattr(self, name):g} is outside 0..1000")

    @property
    def planned_cell_mbps(self) -> float:
        """Throughput of a cell's uplink that may be planned with, Mbit/s."""
        stated = self.cell_mbps
        cell_mbps = self.bandwidth_mhz * self.uplink_share * self.bits_per_hz
        return (cell_mbps if stated is None else stated) * self.utilisation

    @property
    def cells_per_km2(self) -> float:
        """Density of cells on a hexagonal grid of sites."""
        return self.sectors / (HEXAGON * (self.inter_site_m / 1e3) ** 2)


@dataclass(frozen=True)
class Estimate:
    """One codec's needs for a vehicle: Mbit/s with transport, and cores at either end.

    ``mbps`` is the mean rate. Its 95 % interval is that of the measured frames; None at a size or
    rate that was not measured, where nobody knows the error. ``least_link_mbps``: the link that
    keeps the delay for the frames that were measured; ``link_mbps``: the link to plan with, which
    the mean rate also uses to ``Assumptions.utilisation`` at most. Both are None unless a delay is
    asked for and can be kept. A cell, whose capacity has that margin already, holds as many
    vehicles as its uplink carries of the least link, or of the mean rate.
    """

    codec: str
    mbps: float
    low_mbps: float | None
    high_mbps: float | None
    vehicle_cores: float
    server_cores: float
    vehicles_per_cell: int
    vehicles_per_km2: float
    link_mbps: float | None = None
    least_link_mbps: float | None = None


@dataclass(frozen=True)
class FleetEstimate:
    """One codec's needs for all vehicles: each has a link of its own, so links add up as rates do.

    ``cells``: how many carry the fleet; None if a cell does not carry one vehicle.
    """

    codec: str
    vehicles: int
    mbps: float
    low_mbps: float | None
    high_mbps: float | None
    link_mbps: float | None
    server_cores: float
    cells: int | None

    @staticmethod
    def of(one: Estimate, vehicles: int) -> FleetEstimate:
        """Return the needs of ``vehicles`` such as ``one``."""

        def total(each: float | None) -> float | None:
            return None if each is None else vehicles * each

        return FleetEstimate(
            one.codec,
            vehicles,
            vehicles * one.mbps,
            total(one.low_mbps),
            total(one.high_mbps),
            total(one.link_mbps),
            vehicles * one.server_cores,
            -(-vehicles // one.vehicles_per_cell) if one.vehicles_per_cell else None,
        )


@dataclass(frozen=True)
class Sizing:
    """The estimates, ours first, of a vehicle and of the fleet; ``beyond`` says where they go
    beyond the measurements, ``warnings`` where a delay makes them misleading."""

    demand: Demand
    assumptions: Assumptions
    measured_on: str
    measured_machine: str
    """The machine that cores and times are of."""
    estimates: Sequence[Estimate]
    beyond: Sequence[str] = field(default=())
    measured_at: str = ""
    """Sizes and rates of the tables."""
    warnings: Sequence[str] = field(default=())
    fleet: Sequence[FleetEstimate] = field(default=())


def estimate(
    demand: Demand, tables: SizingTables, assumptions: Assumptions | None = None
) -> Sizing:
    """Return what every codec of ``tables`` needs for ``demand``.

    Raises ``InvalidInput`` for a demand too far outside the tables, or a delay that cannot be kept.
    """
    assumptions = assumptions or Assumptions()
    cells = {codec: tables.of(codec) for codec in tables.codecs}
    reach = {codec: check_reach(cells[codec], demand.wanted) for codec in cells}
    left_ms = {codec: _left_ms(demand, cells[codec], assumptions) for codec in cells}
    made = [_estimate(demand, cells[codec], assumptions, left_ms[codec]) for codec in cells]
    return Sizing(
        demand,
        assumptions,
        tables.measured_on,
        tables.machine,
        made,
        [*_notes(reach), *_late(demand, left_ms, tables.machine)],
        tables.measured_at,
        [] if demand.delay_ms is None else _reversals(demand, made),
        [FleetEstimate.of(one, demand.vehicles) for one in made],
    )


def _reversals(demand: Demand, made: Sequence[Estimate]) -> list[str]:
    """Return a warning if, within the delay, a rival does with less of a link than ours, which
    needs fewer bits."""
    ours, *rivals = made
    reversed_by = [
        rival
        for rival in rivals
        if ours.mbps < rival.mbps and rival.link_mbps is not None
        if ours.link_mbps is None or ours.link_mbps > rival.link_mbps
    ]
    if not reversed_by:
        return []
    names = ", ".join(rival.codec for rival in reversed_by)
    need = (
        f"no link will do for {ours.codec}, and one will for {names}"
        if ours.link_mbps is None
        else f"{ours.codec} needs a faster link than {names}"
    )
    return [
        f"{demand.delay_ms:g} ms reverse the saving: {need}. {ours.codec} sends fewer bits, but "
        "coding and decoding leave less of the time for the link; allow more time, or take the "
        "rival"
    ]


def _left_ms(demand: Demand, cells: Sequence[SizingCell], assumptions: Assumptions) -> float | None:
    """Return the time that is left for sending a frame, or None if no delay is asked for.

    A vehicle's cameras are computed in parallel.
    """
    if demand.delay_ms is None:
        return None
    return demand.delay_ms - sum(_times_ms(demand.wanted, cells)) - assumptions.propagation_ms


def _late(demand: Demand, left_ms: Mapping[str, float | None], machine: str) -> list[str]:
    """Return a note for each codec that is late on any link; raise ``InvalidInput`` if all are."""
    notes = [
        f"{codec}: no link keeps {demand.delay_ms:g} ms: coding, decoding and propagation alone "
        f"take {demand.delay_ms - left:.0f} ms on one thread of {machine}"
        for codec, left in left_ms.items()
        if demand.delay_ms is not None and left is not None and left <= 0
    ]
    if len(notes) == len(left_ms):
        raise InvalidInput("delay-ms", f"{notes[0]}; ask for more")
    return notes


def _notes(reach: Mapping[str, Sequence[str]]) -> list[str]:
    """Return each note once, with its codecs unless it concerns all of them."""
    about: dict[str, list[str]] = {}
    for codec, notes in reach.items():
        for note in notes:
            about.setdefault(note, []).append(codec)
    return [
        note if len(codecs) == len(reach) else f"{', '.join(codecs)}: {note}"
        for note, codecs in about.items()
    ]


def _times_ms(wanted: CameraDemand, cells: Sequence[SizingCell]) -> tuple[float, float]:
    """Return the processor time of sender and receiver for a frame."""
    sender_ms = math.exp(log_at(cells, wanted, lambda cell: math.log(cell.sender_ms)))
    receiver_ms = math.exp(log_at(cells, wanted, lambda cell: math.log(cell.receiver_ms)))
    return sender_ms, receiver_ms


def _estimate(
    demand: Demand,
    cells: Sequence[SizingCell],
    assumptions: Assumptions,
    left_ms: float | None,
) -> Estimate:
    wanted = demand.wanted
    frame_bytes = math.exp(log_at(cells, wanted, lambda cell: cell.log_bytes(wanted.psnr_db)))
    nearest = nearest_cell(cells, wanted)
    pictures_per_s = demand.cameras * demand.hz
    mbps_of = 8e-6 * pictures_per_s * (1 + assumptions.overhead_percent / 100)
    sender_ms, receiver_ms = _times_ms(wanted, cells)
    mbps, link_mbps, least_mbps = mbps_of * frame_bytes, None, None
    if left_ms is not None and left_ms > 0:
        sizes = [frame_bytes * ratio for ratio in nearest.frame_ratios]
        frames_bps = needed_bps(sizes, demand.cameras, demand.hz, left_ms / 1e3, demand.share)
        least_mbps = frames_bps / 1e6 * (1 + assumptions.overhead_percent / 100)
        link_mbps = max(least_mbps, mbps / assumptions.utilisation)
    is_late = left_ms is not None and left_ms <= 0
    vehicles = 0 if is_late else math.floor(assumptions.planned_cell_mbps / (least_mbps or mbps))
    low_mbps, high_mbps = _interval(nearest, wanted, mbps)
    return Estimate(
        codec=cells[0].codec,
        mbps=mbps,
        low_mbps=low_mbps,
        high_mbps=high_mbps,
        vehicle_cores=pictures_per_s * sender_ms / 1e3,
        server_cores=pictures_per_s * receiver_ms / 1e3,
        vehicles_per_cell=vehicles,
        vehicles_per_km2=vehicles * assumptions.cells_per_km2,
        link_mbps=link_mbps,
        least_link_mbps=least_mbps,
    )


def _interval(
    nearest: SizingCell, wanted: CameraDemand, mbps: float
) -> tuple[float, float] | tuple[None, None]:
    if not is_measured(nearest, wanted):
        return None, None
    mean = nearest.log_bytes(wanted.psnr_db)
    low, high = (nearest.log_bytes(wanted.psnr_db, name) for name in ("low_bytes", "high_bytes"))
    return mbps * math.exp(low - mean), mbps * math.exp(high - mean)


def nearest_cell(cells: Sequence[SizingCell], wanted: CameraDemand) -> SizingCell:
    """Return the measured cell whose rate and size differ least from ``wanted``, as ratios."""

    def distance(cell: SizingCell) -> float:
        return abs(math.log(cell.hz / wanted.hz)) + abs(math.log(cell.pixels / wanted.pixels))

    return min(cells, key=distance)


def share_in_time(
    frame_bytes: Sequence[float], cameras: int, hz: float, rate_bps: float, within_s: float
) -> float:
    """Return the share of frames that leave a link of ``rate_bps`` within ``within_s``."""
    free_s, in_time = 0.0, 0
    for instant, size_bytes in enumerate(islice(cycle(frame_bytes), INSTANTS)):
        start_s = instant / hz
        free_s = max(free_s, start_s)
        for _ in range(cameras):
            free_s += 8 * size_bytes / rate_bps
            in_time += free_s - start_s <= within_s
    return in_time / (INSTANTS * cameras)


def needed_bps(
    frame_bytes: Sequence[float], cameras: int, hz: float, within_s: float, share: float
) -> float:
    """Return the least rate, within 0.5 %, at which ``share`` of the frames are in time.

    Never less than the mean rate, which any link has to carry. Raises ``InvalidInput`` when there
    is no time left for sending.
    """
    if within_s <= 0:
        raise InvalidInput("delay-ms", f"no time is left for sending ({1e3 * within_s:.0f} ms)")

    def enough(rate_bps: float) -> bool:
        return share_in_time(frame_bytes, cameras, hz, rate_bps, within_s) >= share

    low = 8 * hz * cameras * sum(frame_bytes) / len(frame_bytes)
    if enough(low):
        return low
    high = low
    while not enough(high) and high < MOST_BPS:
        low, high = high, 2 * high
    while high > PRECISION * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
