"""Print an estimate as a table on the terminal."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from rfedge.sizing.estimate import Sizing

__all__ = ["print_sizing"]


def print_sizing(console: Console, sizing: Sizing) -> None:
    """Print the estimates, what they assume, and where they leave what was measured."""
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
