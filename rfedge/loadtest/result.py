"""The result of a load test as files: JSON, a page, a figure; and rows of a committed result.

The load report's charts, as inline SVG.

The load test's section of the generated figures.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from rfcore.files import write_whole
from rfedge.loadtest.run import Run
from rfedge.loadtest.uplink import MOST, RATES_MBPS, Traffic, vehicles_carried
from rfedge.report.charts import GRID, INK, MUTED, PAYLOAD, RENDER, STYLE, new_axes, svg
from rfedge.report.markdown_parts import Row, cell, heading, table
from rfedge.results import host, revision

__all__ = ["LoadResult", "latency_chart", "load_section", "record", "uplink_chart", "write_result"]


def latency_chart(latency_ms: Mapping[str, Sequence[float]], deadline_ms: float) -> str:
    """Return the share of acknowledged frames over their latency, a curve for each run."""
    with mpl.rc_context(STYLE):
        figure, axes = new_axes()
        colours = mpl.colormaps["viridis"](np.linspace(0.1, 0.85, max(1, len(latency_ms))))
        for (name, values), colour in zip(latency_ms.items(), colours, strict=True):
            ordered = np.sort(np.array(values))
            share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
            axes.plot(ordered, share, color=colour, linewidth=2, label=name)
        axes.axvline(deadline_ms, color=RENDER, linewidth=1.5, linestyle="--")
        axes.annotate(
            "deadline",
            (deadline_ms, 4),
            xytext=(5, 0),
            textcoords="offset points",
            color=RENDER,
        )
        axes.set(xlabel="ms from due to acknowledged", ylabel="% of frames", xscale="log")
        for set_formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            set_formatter(mpl.ticker.FormatStrFormatter("%g"))
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)
        return svg(figure)


def uplink_chart(
    carried: Sequence[tuple[float, int]], server_vehicles: int | None, most: int
) -> str:
    """Return vehicles over the uplink they share (Mbit/s), and what the server carried."""
    with mpl.rc_context(STYLE):
        figure, axes = new_axes()
        rates, vehicles = zip(*carried, strict=True)
        axes.plot(rates, vehicles, color=PAYLOAD, linewidth=2, marker="o", markersize=4)
        for rate, count in carried:
            label = f"{count}+" if count >= most else str(count)
            axes.annotate(
                label,
                (rate, count),
                xytext=(0, 7),
                textcoords="offset points",
                ha="center",
                color=INK,
            )
        if server_vehicles:
            axes.axhline(server_vehicles, color=RENDER, linewidth=1.5, linestyle="--")
            axes.annotate(
                f"held by the server in this test: {server_vehicles}",
                (rates[-1], server_vehicles),
                xytext=(0, -12),
                textcoords="offset points",
                ha="right",
                color=RENDER,
            )
        axes.set(xlabel="throughput of the shared uplink, Mbit/s", ylabel="vehicles", xscale="log")
        axes.set_xticks(rates, [f"{rate:g}" for rate in rates])
        axes.minorticks_off()
        axes.yaxis.get_major_locator().set_params(integer=True)
        axes.tick_params(colors=MUTED)
        axes.spines["bottom"].set_color(GRID)
        axes.margins(y=0.15)
        return svg(figure)


KEY = (
    "mode",
    "kind",
    "vehicles",
    "cameras",
    "hz",
    "width",
    "height",
    "link",
    "vehicle_ms",
    "admission",
)
"""What tells one row of a committed result from another."""


@dataclass(frozen=True)
class LoadResult:
    """Runs of one load with different numbers of vehicles, in the order of their numbers."""

    runs: Sequence[Run]

    @property
    def most_held(self) -> int:
        """The largest number that held, 0 if none did."""
        return max((run.load.vehicles for run in self.runs if run.verdict.held), default=0)

    def headline(self) -> str:
        """Return the result in a line."""
        load, row = self.runs[0].load, self.runs[0].row
        what = f"{load.mode}, {row['width']}x{row['height']}, {load.hz:g} Hz"
        if len(self.runs) > 1:
            return f"{_vehicles(self.most_held)} held ({what})"
        held = "held" if self.most_held else "not held"
        return f"{_vehicles(load.vehicles)} {held} ({what})"

    def as_json(self) -> dict[str, Any]:
        """Return the content of ``result.json``."""
        return {
            "case": "loadtest",
            "command": " ".join(["rfedge", *sys.argv[1:]]),
            "revision": revision(),
            "host": host(),
            "rows": [_finite(run.row) for run in self.runs],
        }


def write_result(result: LoadResult, out: Path) -> None:
    """Write ``result.json``, ``report.html`` and ``vehicles_vs_uplink.svg`` into ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    content = result.as_json()
    write_whole(out / "result.json", json.dumps(content, indent=1) + "\n")
    figure = _uplink(result)
    write_whole(out / "vehicles_vs_uplink.svg", figure + "\n")
    write_whole(out / "report.html", _page(result, content, figure))


def record(path: Path, content: Mapping[str, Any]) -> None:
    """Put the rows of ``content`` into the result at ``path``, in place of those of the same load.

    Each row keeps the command and revision it was made by.
    """
    old = json.loads(path.read_text())["rows"] if path.exists() else []
    made = {key: content[key] for key in ("command", "revision")}
    new = [{**row, **made} for row in content["rows"]]
    told = {_key(row) for row in new}
    rows = sorted([row for row in old if _key(row) not in told] + new, key=_order)
    whole = {**content, "command": "rfedge loadtest", "rows": rows}
    write_whole(path, json.dumps(whole, indent=1) + "\n")


def _key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in KEY)


def _order(row: Mapping[str, Any]) -> tuple[str, ...]:
    order = ("transport", "receiver", "full")
    return (str(order.index(row["mode"])), row["kind"], f"{row['hz']:9.3f}{row['vehicles']:6d}")


def _finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """JSON knows no infinity: what nothing was measured of is null."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
    }


def _vehicles(count: int) -> str:
    return "1 vehicle" if count == 1 else f"{count} vehicles"


def _uplink(result: LoadResult) -> str:
    run = result.runs[-1]
    sizes = [size for size in run.payload_bytes for _ in range(run.load.cameras)]
    budget_s = run.load.bounds.deadline_ms / 2e3
    traffic = Traffic(sizes, run.load.hz * run.load.cameras, budget_s)
    carried = [(rate, vehicles_carried(traffic, 1e6 * rate)) for rate in RATES_MBPS]
    return uplink_chart(carried, result.most_held or None, MOST)


def _page(result: LoadResult, content: Mapping[str, Any], figure: str) -> str:
    environment = Environment(
        loader=PackageLoader("rfedge.loadtest", "."), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["ms"] = lambda value: "-" if value is None else f"{value:.1f}"
    last = result.runs[-1]
    latency_ms = {_vehicles(run.load.vehicles): run.latency_ms for run in result.runs}
    return environment.get_template("loadtest.html.j2").render(
        headline=result.headline(),
        what=_what(last),
        rows=content["rows"],
        deadline_ms=last.load.bounds.deadline_ms,
        latency_svg=latency_chart(latency_ms, last.load.bounds.deadline_ms),
        uplink_svg=figure,
        payload_bytes=last.row["payload_bytes"],
        hz=last.load.hz,
        budget_ms=last.load.bounds.deadline_ms / 2,
        provenance=json.dumps(
            {key: content[key] for key in ("command", "revision", "host")}, indent=2
        ),
    )


def _what(run: Run) -> str:
    load = run.load
    does = {
        "transport": "The server parses, checks, queues, acknowledges and counts; it neither "
        "renders nor decodes.",
        "receiver": "The server decodes against renders that it kept: each pose is rendered once.",
        "full": "The server renders and decodes every frame, as always.",
    }[load.mode]
    link = f"a link of its own ({load.link.stem})" if load.link else "loopback"
    vehicles = (
        "Canned vehicles replay packets that were coded before, so the vehicles' own time is not "
        f"in the latency beyond {load.vehicle_ms:g} ms"
        if load.kind == "canned"
        else "Live vehicles render and encode on this machine"
    )
    return (
        f"{does} {vehicles}. Cameras a vehicle: {load.cameras}; each vehicle over {link}; "
        f"{load.duration_s:g} s counted after {load.warm_up_s:g} s of warm-up."
    )


COLUMNS = (
    "mode",
    "vehicles",
    "cameras",
    "hz",
    "link",
    "held",
    "p50_ms",
    "p99_ms",
    "on_time_percent",
    "on_time_at_least_percent",
    "fairness",
    "server_cores",
    "server_loop_cores",
    "vehicles_cores",
    "others_cores",
    "limited_by",
)


def load_section(path: Path, result: Row) -> str:
    """Return a table of the runs, with what was not kept and the commands below it."""
    rows = [[_shown(row, column) for column in COLUMNS] for row in result["rows"]]
    notes = [_note(row) for row in result["rows"]]
    return "\n\n".join([heading(path, result), table(COLUMNS, rows), "\n".join(notes), ""])


def _shown(row: Row, column: str) -> str:
    if column == "link":
        return row["link"] or "loopback"
    if column == "held":
        return "yes" if row["held"] else "no"
    return cell(row[column])


def _note(row: Row) -> str:
    broken = f" Not kept: {'; '.join(row['broken'])}." if row["broken"] else ""
    size = f"{row['width']}x{row['height']}, {row['payload_bytes']:.0f} bytes of payload a frame"
    return f"* `{row['command']}` at `{row['revision']}` ({row['kind']} vehicles, {size}).{broken}"
