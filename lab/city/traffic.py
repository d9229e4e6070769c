"""Vehicles in the cells of a city over time: of a stated density, or of a trace of SUMO.

Both are an iterator of ``TrafficBlock``s, a minute each, so that a day of a city takes no memory.

Of a density, crossings follow the fluid flow model of mobility (Thomas, Gilbert, Mazziotto 1988):
from an area of perimeter L and surface A that n vehicles of mean speed v cross in any direction,
n v L / (pi A) leave per second; that is 2 n v / (pi R) for a circle of radius R. As many come in.

A trace is SUMO's FCD output (``sumo --fcd-output FILE``), XML, also as .gz, read as a stream::

    <fcd-export>
      <timestep time="0.00">
        <vehicle id="a" x="12.5" y="80.0" .../>
      </timestep>

``x`` and ``y`` are metres in the network's frame, which has to be that of the cells; an output in
degrees (``--fcd-output.geo``) cannot be used. Persons are not counted.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
from numpy.typing import NDArray

from lab.city.city import Cells, City, Density, Floats
from rfcore.errors import InvalidData, InvalidInput

INTERVAL_S = 60.0
REACH = 1.1
"""A cell takes vehicles up to so many radii from its centre: as far as a hexagon's corner is, of
whose area the radius gives a circle."""
HEXAGON_NEIGHBOURS = 6
CHUNK_BYTES = 1 << 20
ABSENT, OUTSIDE = -2, -1
MOST_BINS = 1000

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TrafficBlock:
    """T steps of ``step_s`` from ``start_s`` on, in C cells.

    ``vehicles`` [T, C]: how many are there; ``handovers_per_s`` [T, C]: how many come from a cell
    of another server; ``begun_per_s`` [T, C]: how many come from no cell, or begin there;
    ``outside`` [T]: how many are in no cell.
    """

    start_s: float
    step_s: float
    vehicles: Floats
    handovers_per_s: Floats
    begun_per_s: Floats
    outside: Floats


def stated_traffic(city: City, step_s: float = 1.0) -> Iterator[TrafficBlock]:
    """Yield the traffic of the city's density.

    Raises ``InvalidInput`` for a city without one.
    """
    density = city.density
    if density is None:
        raise InvalidInput("demand", "the city states no [demand]: add it, or give a trace (--fcd)")
    if not 0.01 <= step_s <= INTERVAL_S:
        raise InvalidInput("step-s", f"{step_s:g} is outside 0.01..{INTERVAL_S:g} s")
    to_others, to_outside = _neighbour_shares(city.cells)
    out_per_s = 2 * density.speed_mps / (math.pi * city.cells.radius_m)
    start_s, end_s = (3600 * hour for hour in (density.hours[0], density.hours[-1]))
    steps = max(1, round((end_s - start_s) / step_s))
    per_block = max(1, round(INTERVAL_S / step_s))
    for first in range(0, steps, per_block):
        numbers = np.arange(first, min(first + per_block, steps), dtype=np.float64)
        times_s = np.asarray(start_s + step_s * numbers, dtype=np.float64)
        vehicles = _stated(density, times_s)[:, None] * city.cells.weight
        next_vehicles = _stated(density, times_s + step_s)[:, None] * city.cells.weight
        more = np.maximum(0.0, next_vehicles - vehicles)
        crossings = vehicles * out_per_s
        yield TrafficBlock(
            start_s=float(times_s[0]),
            step_s=step_s,
            vehicles=vehicles,
            handovers_per_s=crossings * to_others,
            begun_per_s=crossings * to_outside + more / step_s,
            outside=np.zeros(len(times_s)),
        )


def _stated(density: Density, times_s: Floats) -> Floats:
    """Return how many vehicles a cell of weight 1 has."""
    return np.interp(times_s / 3600, density.hours, density.vehicles_per_cell)


def _neighbour_shares(cells: Cells) -> tuple[Floats, Floats]:
    """Return, of those who come into each cell, the shares from other servers and from no cell.

    Six neighbours surround a cell; where there are fewer, vehicles come from outside of the city.
    """
    others, missing = np.zeros(len(cells)), np.zeros(len(cells))
    for number, centre_m in enumerate(cells.centre_m):
        distance_m = np.linalg.norm(cells.centre_m - centre_m, axis=1)
        near = distance_m <= REACH * (cells.radius_m + cells.radius_m[number])
        near[number] = False
        around = max(HEXAGON_NEIGHBOURS, int(near.sum()))
        others[number] = (cells.server[near] != cells.server[number]).sum() / around
        missing[number] = 1 - near.sum() / around
    return others, missing


class CellMap:
    """Finds the cell of a point: the nearest one, in radii, if that is within ``REACH``."""

    def __init__(self, cells: Cells) -> None:
        self._cells = cells
        reach_m = REACH * float(cells.radius_m.max())
        low, high = cells.centre_m.min(axis=0) - reach_m, cells.centre_m.max(axis=0) + reach_m
        self._bin_m = max(reach_m, float((high - low).max()) / MOST_BINS)
        self._low_m = low
        self._bins = np.ceil((high - low) / self._bin_m).astype(np.int64)
        self._candidates = self._listed()

    def _listed(self) -> Ints:
        """Return the cells whose reach may overlap each bin, [B, K], filled up with -1."""
        lists: list[list[int]] = [[] for _ in range(int(self._bins.prod()))]
        homes = ((self._cells.centre_m - self._low_m) // self._bin_m).astype(np.int64)
        for number, (column, row) in enumerate(homes):
            for i in range(max(0, column - 1), min(self._bins[0], column + 2)):
                for j in range(max(0, row - 1), min(self._bins[1], row + 2)):
                    lists[int(i * self._bins[1] + j)].append(number)
        listed = np.full((len(lists), max(map(len, lists))), -1, dtype=np.int64)
        for row, numbers in enumerate(lists):
            listed[row, : len(numbers)] = numbers
        return listed

    def cells_of(self, points_m: Floats) -> Ints:
        """Return the cell of each of ``points_m`` [N, 2], -1 for none."""
        found = np.full(len(points_m), OUTSIDE, dtype=np.int64)
        at = np.floor((points_m - self._low_m) / self._bin_m)
        inside = np.flatnonzero(np.all((at >= 0) & (at < self._bins), axis=1))
        if not len(inside):
            return found
        columns = at[inside].astype(np.int64)
        candidates = self._candidates[columns[:, 0] * self._bins[1] + columns[:, 1]]
        offsets_m = self._cells.centre_m[candidates] - points_m[inside, None]
        radii = np.hypot(offsets_m[..., 0], offsets_m[..., 1]) / self._cells.radius_m[candidates]
        radii[candidates < 0] = np.inf
        nearest = radii.argmin(axis=1)[:, None]
        reached = np.take_along_axis(radii, nearest, axis=1)[:, 0] <= REACH
        cell = np.take_along_axis(candidates, nearest, axis=1)[:, 0]
        found[inside[reached]] = cell[reached]
        return found


@dataclass(frozen=True, eq=False)
class Positions:
    """Everybody at one moment: numbers of vehicles [N] that stay theirs, and points [N, 2]."""

    time_s: float
    numbers: Ints
    points_m: Floats


class TraceParser:
    """Takes the bytes of a trace and has its moments in ``moments``; raises ``InvalidData``."""

    def __init__(self, name: str) -> None:
        self.moments: deque[Positions] = deque()
        self._name = name
        self._parser = ParserCreate()
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._end
        self._known: dict[str, int] = {}
        self._numbers: list[int] = []
        self._points: list[tuple[float, float]] = []
        self._time_s: float | None = None
        self._last_s = -math.inf
        self._begun = False

    def feed(self, data: bytes, *, last: bool = False) -> None:
        """Take the next bytes; ``last``: nothing follows."""
        try:
            self._parser.Parse(data, last)
        except ExpatError as error:
            raise InvalidData(f"{self._name}: damaged or cut off: {error}") from None

    def _error(self, problem: str) -> InvalidData:
        return InvalidData(f"{self._name}: line {self._parser.CurrentLineNumber}: {problem}")

    def _begin(self, name: str, values: dict[str, str]) -> None:
        if not self._begun and name != "fcd-export":
            raise self._error(f"<{name}> is no FCD output of SUMO, which begins with <fcd-export>")
        self._begun = True
        if name == "vehicle":
            self._vehicle(values)
        elif name == "timestep":
            self._time_s = self._number(name, "time", values)
            if not self._time_s > self._last_s:
                raise self._error(f"time {self._time_s:g} s follows {self._last_s:g} s")

    def _vehicle(self, values: dict[str, str]) -> None:
        name = values.get("id")
        if not name:
            raise self._error("a <vehicle> has no id")
        if self._time_s is None:
            raise self._error(f"vehicle {name!r} is in no <timestep>")
        point_m = self._number(name, "x", values), self._number(name, "y", values)
        self._points.append(point_m)
        self._numbers.append(self._known.setdefault(name, len(self._known)))

    def _number(self, name: str, key: str, values: dict[str, str]) -> float:
        try:
            number = float(values[key])
        except KeyError:
            raise self._error(f"{name!r} has no {key}") from None
        except ValueError:
            raise self._error(f"{key} of {name!r} is {values[key]!r}, not a number") from None
        if not math.isfinite(number):
            raise self._error(f"{key} of {name!r} is {number}, must be finite")
        return number

    def _end(self, name: str) -> None:
        if name != "timestep" or self._time_s is None:
            return
        if len(set(self._numbers)) < len(self._numbers):
            raise self._error(f"a vehicle is there twice at {self._time_s:g} s")
        numbers = np.array(self._numbers, dtype=np.int64)
        points_m = np.array(self._points, dtype=np.float64).reshape(-1, 2)
        self.moments.append(Positions(self._time_s, numbers, points_m))
        self._last_s, self._time_s = self._time_s, None
        self._numbers.clear()
        self._points.clear()


def _moments(path: Path) -> Iterator[Positions]:
    parser = TraceParser(str(path))
    with _opened(path) as file:
        try:
            while data := file.read(CHUNK_BYTES):
                parser.feed(data)
                while parser.moments:
                    yield parser.moments.popleft()
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise InvalidData(f"{path}: damaged or cut off: {error}") from None
    parser.feed(b"", last=True)


def _opened(path: Path) -> gzip.GzipFile | BinaryIO:
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")


class CellCounter:
    """Counts the vehicles, handovers and beginnings of each step."""

    def __init__(self, city: City) -> None:
        self._server = city.cells.server
        self._map = CellMap(city.cells)
        self._cell_before = np.full(1024, ABSENT, dtype=np.int64)
        self._before: Ints | None = None
        self.covered = 0

    def count(self, moment: Positions) -> tuple[Ints, Ints, Ints, int]:
        """Return, by cell, vehicles, handovers and beginnings, and how many are in no cell.

        Who is there at the first moment has begun before.
        """
        now = self._map.cells_of(moment.points_m)
        self._grow(int(moment.numbers.max(initial=-1)) + 1)
        before = self._cell_before[moment.numbers]
        came = now >= 0
        begun = came & (before < 0) if self._before is not None else np.zeros(len(now), dtype=bool)
        moved = came & (before >= 0)
        moved[moved] = self._server[now[moved]] != self._server[before[moved]]
        self._remember(moment.numbers, now)
        self.covered += int(came.sum())
        counts = (
            np.bincount(now[who], minlength=len(self._server)) for who in (came, moved, begun)
        )
        vehicles, handovers, beginnings = counts
        return vehicles, handovers, beginnings, int((~came).sum())

    def _remember(self, numbers: Ints, cells: Ints) -> None:
        if self._before is not None:
            self._cell_before[self._before] = ABSENT
        self._cell_before[numbers] = cells
        self._before = numbers

    def _grow(self, size: int) -> None:
        more = size - len(self._cell_before)
        if more > 0:
            added = np.full(max(more, len(self._cell_before)), ABSENT, dtype=np.int64)
            self._cell_before = np.concatenate([self._cell_before, added])


def trace_traffic(city: City, path: Path) -> Iterator[TrafficBlock]:
    """Yield the traffic of a trace, in its own steps.

    Raises ``InvalidData`` naming the line of what is damaged, for steps of different lengths, and
    for a trace that has nobody in any cell; ``OSError`` for a file that cannot be read.
    """
    return _counted(city, path, _moments(path))


def _counted(city: City, path: Path, moments: Iterator[Positions]) -> Iterator[TrafficBlock]:
    """Yield the traffic of moments that follow each other in equal steps."""
    counter = CellCounter(city)
    times_s: list[float] = []
    counts: list[tuple[Ints, Ints, Ints, int]] = []
    step_s: float | None = None
    for moment in moments:
        if times_s:
            step_s = _checked_step(path, moment.time_s - times_s[-1], step_s)
            if moment.time_s - times_s[0] >= INTERVAL_S - step_s / 2:
                yield _block(times_s[0], step_s, counts)
                times_s, counts = [], []
        times_s.append(moment.time_s)
        counts.append(counter.count(moment))
    if step_s is None:
        raise InvalidData(f"{path}: {len(times_s)} timesteps; it takes two or more")
    if not counter.covered:
        raise InvalidData(
            f"{path}: no vehicle is in any cell; the cells' metres have to be the network's, and "
            "positions in degrees (--fcd-output.geo) cannot be used"
        )
    yield _block(times_s[0], step_s, counts)


def _checked_step(path: Path, step_s: float, known_s: float | None) -> float:
    if known_s is not None and abs(step_s - known_s) > 1e-3 * known_s:
        raise InvalidData(f"{path}: steps of {known_s:g} s and of {step_s:g} s; all must be equal")
    if step_s > INTERVAL_S:
        raise InvalidData(f"{path}: steps of {step_s:g} s; at most {INTERVAL_S:g} s are of use")
    return step_s if known_s is None else known_s


def _block(
    start_s: float, step_s: float, counts: Sequence[tuple[Ints, Ints, Ints, int]]
) -> TrafficBlock:
    vehicles, handovers, begun, outside = zip(*counts, strict=True)
    return TrafficBlock(
        start_s=start_s,
        step_s=step_s,
        vehicles=np.array(vehicles, dtype=np.float64),
        handovers_per_s=np.array(handovers) / step_s,
        begun_per_s=np.array(begun) / step_s,
        outside=np.array(outside, dtype=np.float64),
    )
