"""A city's plan as a table for a terminal, and as a page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from rfcore.files import write_whole
from rfedge.report.tables import text_table
from rfedge.results import Provenance, Result, as_json, make_result, write_result

if TYPE_CHECKING:
    from lab.city.check import CheckRow
    from lab.city.plan import CityPlan

__all__ = ["city_headline", "print_city", "write_city"]

SHOWN_SERVERS = 50


def city_headline(plan: CityPlan) -> str:
    """Return what breaks first, where and when; or how much more the city carries."""
    first = plan.first_broken
    if first is not None and first.broken_at_s is not None:
        return f"First broken: {first.limit}, from {_clock(first.broken_at_s)} on"
    factors = [row.demand_factor for row in plan.limits if row.demand_factor is not None]
    return f"Nothing is broken; {min(factors, default=0.0):.2f} times the demand reaches a limit"


def _clock(at_s: float) -> str:
    """Return seconds as hours, minutes and seconds."""
    minutes, seconds = divmod(round(at_s), 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{seconds:02d}"


def print_city(console: Console, plan: CityPlan, checks: Sequence[CheckRow]) -> None:
    """Print the limits, the busiest minute, and the model against the sessions."""
    from lab.city.check import largest_differences

    busiest = max(plan.rows, key=lambda row: row.vehicles)
    console.print(f"[bold]{city_headline(plan)}[/]")
    console.print(
        f"{len(plan.city.cells)} cells, {len(plan.city.servers)} servers; most vehicles at "
        f"{_clock(busiest.at_s)}: {busiest.vehicles:.0f}, of which {busiest.refused:.0f} refused, "
        f"{busiest.rate_hz:.1f} Hz, {busiest.uplink_mbps:.0f} Mbit/s up, {busiest.cores:.1f} cores,"
        f" {busiest.handovers_per_s:.1f} handovers/s"
    )
    limits = [
        [row.limit, f"{row.share:.2f}", row.where, _clock(row.at_s), _broken(row.broken_at_s)]
        for row in plan.limits
    ]
    heads = ("limit", "asked", "where", "when", "broken from")
    text_table(heads, limits).print(console)
    if checks:
        cells = [
            [name, f"{median:.1f}", f"{largest:.1f}"]
            for name, median, largest in largest_differences(checks)
        ]
        title = "Flow model against sessions, difference in %"
        text_table(("figure", "median", "largest"), cells, title).print(console)


def _broken(at_s: float | None) -> str:
    return "-" if at_s is None else _clock(at_s)


def city_content(plan: CityPlan, checks: Sequence[CheckRow]) -> dict[str, Any]:
    """Return the content of a result: everything but the arrays."""
    vehicle = plan.city.vehicle
    return {
        "headline": city_headline(plan),
        "vehicle": vehicle,
        "costs": replace(plan.costs, frame_ratios=(), unexplained_s=()),
        "limits": plan.limits,
        "minutes": plan.rows,
        "servers": plan.servers,
        "cells": plan.cells,
        "checks": checks,
    }


def write_city(
    out: Path, made: Provenance, name: str, plan: CityPlan, checks: Sequence[CheckRow]
) -> Result:
    """Write ``city.json`` and ``report.html`` into ``out``; return the result."""
    result = make_result("city", made, city_content(plan, checks))
    write_result(out / "city.json", result)
    write_whole(out / "report.html", _city_page(name, plan, checks, result))
    return result


def _city_page(name: str, plan: CityPlan, checks: Sequence[CheckRow], result: Result) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from lab.city.check import largest_differences

    environment = Environment(
        loader=PackageLoader("lab.city", "."), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["clock"] = _clock
    pressed = sorted(plan.servers, key=lambda row: -row.load_share)[:SHOWN_SERVERS]
    shown = ("costs", "command", "revision", "dirty", "host", "inputs")
    demand = plan.city.vehicle.demand
    return environment.get_template("city.html.j2").render(
        name=name,
        headline=city_headline(plan),
        what=(
            f"{name}: {len(plan.city.cells)} cells, {len(plan.city.servers)} servers; each vehicle "
            f"{demand.cameras} x {demand.width_px}x{demand.height_px} at {demand.hz:g} Hz, "
            f"{demand.psnr_db:g} dB. Steps are taken as steady; docs/how-to/servers.md says how."
        ),
        limits=plan.limits,
        servers=pressed,
        left_out=len(plan.servers) - len(pressed),
        checks=checks,
        differences=largest_differences(checks),
        provenance=json.dumps({key: as_json(result[key]) for key in shown}, indent=2),
        **_city_charts(plan),
    )


def _city_charts(plan: CityPlan) -> dict[str, str]:
    rows = plan.rows
    hours = [row.at_s / 3600 for row in rows]

    def chart(unit: str, **lines: Sequence[float | None]) -> str:
        return _lines_chart(hours, unit, lines)

    return {
        "map_svg": _city_map(plan),
        "vehicles_svg": chart(
            "vehicles", there=[row.vehicles for row in rows], served=[row.served for row in rows]
        ),
        "cores_svg": chart("cores", cores=[row.cores for row in rows]),
        "bytes_svg": chart(
            "Mbit/s", up=[row.uplink_mbps for row in rows], down=[row.downlink_mbps for row in rows]
        ),
        "moves_svg": chart(
            "per second",
            handovers=[row.handovers_per_s for row in rows],
            begun=[row.begun_per_s for row in rows],
        ),
        "ages_svg": chart(
            "ms",
            p50=[row.age_p50_ms for row in rows],
            p95=[row.age_p95_ms for row in rows],
            p99=[row.age_p99_ms for row in rows],
        ),
    }


def _lines_chart(
    hours: Sequence[float], unit: str, lines: Mapping[str, Sequence[float | None]]
) -> str:
    """Return lines over the hours; a minute without a value is left out."""
    import matplotlib as mpl

    from rfedge.report.charts import LINES, STYLE, new_axes, svg

    with mpl.rc_context(STYLE):
        figure, axes = new_axes(2.4)
        marker = "o" if len(hours) < 3 else None
        for (name, values), colour in zip(lines.items(), LINES, strict=False):
            known = [(h, v) for h, v in zip(hours, values, strict=True) if v is not None]
            at, shown = zip(*known, strict=True) if known else ((), ())
            axes.plot(at, shown, color=colour, linewidth=2, label=name, marker=marker)
        axes.set(xlabel="hour", ylabel=unit)
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)
        return svg(figure)


def _city_map(plan: CityPlan) -> str:
    """Return the cells as circles, coloured by how hard they or their server are pressed."""
    import matplotlib as mpl
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import LinearSegmentedColormap

    from rfedge.report.charts import GRID, STYLE, new_axes, svg

    load = {row.name: row.load_share for row in plan.servers}
    pressed = [max(row.uplink_share, row.downlink_share, load[row.server]) for row in plan.cells]
    blues = LinearSegmentedColormap.from_list("pressed", ["#e8f0fe", "#2563eb"])
    colours = blues.with_extremes(over="#b91c1c")
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure, axes = new_axes(6.0)
        sizes_m = [2 * row.radius_m for row in plan.cells]
        circles = EllipseCollection(
            sizes_m,
            sizes_m,
            [0.0] * len(sizes_m),
            units="xy",
            offsets=[(row.east_m, row.north_m) for row in plan.cells],
            offset_transform=axes.transData,
            cmap=colours,
            edgecolor=GRID,
            linewidth=0.5,
        )
        circles.set_array(pressed)
        circles.set_clim(0, 1)
        axes.add_collection(circles)
        most_m = max(sizes_m)
        axes.update_datalim([(row.east_m - most_m, row.north_m - most_m) for row in plan.cells])
        axes.update_datalim([(row.east_m + most_m, row.north_m + most_m) for row in plan.cells])
        axes.autoscale_view()
        axes.set_aspect("equal")
        axes.set(xlabel="m east", ylabel="m north")
        figure.colorbar(circles, ax=axes, label="asked, of what there is", extend="max")
        return svg(figure)
