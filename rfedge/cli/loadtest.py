"""``rfedge loadtest``: how many vehicles a server carries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff

__all__ = ["LoadTest"]


@dataclass(frozen=True)
class LoadTest:
    """Put a number of vehicles, each on its own link, on a server, and say whether it holds."""

    vehicles: int = 4
    """How many; with --find-limit, how many to begin with."""
    mode: Literal["transport", "receiver", "full"] = "full"
    """What the server does: nothing with the pictures, decode against kept renders, everything."""
    hz: float = 10.0
    """Pictures per second of each camera."""
    cameras: int = 1
    """Cameras of each vehicle."""
    size: int = 4096
    """Bytes of payload of a frame in transport mode; otherwise the drive's own."""
    link: Path | None = None
    """Link profile (TOML, see samples/links), a link for each vehicle; default: loopback."""
    duration: float = 20.0
    """Seconds that are counted."""
    warm_up: float = 5.0
    """Seconds before them that are not."""
    deadline_ms: float = 100.0
    """From the moment a picture is due to its Ack."""
    vehicle_ms: float = 0.0
    """How long a prerecorded vehicle waits before sending, in place of a real one's encoding."""
    live: Annotated[bool, FlagCreatePairsOff] = False
    """Vehicles that render and encode (cav-agent processes), instead of prerecorded packets."""
    admission: Annotated[bool, FlagCreatePairsOff] = False
    """Let the server refuse vehicles or lower their rate; the verdict is about those let in."""
    find_limit: Annotated[bool, FlagCreatePairsOff] = False
    """Look for the largest number that holds."""
    field: Path = Path("samples/fields/street.rff")
    """Field archive, the only one in its folder."""
    drive: Path = Path("samples/street/transforms_drive_vehicles.json")
    """Drive whose pictures the vehicles send."""
    workers: int = 2
    """Frames the server reconstructs at once, and threads of a render."""
    out: Path = Path("out/loadtest")
    """Folder for report.html, result.json and vehicles_vs_uplink.svg."""
    cache: Path = Path("out/cache/loadtest")
    """Folder that keeps coded drives between runs."""
    record: Path | None = None
    """Also put the rows into this result file, in place of those of the same load."""

    def run(self) -> None:
        """Run, write the report, print the rows; fail if the asked number is not held."""
        from rfcore.errors import RfedgeError
        from rfedge.loadtest.command import Command
        from rfedge.loadtest.plan import Bounds, Load, Mode, Vehicles
        from rfedge.loadtest.run import TestBed

        load = Load(
            mode=Mode(self.mode),
            vehicles=self.vehicles,
            hz=self.hz,
            duration_s=self.duration,
            warm_up_s=self.warm_up,
            cameras=self.cameras,
            size_bytes=self.size,
            link=self.link,
            kind=Vehicles.LIVE if self.live else Vehicles.PRERECORDED,
            vehicle_ms=self.vehicle_ms,
            admission=self.admission,
            bounds=Bounds(deadline_ms=self.deadline_ms),
        )
        bed = TestBed(self.field, self.drive, self.workers, self.cache, self.out / "work")
        result = Command(load, bed, self.out, self.record).run(find_limit=self.find_limit)
        if not self.find_limit and not result.most_held:
            raise RfedgeError("not held: " + "; ".join(result.runs[0].verdict.broken))
