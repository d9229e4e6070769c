"""``rfedge scene``: datasets rendered, converted, posed by structure from motion, or recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from rfedge.arguments import DATASET, FOLDER, SIZE, parse_size
from rfedge.cli.scene_street import SceneBuild, ScenePlan, SceneSheet, SceneSizes

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Scene", "SceneConvert", "ScenePoses", "SceneRecordCarla"]


@dataclass(frozen=True)
class SceneConvert:
    """Write a dataset of any format as undistorted PNG pictures and a transforms.json, once."""

    dataset: Annotated[Path, Positional, DATASET]
    """A folder with transforms.json, a COLMAP model, a KITTI sequence, INRIA's cameras.json or a
    recording's camera.toml; or that file itself."""
    out: Annotated[Path, FOLDER]
    """The folder to make."""
    size: Annotated[str | None, SIZE] = None
    """Reduce pictures to WIDTHxHEIGHT px by averaging areas; default: as they are."""
    every: int = 1
    """Take each n-th picture."""
    offset: int = 0
    """Leave out the first pictures, so many."""

    def run(self) -> None:
        """Convert; the folder appears when all of it is there."""
        from rfedge.datasets.convert import convert_dataset

        size_px = parse_size(self.size) if self.size is not None else None
        chosen = slice(self.offset, None, self.every)
        print(convert_dataset(self.dataset, self.out, size_px, chosen))


@dataclass(frozen=True)
class ScenePoses:
    """Find the poses of pictures with COLMAP, in a new world or in a dataset's own."""

    images: Annotated[Path, Positional, FOLDER]
    """Folder of pictures (PNG, JPEG, WebP), in order of their names."""
    out: Annotated[Path, FOLDER]
    """The folder to make: pictures, points and transforms.json."""
    register_to: Annotated[Path | None, DATASET] = None
    """A dataset whose world the poses shall be in; its poses and cameras are held."""
    camera: Literal["dataset", "estimate"] = "dataset"
    """With --register-to: take the dataset's camera, or estimate the intrinsics."""
    camera_model: Annotated[str, arg(metavar="MODEL")] = "SIMPLE_RADIAL"
    """COLMAP camera model of the new pictures, where it is not the dataset's camera."""
    parameters: Annotated[tuple[float, ...], arg(metavar="NUMBER ...")] = ()
    """Its known parameters in COLMAP's order, which are held; default: estimated."""
    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    """Match all pairs, or neighbours in a long drive."""
    max_side_px: int = 1600
    """Longest side at which features are looked for."""
    features: int = 8192
    """At most so many features a picture."""
    threads: int = 2
    """Threads."""
    seed: int = 1
    """Seed of the robust estimators."""

    def run(self) -> None:
        """Place the pictures and write the dataset; say which ones could not be placed."""
        import signal

        from rich.console import Console

        from rfedge.datasets.colmap_features import Matching, PoseSettings, SharedCamera
        from rfedge.datasets.poses import pose_dataset

        settings = PoseSettings(
            matching=Matching(self.matching),
            camera=SharedCamera(self.camera),
            model=self.camera_model,
            parameters=self.parameters,
            max_side_px=self.max_side_px,
            features=self.features,
            threads=self.threads,
            seed=self.seed,
        )
        # COLMAP's own handler would print a C++ stack and leave its folder behind.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with _shown(Console(stderr=True)) as tell:
            line = pose_dataset(self.images, self.out, self.register_to, settings, tell)
        print(line)


@contextmanager
def _shown(console: Console) -> Iterator[Callable[[str], None]]:
    """Show what is told: in one changing line on a terminal, line by line in a log."""
    if not console.is_terminal:
        yield lambda text: console.print(f"  {text}", highlight=False)
        return
    with console.status("reading pictures") as status:
        yield status.update


@dataclass(frozen=True)
class SceneRecordCarla:
    """Drive 18 cameras along a street of a running CARLA server, both ways, into a dataset."""

    out: Annotated[Path, FOLDER]
    """The folder to make: pictures and transforms.json."""
    host: Annotated[str, arg(metavar="HOST")] = "127.0.0.1"
    """Where the server runs."""
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
    both_ways: bool = True
    """Drive back on the lane of the other direction."""
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

    def run(self) -> None:
        """Connect, record, and write the dataset."""
        from rfcore.errors import RfedgeError
        from rfcore.extras import needs
        from rfcore.files import whole_folder
        from rfedge.datasets.carla import Recorder, RecordSettings
        from rfedge.datasets.rig import mounts_named

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
        with needs("carla"):
            import carla
        with whole_folder(self.out) as folder:
            try:
                client = carla.Client(self.host, self.port)
                client.set_timeout(self.timeout_s)
                world = client.load_world(self.town) if self.town else client.get_world()
                count = Recorder(carla, world, settings).record(folder)
            except RuntimeError as error:
                raise RfedgeError(f"CARLA at {self.host}:{self.port}: {error}") from error
        print(f"{self.out}: {count} pictures")


@dataclass(frozen=True)
class Scene:
    """Make datasets: render a street, convert recordings, find poses, record a simulator."""

    verb: Annotated[
        Annotated[SceneBuild, subcommand("build")]
        | Annotated[SceneConvert, subcommand("convert")]
        | Annotated[ScenePoses, subcommand("poses")]
        | Annotated[ScenePlan, subcommand("plan")]
        | Annotated[SceneSheet, subcommand("sheet")]
        | Annotated[SceneSizes, subcommand("sizes")]
        | Annotated[SceneRecordCarla, subcommand("record-carla")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
