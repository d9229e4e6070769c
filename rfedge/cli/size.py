"""``rfedge size``: how large an uplink, and how many cores, a vehicle's cameras need."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, arg

from rfedge.arguments import DATASET, FIELD, FOLDER, SIZE, field_path, parse_size
from rfedge.sizing.estimate import Assumptions

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

    from rfedge.sizing.estimate import Demand, Estimate, FleetEstimate, Sizing
    from rfedge.sizing.hour import Hour
    from rfedge.sizing.tables import SizingTables


COLUMNS = 88
"""Letters of a line below the plot: as wide as the bars and the legend."""


@dataclass(frozen=True)
class Size:
    """Estimate the uplink and the cores that cameras need with us, x264, x265 and SVT-AV1.

    The estimate comes from tables measured on the sample street (lab/results/sizing.md), or from
    your own drive and field.
    """

    vehicles: int = 1
    """Vehicles; of more than one, totals are printed, too."""
    cameras: int = 1
    """Cameras of a vehicle; they take their pictures at the same instant."""
    size: Annotated[str, SIZE] = "1920x1080"
    """Size of a picture, px."""
    hz: float = 10.0
    """Pictures per second of each camera."""
    db: float = 34.0
    """Luma PSNR of the reconstruction, dB."""
    delay_ms: float | None = None
    """Also estimate the link that keeps this time from a picture to its reconstruction, ms."""
    share: float = 0.99
    """Share of the frames that must keep --delay-ms."""
    drive: Annotated[Path | None, DATASET] = None
    """Measure on this drive instead of using the tables; needs --field and the extra eval."""
    field: Annotated[Path | None, FIELD] = None
    """The field of --drive."""
    frames: int = 24
    """Largest number of frames of --drive to measure."""
    speed_kmh: float | None = None
    """Also estimate an hour at this speed, km/h: bytes a km, the field's among them, and cost."""
    hour: bool = False
    """Also estimate an hour of a bus, a lorry and a robot taxi, whose cameras, speeds and roads are
    assumptions."""
    new_road: float = 1.0
    """With --speed-kmh: share of the road whose field the vehicle does not hold yet."""
    field_mb_per_km: float | None = None
    """MB of the field of a kilometre; without it, as many as the sample's."""
    price_per_gb: float | None = None
    """Price of a GB in either direction, in any currency."""
    cells: Annotated[Path, FOLDER] = Path("out/size")
    """Folder of finished measurements, from which a stopped run goes on."""
    assumptions: Annotated[Assumptions, OmitArgPrefixes] = Assumptions()
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Also write one JSON object to this file; `-` is standard output, in place of the tables."""
    plot: Annotated[Path | None, arg(metavar="FILE.svg|png|pdf")] = None
    """Draw the rates and links of all vehicles for a report."""

    def run(self) -> None:
        """Estimate, print, and write what is asked for."""
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfedge.results import make_result, provenance, write_result
        from rfedge.sizing.estimate import Demand, estimate

        width_px, height_px = parse_size(self.size)
        demand = Demand(
            self.cameras,
            width_px,
            height_px,
            self.hz,
            self.db,
            self.delay_ms,
            self.share,
            self.vehicles,
        )
        if self.plot is not None and self.plot.suffix not in (".svg", ".png", ".pdf"):
            raise InvalidInput("plot", f"{self.plot} does not end in .svg, .png or .pdf")
        tables = self._tables(demand)
        sizing = estimate(demand, tables, self.assumptions)
        hours = self._hours(sizing, tables)
        if self.json != "-":
            print_sizing(Console(), sizing)
            if hours:
                print_hours(Console(), hours)
        if self.plot is not None:
            write_sizing_plot(sizing, self.plot)
        if self.json is not None:
            made = {"sizing": sizing, **({"hours": hours} if hours else {})}
            write_result(self.json, make_result("size", provenance(), made))

    def _hours(self, sizing: Sizing, tables: SizingTables) -> list[Hour]:
        """Return what is asked for: an hour of the vehicle, and of the named ones."""
        from rfedge.sizing.estimate import Demand, estimate
        from rfedge.sizing.hour import NAMED_VEHICLES, Hour, Road, sample_field_mb_per_km

        if self.speed_kmh is None and not self.hour:
            return []
        per_km = self.field_mb_per_km
        mb_per_km = sample_field_mb_per_km() if per_km is None else per_km
        hours = []
        if self.speed_kmh is not None:
            road = Road(self.speed_kmh, self.new_road, mb_per_km, self.price_per_gb)
            hours.append(Hour("yours", sizing.demand, road, sizing.estimates))
        for named in NAMED_VEHICLES if self.hour else ():
            demand = Demand(named.cameras, named.width_px, named.height_px, named.hz, self.db)
            made = estimate(demand, tables, self.assumptions).estimates
            road = Road(named.speed_kmh, named.new_share, mb_per_km, self.price_per_gb)
            hours.append(Hour(named.name, demand, road, made))
        return hours

    def _tables(self, demand: Demand) -> SizingTables:
        from rfcore.errors import InvalidInput
        from rfedge.sizing.tables import shipped_tables

        if (self.drive is None) != (self.field is None):
            raise InvalidInput("drive", "give --drive and --field together, or neither")
        if self.drive is None or self.field is None:
            return shipped_tables()
        from rfedge.sizing.measure import own_tables

        return own_tables(self.drive, field_path(self.field), demand, self.frames, self.cells)


def print_sizing(console: Console, sizing: Sizing) -> None:
    """Print the estimates, what they assume, and where they leave what was measured."""
    from rich import box
    from rich.table import Table

    demand, assumed = sizing.demand, sizing.assumptions
    console.print(f"A vehicle with {_cameras(demand)}")
    table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
    names = ["codec", "Mbit/s", "95 %", "cores", "at server", "a cell", "a km2"]
    if demand.delay_ms is not None:
        names[3:3] = ["link", "least"]
    for number, name in enumerate(names):
        table.add_column(name, justify="right" if number else "left", no_wrap=True)
    for row in sizing.estimates:
        cells = [
            row.codec,
            f"{row.mbps:.2f}",
            _interval(row),
            f"{row.vehicle_cores:.2f}",
            f"{row.server_cores:.2f}",
            f"{row.vehicles_per_cell}",
            f"{row.vehicles_per_km2:.0f}",
        ]
        if demand.delay_ms is not None:
            links = (row.link_mbps, row.least_link_mbps)
            cells[3:3] = ["none" if mbps is None else f"{mbps:.2f}" for mbps in links]
        table.add_row(*cells)
    console.print(table)
    if demand.vehicles > 1:
        console.print(_fleet_table(sizing))
    console.print(
        "Mbit/s of one vehicle with transport; 95 %: interval, if this size and rate were "
        "measured; cores on the vehicle and at the server; vehicles that a cell and a km2 carry."
    )
    if demand.delay_ms is not None:
        console.print(
            f"least: the slowest link, Mbit/s, that brings {100 * demand.share:g} % of the frames "
            f"measured within {demand.delay_ms:g} ms. link: at least that, and at most "
            f"{100 * assumed.utilisation:g} % used by the mean rate, as other streets vary more."
        )
    console.print(f"Measured on {sizing.measured_on}; steady state, without first frames.")
    console.print(f"Measured: {sizing.measured_at}; logarithms are interpolated between them.")
    console.print(f"Cores and times were measured on {sizing.measured_machine}.")
    stated = (
        f"{assumed.bandwidth_mhz:g} MHz x {assumed.uplink_share:g} up x "
        f"{assumed.bits_per_hz:g} bit/s/Hz"
        if assumed.cell_mbps is None
        else f"{assumed.cell_mbps:g} Mbit/s"
    )
    divisor = "Mbit/s" if demand.delay_ms is None else "least"
    console.print(
        f"Cell: {stated} x {assumed.utilisation:g} = {assumed.planned_cell_mbps:.1f} Mbit/s, over "
        f"{divisor}: vehicles a cell; {assumed.cells_per_km2:.0f} cells a km2; "
        f"{assumed.overhead_percent:g} % transport"
    )
    for note in sizing.beyond:
        console.print(f"[yellow]Note[/]: {note}")
    for warning in sizing.warnings:
        console.print(f"[bold red]Warning[/]: {warning}")


def _cameras(demand: Demand) -> str:
    cameras = "1 camera" if demand.cameras == 1 else f"{demand.cameras} cameras"
    return (
        f"{cameras} of {demand.width_px}x{demand.height_px} px at {demand.hz:g} Hz, "
        f"{demand.psnr_db:g} dB luma PSNR"
    )


def _interval(row: Estimate | FleetEstimate) -> str:
    return "-" if row.low_mbps is None else f"{row.low_mbps:.3g}..{row.high_mbps:.3g}"


def _fleet_table(sizing: Sizing) -> RichTable:
    from rich import box
    from rich.table import Table

    demand = sizing.demand
    title = f"All {demand.vehicles} vehicles"
    table = Table(box=box.SIMPLE, pad_edge=False, title=title, title_justify="left")
    names = ["codec", "Mbit/s", "95 %", "cores at server", "cells"]
    if demand.delay_ms is not None:
        names.insert(3, "links")
    for number, name in enumerate(names):
        table.add_column(name, justify="right" if number else "left", no_wrap=True)
    for row in sizing.fleet:
        cells = [
            row.codec,
            f"{row.mbps:.1f}",
            _interval(row),
            f"{row.server_cores:.1f}",
            "-" if row.cells is None else f"{row.cells}",
        ]
        if demand.delay_ms is not None:
            cells.insert(3, "none" if row.link_mbps is None else f"{row.link_mbps:.1f}")
        table.add_row(*cells)
    return table


def print_hours(console: Console, hours: Sequence[Hour]) -> None:
    """Print an hour of each vehicle, what it assumes, and how much new road a field is worth."""
    from rich import box
    from rich.table import Table

    from rfedge.sizing.hour import OURS

    priced = hours[0].road.price_per_gb is not None
    title = "An hour of one vehicle"
    table = Table(box=box.SIMPLE, pad_edge=False, title=title, title_justify="left")
    names = ["vehicle", "codec", "GB up", "GB of fields", "MB a km", "a cell"]
    for number, name in enumerate([*names, *(["cost"] if priced else [])]):
        table.add_column(name, justify="right" if number > 1 else "left", no_wrap=True)
    for hour in hours:
        for row in hour.rows:
            shown = [row.vehicle, row.codec, f"{row.up_gb:.2f}", f"{row.field_gb:.2f}"]
            shown += [f"{row.mb_per_km:.1f}", f"{row.vehicles_per_cell}"]
            table.add_row(*shown, *([] if row.price is None else [f"{row.price:.2f}"]))
    console.print(table)
    for hour in hours:
        road = hour.road
        limits = [f"{100 * share:.3g} % ({codec})" for codec, share in hour.most_new_share.items()]
        console.print(
            f"{hour.vehicle}: {_cameras(hour.demand)}; {road.speed_kmh:g} km/h, "
            f"{100 * road.new_share:g} % of the road new. Fields included, {OURS} takes less "
            f"while less of it is new than: {', '.join(limits)}."
        )
    console.print(
        f"Field: {hours[0].road.field_mb_per_km:.1f} MB a km, fetched for new road alone. a cell: "
        "vehicles that its uplink carries; fields come down. Bus, lorry and robot taxi are assumed."
    )


def write_sizing_plot(sizing: Sizing, path: Path) -> None:
    """Draw the mean rate with its interval, and the link that keeps the delay, of all vehicles with
    each codec; the title and the lines below the picture have the conditions and all notes."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    from rfcore.files import write_whole
    from rfedge.report.charts import BLUE, GREY, INK, STYLE

    demand, fleet = sizing.demand, sizing.fleet
    many = demand.vehicles > 1
    vehicles = f"{demand.vehicles} vehicles, each" if many else "1 vehicle"
    conditions = [
        f"Measured on {sizing.measured_on}; steady state, without first frames.",
        *(
            ["No 95 % interval: this size and rate were not measured together."]
            if any(row.low_mbps is None for row in fleet)
            else ()
        ),
        *(f"Note: {note}." for note in sizing.beyond),
        *(f"Warning: {warning}." for warning in sizing.warnings),
    ]
    if demand.delay_ms is not None:
        used = f"the mean rate uses {100 * sizing.assumptions.utilisation:g} % of it at most"
        in_time = f"{100 * demand.share:g} % of the frames within {demand.delay_ms:g} ms"
        conditions.insert(0, f"Link: {in_time}; {used}.")
    with mpl.rc_context({**STYLE, "axes.grid.axis": "x"}):
        figure, axes = plt.subplots(figsize=(7.2, 0.6 * len(fleet) + 1.2))
        for place, row in enumerate(fleet):
            is_late = demand.delay_ms is not None and row.link_mbps is None
            label, alpha = "" if place else "mean rate", 0.35 if is_late else 1.0
            axes.barh(place, row.mbps, 0.5, color=BLUE, alpha=alpha, label=label)
            if row.low_mbps is not None and row.high_mbps is not None:
                ends = (row.low_mbps, row.high_mbps)
                axes.plot(ends, (place, place), color=INK, label="" if place else "95 %")
            if is_late:
                text = f"no link keeps {demand.delay_ms:g} ms"
                axes.text(row.high_mbps or row.mbps, place, f"  {text}", va="center", color=INK)
        linked = [(k, row.link_mbps) for k, row in enumerate(fleet) if row.link_mbps is not None]
        if linked:
            axes.barh(
                [k for k, _ in linked],
                [link for _, link in linked],
                0.75,
                color=GREY,
                zorder=0.5,
                label="link",
            )
        axes.set_yticks(range(len(fleet)), [row.codec for row in fleet])
        axes.invert_yaxis()
        of_all = f" of all {demand.vehicles} vehicles" if many else ""
        axes.set_xlabel(f"uplink{of_all}, Mbit/s with transport")
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)
        axes.set_title(f"Uplink of {vehicles} with\n{_cameras(demand)}", loc="left", fontsize=9)
        axes.annotate(
            "\n".join(textwrap.fill(text, COLUMNS) for text in conditions),
            (0, 0),
            (0, -38),
            xycoords="axes fraction",
            textcoords="offset points",
            va="top",
            fontsize=8,
            color=INK,
        )
        buffer = io.BytesIO()
        figure.savefig(buffer, format=path.suffix[1:], bbox_inches="tight", dpi=200)
        plt.close(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, buffer.getvalue())
