"""``docs/sizing.md`` from the tables that ship with ``rfedge size``, and the cities of scale.md.

python -m lab.pages.sizing > docs/sizing.md
python -m lab.pages.sizing city    # the table that stands in docs/how-to/servers.md behind
``CITY_MARK``
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from io import StringIO

from rich.console import Console

from lab.city.city import Density, VehicleKind, grid_city
from lab.city.flow import costs_of
from lab.city.plan import plan_city
from lab.city.traffic import stated_traffic
from rfedge.report.tables import table
from rfedge.results import Result, read_result, rows_of
from rfedge.sizing.estimate import Demand, estimate
from rfedge.sizing.report import print_sizing
from rfedge.sizing.tables import (
    CODECS,
    MAX_BEYOND_DB,
    MAX_BEYOND_FACTOR,
    SHIPPED,
    SizingCell,
    read_tables,
)

__all__ = ["CITY_MARK", "city_table", "sizing_page"]

EXAMPLE = Demand(4, 640, 360, 10.0, 34.0, delay_ms=150.0)
COMMAND = "rfedge size --cameras 4 --size 640x360 --hz 10 --db 34 --delay-ms 150"

PAGE = """# Sizing an uplink

Generated from `rfedge/sizing/tables.json` by `make figures`; do not edit.

`rfedge size` says what the cameras of a vehicle need: Mbit/s of the uplink with a 95 % interval,
cores of the vehicle and of the server, vehicles a cell and a km2. Beside ours stand the rivals of
`rfedge eval compare` in the form that is fairest to them at a PSNR: x264 and x265 veryfast tuned
for PSNR, SVT-AV1 preset 8, all for low delay, with one key frame.

```
$ {command}
{example}```

Every figure of cell and transport is an option; `rfedge size --help` names its default and
source. `--json FILE` writes the same as an object. `examples/size_an_uplink.py` does it from
Python (`rfedge.sizing.estimate`).

* **Mbit/s** are of the steady state: whole messages of ours, packets of the rivals, and
  `--overhead-percent` of transport on both. The first four frames of a clip are left out (of clips
  under eight, of slow cameras, the first): after its key frame a rival predicts from what was coded
  better than it needs. The interval is that of the frames which the nearest cell's clip happens to
  have (percentile bootstrap); another street differs by more.
* **The link for a delay** (`--delay-ms`, `--share`) is the least rate at which so many frames are
  reconstructed in time: the cameras' frames of one instant wait for each other, and coding,
  decoding and `--propagation-ms` are taken off first. Sizes of frames are those measured near 34
  dB. No rate control is assumed; with `cav-agent --max-delay-ms` quality gives way instead.
* **Cores** are processor time on the machine below, one thread a camera: of ours rendering,
  choosing references, coding and the closed loop on the vehicle, rendering and decoding on the
  server.
* **A cell** holds as many vehicles as its planned uplink carries of that rate, of the link's
  where a delay is asked for.

## How far it reaches

Logarithms of bytes and times are interpolated over decibels, log(Hz) and log(pixels). Where a
size was measured at fewer rates than another, the rate's effect is taken from the one with the
widest range, and the answer says so. Up to {factor:g} times beyond the measured pixels and rates,
and {db:g} dB beyond the qualities, the answer says how far it extrapolates; farther it is
refused.

All cells are of one street, with vehicles the field has never seen, and of one field of 640x360
pictures: at 1920x1080 its renders are soft, and one that was trained at that size would save
more. At 30 Hz a third of a second was rendered, with 4 samples a pixel. Your own data answers for
itself:

```
rfedge size --drive DATASET --field FIELD --size 640x360 --hz 10 --db 34
```

codes up to `--frames` of it with every codec at that size and rate (extra `eval`; the drive's
rate must be a multiple of it), and goes on where it was stopped.

## What was measured

{measured_on}. Revision {revision}, {cpu}, one thread.
kbit/s of one camera without transport, with the interval; processor time in ms a frame near 34
dB, of both ends. n/a: the clip's curve does not reach that quality.

{table}
`make sizing` measures it again: it renders the drive at 1920x1080 and runs
`rfedge-lab size-tables`, which goes on where it was stopped. Pictures of other sizes are
reduced by averaging areas; every second, third and fifth frame stand for slower cameras.

## Against a load

`tests/integration/test_sizing_load.py` drives four cameras of the sample through server, agents
and link shaper and holds the Mbit/s told to within 10 % of the bytes counted at the link. The
tables come from the same drive: this checks the chain from cells to wire, not how another street
behaves.
"""


def sizing_page(result: Result) -> str:
    """Return the page of a result of ``rfedge-lab size-tables``, the file that ships."""
    return PAGE.format(
        command=COMMAND,
        example=_example(),
        factor=MAX_BEYOND_FACTOR,
        db=MAX_BEYOND_DB,
        measured_on=str(result["measured_on"]).capitalize(),
        revision=str(result["revision"])[:12],
        cpu=result["host"]["cpu"],
        table=_tables(result),
    )


PAGE_DB = (32.0, 34.0, 36.0)


def _tables(result: Result) -> str:
    cells = rows_of(SizingCell, result["cells"])
    lines = ["| size | Hz | frames | codec | " + " | ".join(f"{db:g} dB" for db in PAGE_DB)]
    lines[0] += " | sender | receiver |"
    lines.append("|---|---|---|---|" + "---|" * (len(PAGE_DB) + 2))
    lines += _page_rows(sorted(cells, key=lambda c: (c.pixels, c.hz, CODECS.index(c.codec))))
    return "\n".join(lines) + "\n"


def _page_rows(cells: Sequence[SizingCell]) -> Iterator[str]:
    for cell in cells:
        sizes = " | ".join(_kbit_s(cell, db) for db in PAGE_DB)
        yield (
            f"| {cell.width_px}x{cell.height_px} | {cell.hz:.3g} | {cell.frames} | {cell.codec} | "
            f"{sizes} | {cell.sender_ms:.1f} | {cell.receiver_ms:.1f} |"
        )


def _kbit_s(cell: SizingCell, db: float) -> str:
    """Return kbit/s with the interval, n/a where the cell does not reach the quality."""
    if db not in cell.psnr_db:
        return "n/a"
    at = list(cell.psnr_db).index(db)
    low, mean, high = (
        column[at] * 8e-3 * cell.hz
        for column in (cell.low_bytes, cell.bytes_per_frame, cell.high_bytes)
    )
    return f"{mean:.0f} ({low:.0f}..{high:.0f})"


CITY_MARK = "<!-- made by: python -m lab.pages.sizing city -->"
CITY_SERVERS = (10, 100, 1000)
CITY_CORES = (2, 4)
CITY_KIND = VehicleKind(Demand(1, 640, 360, 10.0, 34.0))
CITY_COLUMNS = (
    "servers",
    "cores each",
    "vehicles",
    "served",
    "refused",
    "cores in use",
    "Mbit/s up",
    "Mbit/s down",
    "handovers/s",
    "age p50 / p99, ms",
)


def city_table() -> str:
    """Return what the flow model says of cities of 10 vehicles a server, as Markdown."""
    rows = [_city_row(servers, cores) for servers in CITY_SERVERS for cores in CITY_CORES]
    return table(CITY_COLUMNS, rows)


def _city_row(servers: int, cores: int) -> list[str]:
    density = Density((8.0, 8.0 + 1 / 3600), (10.0, 10.0))
    city = grid_city(CITY_KIND, density, servers, cores, busy_weight=2.0)
    costs = costs_of(city, read_tables(SHIPPED))
    (row,) = plan_city(city, costs, stated_traffic(city)).rows
    return [
        str(servers),
        str(cores),
        f"{row.vehicles:.0f}",
        f"{row.served:.0f}",
        f"{row.refused:.0f}",
        f"{row.cores:.0f}",
        f"{row.uplink_mbps:.0f}",
        f"{row.downlink_mbps:.0f}",
        f"{row.handovers_per_s:.1f}",
        f"{row.age_p50_ms or 0.0:.0f} / {row.age_p99_ms or 0.0:.0f}",
    ]


def _example() -> str:
    text = StringIO()
    print_sizing(Console(file=text, width=100), estimate(EXAMPLE, read_tables(SHIPPED)))
    return text.getvalue()


if __name__ == "__main__":
    sys.stdout.write(
        city_table() + "\n" if sys.argv[1:] == ["city"] else sizing_page(read_result(SHIPPED))
    )
