"""Servers, cells and vehicles of a city over the hours: what they need, and what breaks first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import FOLDER

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.city.city import City
    from lab.city.traffic import TrafficBlock

__all__ = ["PlanCity"]


@dataclass(frozen=True)
class PlanCity:
    """Plan a city's cells, servers and vehicles over the hours, and say what breaks first."""

    city: Annotated[Path, Positional, arg(metavar="CITY.toml")]
    """The city to plan, of which it says everything (see samples/sizing/city.toml)."""
    fcd: Annotated[Path | None, arg(metavar="FILE.xml[.gz]")] = None
    """Its vehicles: FCD output of SUMO, in place of the stated demand."""
    step_s: float = 1.0
    """Seconds between the steps of its stated demand."""
    samples: int = 9
    """Servers that also run with the product's session machines, to check the flow model."""
    sample_s: float = 30.0
    """Seconds of the virtual clock for which they are counted, after 20 s."""
    out: Annotated[Path, FOLDER] = Path("out/city")
    """Folder for the city's report.html and city.json."""
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""

    def run(self) -> None:
        """Plan the city; print it, or write JSON."""
        from rich.console import Console

        from lab.city.check import CheckPlan, check_plan
        from lab.city.city import read_city
        from lab.city.flow import costs_of
        from lab.city.plan import plan_city
        from lab.city.report import print_city, write_city
        from rfedge.results import provenance, write_result
        from rfedge.sizing.tables import shipped_tables

        check = CheckPlan(self.samples, counted_s=self.sample_s)
        city = read_city(self.city)
        costs = costs_of(city, shipped_tables())
        plan = plan_city(city, costs, self._traffic(city))
        checks = check_plan(plan, check)
        made = provenance([self.city, *([self.fcd] if self.fcd else [])])
        result = write_city(self.out, made, self.city.stem, plan, checks)
        if self.json is not None:
            write_result(self.json, result)
            return
        print_city(Console(), plan, checks)
        for name in ("report.html", "city.json"):
            Console().print(f"  {self.out / name}")

    def _traffic(self, city: City) -> Iterator[TrafficBlock]:
        from lab.city.traffic import stated_traffic, trace_traffic

        if self.fcd is not None:
            return trace_traffic(city, self.fcd)
        return stated_traffic(city, self.step_s)
