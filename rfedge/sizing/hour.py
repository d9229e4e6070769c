"""An hour of driving: bytes up, the field's bytes down, per kilometre, and what they cost.

A vehicle fetches the field of road that it does not hold yet. All bytes of it count, whether it
arrives at once or while the vehicle drives (``cav-agent --fetch-share``). A megabyte is 1e6 bytes.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from rfcore.errors import InvalidInput
from rfedge.samples import sample_path
from rfedge.sizing.estimate import Demand, Estimate

OURS = "rfedge"
GB_PER_MBPS = 3600 / 8e3
"""Gigabytes that 1 Mbit/s carries in an hour."""


@dataclass(frozen=True)
class Road:
    """How fast a vehicle drives, and the fields of its road.

    ``new_share``: share of the road whose field the vehicle does not hold yet. ``price_per_gb``: of
    traffic in either direction, in any currency; None: no cost is told.
    """

    speed_kmh: float
    new_share: float
    field_mb_per_km: float
    price_per_gb: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.speed_kmh <= 500:
            raise InvalidInput("speed-kmh", f"{self.speed_kmh:g} is outside 0..500")
        if not 0 <= self.new_share <= 1:
            raise InvalidInput("new-road", f"{self.new_share:g} is outside 0..1")
        if not 0 <= self.field_mb_per_km <= 1e5:
            raise InvalidInput("field-mb-per-km", f"{self.field_mb_per_km:g} is outside 0..1e5")
        if self.price_per_gb is not None and not 0 <= self.price_per_gb <= 1e6:
            raise InvalidInput("price-per-gb", f"{self.price_per_gb:g} is outside 0..1e6")

    @property
    def field_gb(self) -> float:
        """Gigabytes of fields that are fetched in an hour."""
        return self.speed_kmh * self.new_share * self.field_mb_per_km / 1e3


@dataclass(frozen=True)
class NamedVehicle:
    """An assumed vehicle: its cameras, their pictures, its speed and the road that is new to it."""

    name: str
    cameras: int
    width_px: int
    height_px: int
    hz: float
    speed_kmh: float
    new_share: float


NAMED_VEHICLES = (
    NamedVehicle("bus", 4, 640, 360, 10.0, 18.0, 0.02),
    NamedVehicle("lorry", 2, 640, 360, 10.0, 70.0, 0.5),
    NamedVehicle("robot taxi", 6, 640, 360, 10.0, 25.0, 0.1),
)
"""Assumptions, not measurements: a bus drives one line all day, half of a lorry's road is new."""


@dataclass(frozen=True)
class HourRow:
    """An hour of one vehicle with one codec. Rivals need no field."""

    vehicle: str
    codec: str
    up_gb: float
    """Gigabytes of pictures, with transport."""
    field_gb: float
    """Gigabytes of fields that are fetched."""
    mb_per_km: float
    """Megabytes of both for each kilometre."""
    vehicles_per_cell: int
    """How many such vehicles the uplink of a cell carries; fields come down."""
    price: float | None = None
    """Cost of both directions."""


@dataclass(frozen=True)
class Hour:
    """An hour of a vehicle on a road, with each codec of ``estimates``, which ours is among."""

    vehicle: str
    demand: Demand
    road: Road
    estimates: Sequence[Estimate]
    rows: Sequence[HourRow] = field(init=False)
    most_new_share: Mapping[str, float] = field(init=False)
    """For each rival, the share of new road up to which ours takes no more bytes, 0..1."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", [self._row(one) for one in self.estimates])
        up_gb = {row.codec: row.up_gb for row in self.rows}
        if OURS not in up_gb:
            raise InvalidInput("codec", f"{OURS} is not among {', '.join(up_gb)}")
        whole_gb = replace(self.road, new_share=1.0).field_gb
        shares = {
            codec: _share(gb - up_gb[OURS], whole_gb)
            for codec, gb in up_gb.items()
            if codec != OURS
        }
        object.__setattr__(self, "most_new_share", shares)

    def _row(self, one: Estimate) -> HourRow:
        road = self.road
        up_gb = one.mbps * GB_PER_MBPS
        field_gb = road.field_gb if one.codec == OURS else 0.0
        gb = up_gb + field_gb
        return HourRow(
            self.vehicle,
            one.codec,
            up_gb,
            field_gb,
            1e3 * gb / road.speed_kmh,
            one.vehicles_per_cell,
            None if road.price_per_gb is None else gb * road.price_per_gb,
        )


def _share(spared_gb: float, whole_gb: float) -> float:
    """Return the share of ``whole_gb`` that ``spared_gb`` pays for, 0..1."""
    if spared_gb <= 0:
        return 0.0
    return min(1.0, spared_gb / whole_gb) if whole_gb > 0 else 1.0


def sample_field_mb_per_km() -> float:
    """Return the size of the sample's field over the length of its street, in MB per km.

    Raises ``InvalidInput`` where the sample is missing.
    """
    archive, scene = sample_path("fields/street.rff"), sample_path("street/empty.toml")
    for path in (archive, scene):
        if not path.is_file():
            raise InvalidInput("field-mb-per-km", f"{path} is missing: say the field's MB per km")
    length_m = float(tomllib.loads(scene.read_text(encoding="utf-8"))["geometry"]["length_m"])
    return archive.stat().st_size / 1e3 / length_m
