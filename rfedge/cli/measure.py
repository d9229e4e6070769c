"""Verbs that measure: ``rfedge loadtest`` and ``rfedge eval``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, subcommand

from rfedge.arguments import DATASET, FIELD, FOLDER, RENDERER, field_path
from rfedge.evaluate.compare import EvalCompare
from rfedge.evaluate.ladder import EvalLadder
from rfedge.evaluate.lossy_link import EvalLossyLink
from rfedge.evaluate.never_worse import EvalNeverWorse
from rfedge.samples import sample_path


@dataclass(frozen=True)
class LoadTest:
    """Put vehicles, each on its own link, on a server, and say whether it holds the load."""

    vehicles: int = 4
    """Number of vehicles; with --find-limit the number to begin with."""
    mode: Literal["transport", "receiver", "full"] = "full"
    """Work of the server: transport does not decode, receiver decodes against cached renders, full
    renders and decodes."""
    hz: float = 10.0
    """Pictures per second of each camera."""
    cameras: int = 1
    """Cameras of each vehicle."""
    payload_bytes: int = 4096
    """Payload of a frame in transport mode; other modes send the drive's frames."""
    link: Annotated[Path | None, arg(metavar="FILE.toml")] = None
    """Link profile (TOML, see samples/links); each vehicle has its own link. Default: loopback."""
    duration: float = 20.0
    """Measured time, s."""
    warm_up: float = 10.0
    """Time before the measurement, s: caches fill."""
    deadline_ms: float = 100.0
    """Time that a picture may take from the moment it is due to its Ack, ms."""
    vehicle_ms: float = 0.0
    """Time that a prerecorded vehicle waits before sending, in place of encoding, ms."""
    live: bool = False
    """Start vehicles that render and encode (cav-agent) instead of replaying packets."""
    admission: bool = False
    """Let the server refuse vehicles or lower their rate; those that are refused do not count."""
    find_limit: bool = False
    """Look for the largest number of vehicles that the server holds."""
    field: Annotated[Path, FIELD] = sample_path("fields/street.rff")
    """The field, an archive that is alone in its folder."""
    drive: Annotated[Path, DATASET] = sample_path("street/transforms_drive_vehicles.json")
    """Drive whose pictures the vehicles send."""
    runs: int = 1
    """Number of runs of the load; it is held if every run is."""
    workers: int = 2
    """Number of frames that the server reconstructs at once."""
    threads: int = 1
    """Threads of each renderer, at the server with --mode full and in vehicles with --live."""
    renderer: Annotated[str, RENDERER] = "cpu"
    """Renderer of the server with --mode full and of vehicles with --live."""
    out: Annotated[Path, FOLDER] = Path("out/loadtest")
    """Folder for report.html and result.json."""
    cache: Annotated[Path, FOLDER] = Path("out/cache/loadtest")
    """Folder that keeps coded drives between runs."""

    def run(self) -> None:
        """Run, write the report, print the rows; fail if the asked number is not held."""
        from rich.console import Console

        from rfcore.errors import InvalidInput, RfedgeError
        from rfcore.wire.settings import RenderSettings
        from rfedge.loadtest.plan import Bounds, Load, Mode, Vehicles
        from rfedge.loadtest.run import TestBed, print_runs, run_loads, write_load_result

        if not 1 <= self.runs <= 100 or (self.find_limit and self.runs > 1):
            raise InvalidInput("runs", f"{self.runs} is outside 1..100, or beside --find-limit")
        load = Load(
            mode=Mode(self.mode),
            vehicles=self.vehicles,
            hz=self.hz,
            duration_s=self.duration,
            warm_up_s=self.warm_up,
            cameras=self.cameras,
            payload_bytes=self.payload_bytes,
            link=self.link,
            kind=Vehicles.LIVE if self.live else Vehicles.PRERECORDED,
            vehicle_ms=self.vehicle_ms,
            admission=self.admission,
            render=RenderSettings(threads=self.threads, renderer=self.renderer),
            bounds=Bounds(deadline_ms=self.deadline_ms),
        )
        bed = TestBed(
            field_path(self.field), self.drive, self.workers, self.cache, self.out / "work"
        )
        console = Console()
        result = run_loads(load, bed, console, find_limit=self.find_limit, repeated=self.runs)
        write_load_result(result, self.out)
        print_runs(console, result)
        console.print(f"  {self.out / 'report.html'}\n  {self.out / 'result.json'}")
        broken = [problem for run in result.runs for problem in run.verdict.broken]
        if not self.find_limit and broken:
            raise RfedgeError("not held: " + "; ".join(broken))


@dataclass(frozen=True)
class Eval:
    """Evaluate on drives of your own; results are JSON with command, revision, host and inputs."""

    verb: Annotated[
        Annotated[EvalCompare, subcommand("compare")]
        | Annotated[EvalNeverWorse, subcommand("never-worse")]
        | Annotated[EvalLadder, subcommand("ladder")]
        | Annotated[EvalLossyLink, subcommand("lossy-link")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
