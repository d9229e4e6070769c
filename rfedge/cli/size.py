"""``rfedge size``: how large an uplink, and how many cores, a vehicle's cameras need."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, arg

from rfedge.arguments import DATASET, FIELD, FOLDER, SIZE, field_path, parse_size
from rfedge.sizing.estimate import Assumptions

if TYPE_CHECKING:
    from rich.console import Console

    from rfedge.sizing.estimate import Demand, Sizing
    from rfedge.sizing.tables import SizingTables


@dataclass(frozen=True)
class Size:
    """Estimate the uplink and the cores that cameras need with us, x264, x265 and SVT-AV1.

    The estimate comes from tables measured on the sample street (lab/results/sizing.md), or from
    your own drive and field.
    """

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
    cells: Annotated[Path, FOLDER] = Path("out/size")
    """Folder of finished measurements, from which a stopped run goes on."""
    assumptions: Annotated[Assumptions, OmitArgPrefixes] = Assumptions()
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""

    def run(self) -> None:
        """Estimate and print, or write JSON."""
        from rich.console import Console

        from rfedge.results import make_result, provenance, write_result
        from rfedge.sizing.estimate import Demand, estimate

        width_px, height_px = parse_size(self.size)
        demand = Demand(
            self.cameras, width_px, height_px, self.hz, self.db, self.delay_ms, self.share
        )
        sizing = estimate(demand, self._tables(demand), self.assumptions)
        if self.json is None:
            print_sizing(Console(), sizing)
        else:
            write_result(self.json, make_result("size", provenance(), {"sizing": sizing}))

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
    console.print(
        f"{demand.cameras} x {demand.width_px}x{demand.height_px} px at {demand.hz:g} Hz, "
        f"{demand.psnr_db:g} dB luma PSNR"
    )
    table = Table(box=box.SIMPLE, pad_edge=False)
    names = ["codec", "Mbit/s", "95 %", "cores", "at server", "a cell", "a km2"]
    if demand.delay_ms is not None:
        names.insert(3, "link")
    for number, name in enumerate(names):
        table.add_column(name, justify="right" if number else "left", no_wrap=True)
    for row in sizing.estimates:
        cells = [
            row.codec,
            f"{row.mbps:.2f}",
            f"{row.low_mbps:.3g}..{row.high_mbps:.3g}",
            f"{row.vehicle_cores:.2f}",
            f"{row.server_cores:.2f}",
            f"{row.vehicles_per_cell}",
            f"{row.vehicles_per_km2:.0f}",
        ]
        if demand.delay_ms is not None:
            cells.insert(3, "-" if row.link_mbps is None else f"{row.link_mbps:.2f}")
        table.add_row(*cells)
    console.print(table)
    console.print(
        "Mbit/s of one vehicle with transport; cores on the vehicle and at the server; vehicles "
        "that a cell and a km2 carry."
    )
    if demand.delay_ms is not None:
        console.print(
            f"link: Mbit/s with which {100 * demand.share:g} % of the frames are reconstructed "
            f"within {demand.delay_ms:g} ms."
        )
    console.print(f"Measured on {sizing.measured_on}; steady state, without first frames.")
    console.print(
        f"Cell: {assumed.bandwidth_mhz:g} MHz x {assumed.uplink_share:g} up x "
        f"{assumed.bits_per_hz:g} bit/s/Hz x {assumed.utilisation:g} = {assumed.cell_mbps:.1f} "
        f"Mbit/s; {assumed.cells_per_km2:.0f} cells a km2; {assumed.overhead_percent:g} % transport"
    )
    for note in sizing.beyond:
        console.print(f"[yellow]Note[/]: {note}")
