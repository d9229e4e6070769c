"""Servers, cells and vehicles of a city over the hours: what they need, and what breaks first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rfedge.results import check_result_path, make_result, provenance, write_result

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.city.city import City
    from lab.city.traffic import TrafficBlock

__all__ = ["PlanCity"]


@dataclass(frozen=True)
class PlanCity:
    """Plan a city's cells, servers and vehicles over the hours, and say what breaks first."""

    city: Annotated[Path, Positional, arg(metavar="CITY.toml")]
    """File that describes the city (see samples/sizing/city.toml)."""
    fcd: Annotated[Path | None, arg(metavar="FILE.xml[.gz]")] = None
    """The city's vehicles as FCD output of SUMO, instead of the stated demand."""
    step_s: float = 1.0
    """Time step of the stated demand, s."""
    out: Path = Path("out/eval/city.json")
    """The result file to write."""

    def __post_init__(self) -> None:
        check_result_path(self.out)

    def run(self) -> None:
        """Plan the city, write the result and print it."""
        from rich.console import Console

        from lab.city.city import read_city
        from lab.city.flow import costs_of
        from lab.city.plan import plan_city
        from lab.city.report import city_content, city_parts
        from rfedge.report.tables import print_tables
        from rfedge.sizing.tables import shipped_tables

        made = provenance([self.city, *([self.fcd] if self.fcd else [])])
        city = read_city(self.city)
        plan = plan_city(city, costs_of(city, shipped_tables()), self._traffic(city))
        result = make_result("city", made, city_content(plan))
        write_result(self.out, result)
        console = Console()
        console.print(result["headline"], markup=False, highlight=False)
        print_tables(city_parts(result), console)

    def _traffic(self, city: City) -> Iterator[TrafficBlock]:
        from lab.city.traffic import stated_traffic, trace_traffic

        if self.fcd is not None:
            return trace_traffic(city, self.fcd)
        return stated_traffic(city, self.step_s)
