"""A city to be planned: radio cells, the servers behind them, and what every vehicle sends.

::

    seed = 1
    [vehicle]                   # each of them; the tables of `rfedge size` say what it takes
    cameras = 1
    size = "640x360"
    hz = 10.0
    psnr_db = 34.0
    moving_percent = 18.7       # of a picture's area, what the field has never seen
    max_age_ms = 200.0          # 99 % of the pictures are reconstructed so soon after capture
    [network]
    overhead_percent = 4.0      # of transport, over the bytes of frames
    propagation_ms = 20.0       # one way
    [tile]
    field_mb = 3.62             # 10^6 bytes; fetched by a vehicle that comes without it
    known_percent = 90.0        # vehicles that hold the field already when they come
    [admission]                 # of every server, as mec-server has them
    max_load = 0.8
    lowest_hz = 2.0
    streams = 256
    [[server]]
    name = "centre"
    cores = 4
    [[cell]]
    name = "market"
    centre_m = [0.0, 0.0]       # east, north
    radius_m = 115.0
    uplink_mbps = 86.9          # what may be planned with, shared by the vehicles in the cell
    downlink_mbps = 400.0
    server = "centre"
    weight = 2.0                # of the stated density
    [demand]                    # not with a trace of SUMO
    hours = [7.0, 8.0, 9.0]
    vehicles_per_cell = [4.0, 12.0, 6.0]
    speed_mps = 8.0

In place of ``[[server]]`` and ``[[cell]]`` a table ``[grid]`` lays hexagons out in rows, neighbours
in a row sharing a server: ``cells``, ``cells_per_server``, ``spacing_m``, ``cores``,
``uplink_mbps``, ``downlink_mbps``, and ``busy_weight``, how much denser the busiest cell is than
the mean (weights fall exponentially with the distance from the middle).
"""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mec_server.config import AdmissionLimits
from rfcore.errors import InvalidData, InvalidInput
from rfcore.tables import Range, Table
from rfcore.wire.values import MAX_CAMERAS
from rfedge.arguments import parse_size
from rfedge.sizing.estimate import Assumptions, Demand

Floats = NDArray[np.float64]

MAX_CELLS = 20_000
TABLES_MOVING_PERCENT = 18.7
EMPTY_STREET_SHARE = 1205 / 2691
"""Bytes of a frame at 34 dB, 10 Hz and 640x360, where everything that is seen is in the field, over
those where 18.7 % of the area is not: the rows ``curves`` and ``bits`` of lab/results/compare.json
for the sample street without and with vehicles. Between and beyond the two a straight
line is drawn."""


@dataclass(frozen=True)
class VehicleKind:
    """A vehicle's demand, and the time in which 99 % of its pictures have to be reconstructed."""

    demand: Demand
    moving_percent: float = TABLES_MOVING_PERCENT
    max_age_ms: float = 200.0

    def __post_init__(self) -> None:
        if not 0 <= self.moving_percent <= 100:
            raise InvalidInput("moving_percent", f"{self.moving_percent:g} is outside 0..100")
        if not 0 < self.max_age_ms <= 60_000:
            raise InvalidInput("max_age_ms", f"{self.max_age_ms:g} is outside 0..60000")

    @property
    def bytes_factor(self) -> float:
        """Bytes of a frame over those of the tables, for what of its area is not in the field."""
        moving = self.moving_percent / TABLES_MOVING_PERCENT
        return EMPTY_STREET_SHARE + (1 - EMPTY_STREET_SHARE) * moving


@dataclass(frozen=True)
class Tile:
    """The field of a server's tile, and the share of the vehicles that come with it."""

    field_bytes: float = 3.62e6
    known_share: float = 0.9


@dataclass(frozen=True)
class Admission:
    """The product's limits of admission, and the most streams of a server."""

    limits: AdmissionLimits = field(default_factory=AdmissionLimits)
    streams: int = 256


@dataclass(frozen=True, eq=False)
class Cells:
    """C cells: ``centre_m`` [C, 2] (east, north), the others [C]; ``server``: which one, 0..S-1."""

    names: tuple[str, ...]
    centre_m: Floats
    radius_m: Floats
    uplink_bps: Floats
    downlink_bps: Floats
    server: NDArray[np.int64]
    weight: Floats

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Servers:
    """S servers: names, and cores [S] that reconstruct frames."""

    names: tuple[str, ...]
    cores: Floats

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Density:
    """Vehicles in a cell of weight 1, straight between the stated ``hours``; their mean speed."""

    hours: tuple[float, ...]
    vehicles_per_cell: tuple[float, ...]
    speed_mps: float = 8.0

    def __post_init__(self) -> None:
        if len(self.hours) != len(self.vehicles_per_cell) or len(self.hours) < 2:
            raise InvalidInput(
                "demand.hours",
                f"{len(self.hours)} hours and {len(self.vehicles_per_cell)} vehicles_per_cell: "
                "give two or more of each, as many of one as of the other",
            )
        if any(b <= a for a, b in zip(self.hours, self.hours[1:], strict=False)):
            raise InvalidInput("demand.hours", f"{list(self.hours)} must ascend")


@dataclass(frozen=True, eq=False)
class City:
    """All of it; ``density`` is None where only a trace can say who drives where."""

    vehicle: VehicleKind
    cells: Cells
    servers: Servers
    assumptions: Assumptions = Assumptions()
    tile: Tile = Tile()
    admission: Admission = Admission()
    density: Density | None = None
    seed: int = 1

    def at_server(self, values: Floats) -> Floats:
        """Return the sums over each server's cells, [..., S] of [..., C]."""
        sums = np.zeros((*values.shape[:-1], len(self.servers)))
        np.add.at(np.moveaxis(sums, -1, 0), self.cells.server, np.moveaxis(values, -1, 0))
        return sums


def read_city(path: Path) -> City:
    """Read a city.

    Raises ``InvalidInput`` naming the file, the key, its value and the limit, ``InvalidData`` for a
    file that is no TOML, ``OSError`` for one that cannot be read.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidData(f"{path}: not a city ({error})") from error
    try:
        return _city(Table(values, InvalidInput))
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error.field}", error.problem) from error


def _city(top: Table) -> City:
    seed = top.whole("seed", Range(0, 2**32 - 1), 1)
    if ("grid" in top) == ("cell" in top or "server" in top):
        raise top.error("grid", "give either [grid], or [[server]] and [[cell]]")
    if "grid" in top:
        cells, servers = _grid(top.table("grid"))
    else:
        servers = _servers(top)
        cells = _cells(top, servers)
    network = top.table("network", {})
    assumptions = Assumptions(
        overhead_percent=network.number("overhead_percent", Range(0, 1000), 4.0),
        propagation_ms=network.number("propagation_ms", Range(0, 1000), 20.0),
    )
    network.finish()
    city = City(
        vehicle=_vehicle(top.table("vehicle")),
        cells=cells,
        servers=servers,
        assumptions=assumptions,
        tile=_tile(top.table("tile", {})),
        admission=_admission(top.table("admission", {})),
        density=_density(top.table("demand")) if "demand" in top else None,
        seed=seed,
    )
    top.finish("cell", "server", "grid", "demand")
    return city


def _vehicle(table: Table) -> VehicleKind:
    width_px, height_px = parse_size(table.text("size", "640x360"))
    demand = Demand(
        table.whole("cameras", Range(1, MAX_CAMERAS), 1),
        width_px,
        height_px,
        table.number("hz", Range(0.1, 1000), 10.0),
        table.number("psnr_db", default=34.0),
    )
    moving_percent = table.number("moving_percent", default=TABLES_MOVING_PERCENT)
    kind = VehicleKind(demand, moving_percent, table.number("max_age_ms", default=200.0))
    table.finish()
    return kind


def _tile(table: Table) -> Tile:
    tile = Tile(
        1e6 * table.number("field_mb", Range(0, 1e5), 3.62),
        table.number("known_percent", Range(0, 100), 90.0) / 100,
    )
    table.finish()
    return tile


def _admission(table: Table) -> Admission:
    limits = AdmissionLimits(
        load=table.number("max_load", Range(0.01, 1), 0.8),
        lowest_hz=table.number("lowest_hz", Range(0.01, 1000), 2.0),
    )
    admission = Admission(limits, table.whole("streams", Range(1, 100_000), 256))
    table.finish()
    return admission


def _density(table: Table) -> Density:
    density = Density(
        tuple(table.numbers("hours", within=Range(0, 48))),
        tuple(table.numbers("vehicles_per_cell", within=Range(0, 1e5))),
        table.number("speed_mps", Range(0, 100), 8.0),
    )
    table.finish()
    return density


def _servers(top: Table) -> Servers:
    names, cores = [], []
    for index, values in enumerate(top.items("server")):
        table = Table(values, InvalidInput, f"server[{index}]")
        names.append(table.text("name"))
        cores.append(float(table.whole("cores", Range(1, 10_000))))
        table.finish()
    _check_names(top, "server", names)
    return Servers(tuple(names), np.array(cores))


def _cells(top: Table, servers: Servers) -> Cells:
    rows = [
        _cell(Table(values, InvalidInput, f"cell[{index}]"), servers)
        for index, values in enumerate(top.items("cell"))
    ]
    names = [row[0] for row in rows]
    _check_names(top, "cell", names)
    columns = np.array([row[1:] for row in rows])
    return Cells(
        names=tuple(names),
        centre_m=columns[:, 0:2],
        radius_m=columns[:, 2],
        uplink_bps=columns[:, 3],
        downlink_bps=columns[:, 4],
        server=columns[:, 5].astype(np.int64),
        weight=columns[:, 6],
    )


def _cell(
    table: Table, servers: Servers
) -> tuple[str, float, float, float, float, float, int, float]:
    east_m, north_m = table.numbers("centre_m", 2)
    name = table.text("name")
    server = servers.names.index(table.choice("server", servers.names))
    row = (
        name,
        east_m,
        north_m,
        table.number("radius_m", Range(1, 1e6)),
        1e6 * table.number("uplink_mbps", Range(1e-3, 1e6)),
        1e6 * table.number("downlink_mbps", Range(1e-3, 1e6)),
        server,
        table.number("weight", Range(0, 1e6), 1.0),
    )
    table.finish()
    return row


def _check_names(top: Table, key: str, names: Sequence[str]) -> None:
    if not 1 <= len(names) <= MAX_CELLS:
        raise top.error(key, f"has {len(names)} entries, outside 1..{MAX_CELLS}")
    name, times = Counter(names).most_common(1)[0]
    if times > 1:
        raise top.error(key, f"has {name!r} {times} times; every one needs a name of its own")


def _grid(table: Table) -> tuple[Cells, Servers]:
    grid = (
        table.whole("cells", Range(1, MAX_CELLS)),
        table.whole("cells_per_server", Range(1, MAX_CELLS), 1),
        table.number("spacing_m", Range(1, 1e5), 200.0),
        table.whole("cores", Range(1, 10_000)),
        table.number("uplink_mbps", Range(1e-3, 1e6)),
        table.number("downlink_mbps", Range(1e-3, 1e6)),
        table.number("busy_weight", Range(1, 100), 1.0),
    )
    table.finish()
    return _hexagons(*grid)


def grid_city(
    vehicle: VehicleKind, density: Density, servers: int, cores: int, busy_weight: float = 1.0
) -> City:
    """Return a city of one dense urban cell of ``Assumptions`` a server."""
    assumed = Assumptions()
    uplink_mbps = assumed.planned_cell_mbps
    layout = (servers, 1, assumed.inter_site_m, cores, uplink_mbps, DOWNLINK_MBPS, busy_weight)
    cells, behind = _hexagons(*layout)
    return City(vehicle, cells, behind, density=density)


DOWNLINK_MBPS = 404.0
"""100 MHz x 0.74 of the time x 7.8 bit/s/Hz (ITU-R M.2410, dense urban, downlink) x 0.7: the rest
of the slots of the uplink in ``Assumptions``, planned with the same utilisation."""


def _hexagons(
    count: int,
    cells_per_server: int,
    spacing_m: float,
    cores: int,
    uplink_mbps: float,
    downlink_mbps: float,
    busy_weight: float,
) -> tuple[Cells, Servers]:
    """Return a hexagonal grid as square as it can be, row by row; a cell's radius is that of the
    circle of its area."""
    columns = math.ceil(math.sqrt(count))
    row, column = np.divmod(np.arange(count), columns)
    east_m = spacing_m * (column + 0.5 * (row % 2))
    north_m = spacing_m * row * math.sqrt(3) / 2
    centre_m = np.stack([east_m, north_m], axis=1)
    area_m2 = math.sqrt(3) / 2 * spacing_m**2
    server = np.arange(count) // cells_per_server
    names = tuple(f"cell-{number}" for number in range(count))
    cells = Cells(
        names=names,
        centre_m=centre_m,
        radius_m=np.full(count, math.sqrt(area_m2 / math.pi)),
        uplink_bps=np.full(count, 1e6 * uplink_mbps),
        downlink_bps=np.full(count, 1e6 * downlink_mbps),
        server=server,
        weight=_weights(centre_m, busy_weight),
    )
    behind = int(server[-1]) + 1
    servers = Servers(
        tuple(f"server-{number}" for number in range(behind)), np.full(behind, float(cores))
    )
    return cells, servers


def _weights(centre_m: Floats, busy_weight: float) -> Floats:
    """Return weights of mean 1 that fall as exp(-distance / scale) from the middle, whose largest
    is ``busy_weight``, or as near to it as the number of cells permits (Clark 1951: densities of
    cities fall exponentially)."""
    if busy_weight == 1.0 or len(centre_m) == 1:
        return np.ones(len(centre_m))
    distance_m = np.linalg.norm(centre_m - centre_m.mean(axis=0), axis=1)
    low, high = 1e-3 * distance_m.max(), 1e3 * distance_m.max()
    for _ in range(60):
        scale_m = math.sqrt(low * high)
        weights = np.exp(-(distance_m - distance_m.min()) / scale_m)
        low, high = (scale_m, high) if 1 / weights.mean() > busy_weight else (low, scale_m)
    return np.asarray(weights / weights.mean())
