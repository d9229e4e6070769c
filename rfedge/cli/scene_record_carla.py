"""``rfedge scene record-carla``: the rig of 18 cameras in a running CARLA server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["SceneRecordCarla"]


@dataclass(frozen=True)
class SceneRecordCarla:
    """Drive 18 cameras along a street of a running CARLA server, both ways, into a dataset."""

    out: Path
    """The folder to make: pictures and transforms.json."""
    host: str = "127.0.0.1"
    """Where the server runs."""
    port: int = 2000
    """Its RPC port."""
    town: str | None = None
    """Load this map first, such as Town10HD; default: the one that is running."""
    spawn: int = 0
    """Start at this spawn point of the map."""
    stations: int = 20
    """Places along the lane where all cameras take a picture, each way."""
    spacing_m: float = 4.0
    """Metres between them."""
    both_ways: bool = True
    """Drive back on the lane of the other direction."""
    keep_parked: bool = False
    """Keep the map's own parked vehicles in the pictures."""
    cameras: str = "all"
    """`all`, or names from the rig, separated by commas; a drive is `mid_front`."""
    size: str = "1920x1080"
    """Size of the pictures, WIDTHxHEIGHT px."""
    fov_deg: float = 90.0
    """Horizontal field of view, degrees."""
    timeout_s: float = 30.0
    """Give up when the server does not answer for so long, seconds."""

    def run(self) -> None:
        """Connect, record, and write the dataset."""
        from rfcore.errors import BackendUnavailable, RfedgeError
        from rfcore.files import whole_folder
        from rfedge.carla_recorder import Recorder, RecordSettings
        from rfedge.carla_recorder.rig import mounts_named
        from rfedge.sizes import parse_size

        settings = RecordSettings(
            spawn=self.spawn,
            stations=self.stations,
            spacing_m=self.spacing_m,
            both_ways=self.both_ways,
            keep_parked=self.keep_parked,
            mounts=mounts_named(self.cameras),
            size_px=parse_size(self.size),
            fov_deg=self.fov_deg,
            timeout_s=self.timeout_s,
        )
        try:
            import carla
        except ImportError as error:
            raise BackendUnavailable("carla is missing: pip install 'rfedge[carla]'") from error
        with whole_folder(self.out) as folder:
            try:
                client = carla.Client(self.host, self.port)
                client.set_timeout(self.timeout_s)
                world = client.load_world(self.town) if self.town else client.get_world()
                count = Recorder(carla, world, settings).record(folder)
            except RuntimeError as error:
                raise RfedgeError(f"CARLA at {self.host}:{self.port}: {error}") from error
        print(f"{self.out}: {count} pictures")
