"""Datasets made of what users own: conversion, poses by structure from motion, CARLA recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from rfcore.errors import InvalidInput
from rfedge.arguments import FOLDER, SIZE, parse_size


@dataclass(frozen=True)
class DatasetRecordCarla:
    """Drive 18 cameras along a street of a running CARLA server, both ways, into a dataset."""

    out: Annotated[Path, FOLDER]
    """The folder to make: pictures and transforms.json."""
    host: Annotated[str, arg(metavar="HOST")] = "127.0.0.1"
    """Host of the CARLA server."""
    port: Annotated[int, arg(metavar="PORT")] = 2000
    """Its RPC port."""
    town: Annotated[str | None, arg(metavar="MAP")] = None
    """Load this map first, such as Town10HD; default: the one that is running."""
    spawn: int = 0
    """Start at this spawn point of the map."""
    stations: int = 20
    """Places along the lane where all cameras take a picture, each way."""
    spacing_m: float = 4.0
    """Metres between them."""
    no_both_ways: bool = False
    """Do not drive back on the lane of the other direction."""
    keep_parked: bool = False
    """Keep the map's own parked vehicles in the pictures."""
    cameras: Annotated[str, arg(metavar="NAME,...")] = "all"
    """`all`, or names from the rig, separated by commas; a drive is `mid_front`."""
    size: Annotated[str, SIZE] = "1920x1080"
    """Size of the pictures, WIDTHxHEIGHT px."""
    fov_deg: float = 90.0
    """Horizontal field of view, degrees."""
    timeout_s: float = 30.0
    """Give up when the server does not answer for so long, seconds."""

    def check(self) -> None:
        """Raise ``InvalidInput`` for what no simulator need be asked about."""
        from rfcore.dataset.rig import mounts_named

        mounts_named(self.cameras)
        parse_size(self.size)
        if self.stations < 1 or self.spawn < 0:
            raise InvalidInput("stations", f"{self.stations} at spawn point {self.spawn}")
        for name in ("spacing_m", "timeout_s"):
            if not getattr(self, name) > 0:
                raise InvalidInput(name, f"{getattr(self, name)} must be above 0")

    @property
    def size_px(self) -> tuple[int, int]:
        """Size of the pictures; raises ``InvalidInput`` for other text."""
        return parse_size(self.size)

    def run(self) -> None:
        """Connect, record, and write the dataset."""
        from rfcore.errors import RfedgeError
        from rfcore.extras import needs
        from rfcore.files import whole_folder
        from rfedge.datasets.carla import CarlaRecorder

        self.check()
        with needs("carla"):
            import carla
        with whole_folder(self.out) as folder:
            try:
                client = carla.Client(self.host, self.port)
                client.set_timeout(self.timeout_s)
                world = client.load_world(self.town) if self.town else client.get_world()
                count = CarlaRecorder(carla, world, self).record(folder)
            except RuntimeError as error:
                raise RfedgeError(f"CARLA at {self.host}:{self.port}: {error}") from error
        print(f"{self.out}: {count} pictures")
