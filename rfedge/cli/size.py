"""``rfedge size``: how large an uplink, and how many cores, a vehicle's cameras need; or a city."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, arg

from rfedge.arguments import DATASET, FIELD, FOLDER, SIZE, field_path, parse_size
from rfedge.sizing.estimate import Assumptions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rfedge.sizing.city import City
    from rfedge.sizing.estimate import Demand
    from rfedge.sizing.tables import SizingTables
    from rfedge.sizing.traffic import TrafficBlock

__all__ = ["Size"]


@dataclass(frozen=True)
class Size:
    """Say what cameras need of an uplink and of both ends: ours, x264, x265 and SVT-AV1.

    From tables measured on the sample street (docs/sizing.md), or on a drive and field of your own.
    With --city: cells, servers and vehicles over the hours, and what breaks first (docs/scale.md).
    """

    cameras: int = 1
    """Cameras of a vehicle, which take their pictures at the same instant."""
    size: Annotated[str, SIZE] = "1920x1080"
    """Pixels of a picture."""
    hz: float = 10.0
    """Pictures a second of each camera."""
    db: float = 34.0
    """Luma PSNR of the reconstruction."""
    delay_ms: float | None = None
    """Also the link that brings frames to their reconstruction within so many milliseconds."""
    share: float = 0.99
    """Share of the frames that have to be in time."""
    drive: Annotated[Path | None, DATASET] = None
    """Measure on this drive instead of the tables (extra eval); with --field."""
    field: Annotated[Path | None, FIELD] = None
    """The field of that drive."""
    frames: int = 24
    """At most so many frames of it."""
    cells: Annotated[Path, FOLDER] = Path("out/size")
    """Folder of its finished pieces: a stopped run goes on."""
    city: Annotated[Path | None, arg(metavar="CITY.toml")] = None
    """Plan this city instead (see samples/sizing/city.toml), of which it says everything."""
    fcd: Annotated[Path | None, arg(metavar="FILE.xml[.gz]")] = None
    """Its vehicles: FCD output of SUMO, in place of the stated demand."""
    sumo: Annotated[Path | None, arg(metavar="FILE.sumocfg")] = None
    """Its vehicles: this simulation, run here; needs rfedge[sumo]."""
    step_s: float = 1.0
    """Seconds between the steps of its stated demand."""
    samples: int = 9
    """Servers that also run with the product's session machines, to check the flow model."""
    sample_s: float = 30.0
    """For how many seconds of the virtual clock they are counted, after 20 s."""
    out: Annotated[Path, FOLDER] = Path("out/city")
    """Folder for the city's report.html and city.json."""
    assumptions: Annotated[Assumptions, OmitArgPrefixes] = Assumptions()
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""

    def run(self) -> None:
        """Estimate and print, or write JSON."""
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfedge.results import make_result, provenance, write_result
        from rfedge.sizing.estimate import Demand, estimate
        from rfedge.sizing.report import print_sizing

        if self.city is not None:
            self._plan_city(self.city)
            return
        for name, path in (("fcd", self.fcd), ("sumo", self.sumo)):
            if path is not None:
                raise InvalidInput(name, f"{path}: vehicles need their cells; give --city too")
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
        from rfedge.sizing.run import own_tables

        return own_tables(self.drive, field_path(self.field), demand, self.frames, self.cells)

    def _plan_city(self, city_path: Path) -> None:
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfedge.results import provenance, write_result
        from rfedge.sizing.city import read_city
        from rfedge.sizing.city_check import CheckPlan, check_plan
        from rfedge.sizing.city_plan import plan_city
        from rfedge.sizing.flow import costs_of
        from rfedge.sizing.report import print_city, write_city
        from rfedge.sizing.tables import shipped_tables

        if self.drive is not None or self.field is not None:
            raise InvalidInput("city", "is planned from the shipped tables; leave --drive out")
        check = CheckPlan(self.samples, counted_s=self.sample_s)
        city = read_city(city_path)
        costs = costs_of(city, shipped_tables())
        plan = plan_city(city, costs, self._traffic(city))
        checks = check_plan(plan, check)
        inputs = (city_path, self.fcd, self.sumo)
        made = provenance([path for path in inputs if path is not None])
        result = write_city(self.out, made, city_path.stem, plan, checks)
        if self.json is not None:
            write_result(self.json, result)
            return
        print_city(Console(), plan, checks)
        for name in ("report.html", "city.json"):
            Console().print(f"  {self.out / name}")

    def _traffic(self, city: City) -> Iterator[TrafficBlock]:
        from rfcore.errors import InvalidInput
        from rfcore.extras import require
        from rfedge.sizing.traffic import stated_traffic, sumo_traffic, trace_traffic

        if self.fcd is not None and self.sumo is not None:
            raise InvalidInput("sumo", "--fcd is a simulation that was run; give one of them")
        if self.fcd is not None:
            return trace_traffic(city, self.fcd)
        if self.sumo is not None:
            require("sumo", "libsumo")
            return sumo_traffic(city, self.sumo)
        return stated_traffic(city, self.step_s)
