"""Pages of the tables that ship with ``rfedge size``, and of what the flow model says of cities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from lab.city.city import Density, VehicleKind, grid_city
from lab.city.flow import costs_of
from lab.city.plan import MinuteRow, plan_city
from lab.city.traffic import stated_traffic
from lab.report import Report, bars
from rfedge.report.tables import Column, Table
from rfedge.results import Result, rows_of
from rfedge.sizing.estimate import Demand, estimate
from rfedge.sizing.tables import CODECS, SHIPPED, SizingCell, read_tables, shipped_tables

PAGE_DB = (32.0, 34.0, 36.0)
BAR_DB = 34.0
TOLD = ((640, 360, 10.0), (1280, 720, 15.0), (1920, 1080, 30.0))
"""Pictures and rates of which the README and the page's finding tell."""
CITY_SERVERS = (10, 100, 1000)
CITY_CORES = (2, 4)
CITY_KIND = VehicleKind(Demand(1, 640, 360, 10.0, 34.0))


@dataclass(frozen=True)
class ToldCamera:
    """A camera of ``TOLD``, and its Mbit/s by ``rfedge size`` at ``BAR_DB``."""

    width_px: int
    height_px: int
    hz: float
    ours_mbps: float
    x264_mbps: float

    def name(self, between: str) -> str:
        """Return its size and rate."""
        return f"{self.width_px}x{self.height_px}{between}{self.hz:g} Hz"


def told_cameras() -> Iterator[ToldCamera]:
    """Yield the cameras of ``TOLD`` by the tables that ship."""
    for width_px, height_px, hz in TOLD:
        told = estimate(Demand(1, width_px, height_px, hz, BAR_DB), shipped_tables())
        mbps = {row.codec: row.mbps for row in told.estimates}
        yield ToldCamera(width_px, height_px, hz, mbps["rfedge"], mbps["x264"])


def _parts(result: Result) -> Iterator[Table | str]:
    cells = sorted(
        rows_of(SizingCell, result["cells"]),
        key=lambda cell: (cell.pixels, cell.hz, CODECS.index(cell.codec)),
    )
    drive = [
        Column("size", lambda cell: (cell.width_px, cell.height_px), "{}x{}"),
        Column("Hz", lambda cell: cell.hz, ".3g"),
        Column("codec", lambda cell: cell.codec),
    ]
    rates = [_rate_column(db) for db in PAGE_DB]
    times = [
        Column("sender ms", lambda cell: cell.sender_ms, ".1f"),
        Column("receiver ms", lambda cell: cell.receiver_ms, ".1f"),
    ]
    yield (
        f"{str(result['measured_on']).capitalize()}; one thread. kbit/s of one camera without "
        "transport, with the 95 % interval; processor time a frame near 34 dB, of both ends. n/a: "
        "the clip's curve does not reach that quality."
    )
    yield Table("kbit/s", [*drive, *rates, *times], cells)
    yield (
        "`make sizing` measures the tables again. All cells are of one street, with vehicles that "
        "the field has never seen, and of one field of 640x360 pictures: at 1920x1080 its renders "
        "are soft. At 30 Hz a third of a second was rendered, with 4 samples a pixel."
    )
    yield city_table()


def _rate_column(db: float) -> Column:
    """Return kbit/s with the interval at a quality."""

    def rate(cell: SizingCell) -> tuple[float, float, float] | None:
        if db not in cell.psnr_db:
            return None
        at = list(cell.psnr_db).index(db)
        sizes = (cell.bytes_per_frame, cell.low_bytes, cell.high_bytes)
        mean, low, high = (column[at] * 8e-3 * cell.hz for column in sizes)
        return mean, low, high

    return Column(f"{db:g} dB", rate, "{:.0f} ({:.0f}..{:.0f})", "n/a")


def city_table() -> Table:
    """Return what the flow model says of cities of 10 vehicles a server."""
    rows = [
        (servers, cores, _minute(servers, cores))
        for servers in CITY_SERVERS
        for cores in CITY_CORES
    ]
    made = [
        Column("servers", lambda row: row[0]),
        Column("cores each", lambda row: row[1]),
        Column(
            "vehicles (refused)", lambda row: (row[2].vehicles, row[2].refused), "{:.0f} ({:.0f})"
        ),
        Column("cores in use", lambda row: row[2].cores, ".0f"),
        Column("Mbit/s up", lambda row: row[2].uplink_mbps, ".0f"),
        Column("Mbit/s down", lambda row: row[2].downlink_mbps, ".0f"),
        Column("handovers/s", lambda row: row[2].handovers_per_s, ".1f"),
        Column(
            "age p50 / p99, ms",
            lambda row: (row[2].age_p50_ms, row[2].age_p99_ms),
            "{:.0f} / {:.0f}",
        ),
    ]
    return Table(
        "Cities of 10 vehicles a server, by the flow model of `rfedge-lab city`", made, rows
    )


def _minute(servers: int, cores: int) -> MinuteRow:
    density = Density((8.0, 8.0 + 1 / 3600), (10.0, 10.0))
    city = grid_city(CITY_KIND, density, servers, cores, busy_weight=2.0)
    (row,) = plan_city(city, costs_of(city, read_tables(SHIPPED)), stated_traffic(city)).rows
    return row


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for cell in rows_of(SizingCell, result["cells"]):
        if BAR_DB in cell.psnr_db:
            at = list(cell.psnr_db).index(BAR_DB)
            name = f"{cell.codec}, {cell.width_px}x{cell.height_px}, {cell.hz:.3g} Hz"
            yield name, cell.bytes_per_frame[at] * 8e-3 * cell.hz


REPORT = Report(
    "sizing",
    "Tables of `rfedge size`",
    "What a camera needs of an uplink and of both processors by size, rate and quality, ours and "
    "the rivals'. `rfedge size` interpolates between these figures.",
    _parts,
    bars("kbit/s at 34 dB", _bars),
)
