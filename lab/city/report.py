"""The content of a city's result, and the tables that show it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from lab.city.plan import CityPlan, LimitRow, MinuteRow, ServerRow
from rfedge.report.tables import Table, columns
from rfedge.results import Result, rows_of

SHOWN_SERVERS = 20


def city_content(plan: CityPlan) -> dict[str, Any]:
    """Return the content of a result: everything but the arrays."""
    return {
        "headline": _headline(plan),
        "vehicle": plan.city.vehicle,
        "costs": replace(plan.costs, frame_ratios=(), unexplained_s=()),
        "limits": plan.limits,
        "minutes": plan.rows,
        "servers": plan.servers,
        "cells": plan.cells,
    }


def _headline(plan: CityPlan) -> str:
    """Return what breaks first, where and when; or how much more the city carries."""
    first = plan.first_broken
    if first is not None and first.broken_at_s is not None:
        return f"First broken: {first.limit}, from {first.broken_at_s / 3600:.2f} h on"
    factors = [row.demand_factor for row in plan.limits if row.demand_factor is not None]
    return f"Nothing is broken; {min(factors, default=0.0):.2f} times the demand reaches a limit"


def city_parts(result: Result) -> Iterator[Table]:
    """Yield the limits, the busiest minute, and the servers that are pressed most."""
    yield Table("Limits", columns(LimitRow), rows_of(LimitRow, result["limits"]))
    minutes = rows_of(MinuteRow, result["minutes"])
    busiest = max(minutes, key=lambda row: row.vehicles)
    yield Table("The minute of most vehicles", columns(MinuteRow), [busiest])
    servers = sorted(rows_of(ServerRow, result["servers"]), key=lambda row: -row.load_share)
    shown = servers[:SHOWN_SERVERS]
    yield Table(f"The busiest {len(shown)} of {len(servers)} servers", columns(ServerRow), shown)
