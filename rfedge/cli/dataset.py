"""``rfedge dataset``: convert datasets, find poses by structure from motion, or record drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from rfedge.arguments import (
    DATASET,
    FOLDER,
    SIZE,
    Up,
    field_path,
    is_field_file,
    open_field,
    parse_size,
)
from rfedge.datasets import DatasetRecordCarla

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class DatasetConvert:
    """Write a dataset of any format as undistorted PNG pictures and a transforms.json, once."""

    dataset: Annotated[Path, Positional, DATASET]
    """A folder with transforms.json, a COLMAP model, a KITTI sequence, INRIA's cameras.json or a
    recording's camera.toml; or that file itself; or an MCAP file or ROS 2 bag; or PATH#CAMERA of
    Argoverse 2, nuScenes (PATH#SCENE/CAMERA), 123D, comma2k19 or Boreas."""
    out: Annotated[Path, FOLDER]
    """The folder to make."""
    size: Annotated[str | None, SIZE] = None
    """Reduce pictures to WIDTHxHEIGHT px by averaging areas; default: as they are."""
    every: int = 1
    """Take each n-th picture."""
    offset: int = 0
    """Number of first pictures to leave out."""
    topics: Annotated[tuple[str, ...], arg(metavar="TOPIC ...")] = ()
    """The topics that are meant, of a bag with several cameras or poses."""

    def run(self) -> None:
        """Convert; the folder appears when all of it is there."""
        from rfedge.datasets.convert import convert_dataset

        size_px = parse_size(self.size) if self.size is not None else None
        chosen = slice(self.offset, None, self.every)
        print(convert_dataset(self.dataset, self.out, size_px, chosen, self.topics))


@dataclass(frozen=True)
class DatasetSplit:
    """Cut a long recording into tiles of ground that overlap, for `rfedge train` to train."""

    dataset: Annotated[Path, Positional, DATASET]
    """A dataset of any format; lenses are undistorted."""
    out: Annotated[Path, FOLDER]
    """The folder to make: one dataset for each tile, and tiles.json, which lists them."""
    length: Annotated[float, arg(metavar="M")]
    """Longest side of a tile's ground, m."""
    overlap: Annotated[float, arg(metavar="M")] = 10.0
    """Length over which neighbouring tiles share their pictures, m."""
    fewest: int = 8
    """Least number of pictures of a tile."""
    points_within: Annotated[float, arg(metavar="M")] = 60.0
    """A tile takes the dataset's points on its ground and within this distance of it, m."""

    def run(self) -> None:
        """Split; the folder appears when all of it is there."""
        from rfedge.datasets.convert import SplitSettings, split_dataset

        settings = SplitSettings(self.length, self.overlap, self.fewest, self.points_within)
        for tile in split_dataset(self.dataset, self.out, settings):
            west, south, east, north = tile.area_m
            ground = f"{west:.1f}, {south:.1f} to {east:.1f}, {north:.1f} m"
            beside = ", ".join(tile.neighbours) or "no tile"
            print(f"{self.out / tile.name}: {len(tile.pictures)} pictures, {ground}, by {beside}")


@dataclass(frozen=True)
class DatasetPoses:
    """Find the poses of pictures with COLMAP, in a new world or in a dataset's own."""

    images: Annotated[Path, Positional, arg(metavar="FOLDER|VIDEO")]
    """Folder of pictures (PNG, JPEG, WebP), in order of their names; or a video, of which the
    sharpest frames are taken. A run that was stopped goes on with those in OUT.frames."""
    out: Annotated[Path, FOLDER]
    """The folder to make: pictures, points and transforms.json."""
    register_to: Annotated[Path | None, DATASET] = None
    """Find poses in the world of this dataset, whose poses and cameras are held; or in that of a
    field (an archive or a name), if its pictures are not at hand: then give the camera."""
    camera: Literal["dataset", "estimate"] = "dataset"
    """With --register-to: take the dataset's camera, or estimate the intrinsics."""
    camera_model: Annotated[str, arg(metavar="MODEL")] = "SIMPLE_RADIAL"
    """COLMAP camera model of the new pictures, where it is not the dataset's camera."""
    parameters: Annotated[tuple[float, ...], arg(metavar="NUMBER ...")] = ()
    """Known parameters of that model in COLMAP's order, which are held; default: estimated."""
    up: Up | None = None
    """Axis that points up in the field registered to; default: as its training cameras show it."""
    per_second: float = 2.0
    """Pictures to take of each second of a video."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Match all pairs, or neighbours in a long drive; auto: neighbours in a video, else all."""
    max_side_px: int = 1600
    """Longest side of pictures in which features are looked for."""
    features: int = 8192
    """Most features of a picture."""
    threads: int = 2
    """Threads."""
    seed: int = 1
    """Seed of the robust estimators."""

    def run(self) -> None:
        """Place the pictures and write the dataset; say which ones could not be placed."""
        import shutil
        import signal

        from rfcore.dataset.video import is_video

        field = self._field()
        if field is None:
            import rfedge.datasets.poses  # noqa: F401 (COLMAP's handler comes with its import)

        # That handler would print a C++ stack and leave its folder behind.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        if not is_video(self.images):
            self._place(self.images, field)
            return
        frames = self.out.with_name(f"{self.out.name}.frames")
        self._place(self._frames(frames), field)
        shutil.rmtree(frames)

    def _frames(self, folder: Path) -> Path:
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfedge.datasets.video_frames import sharpest_frames

        if self.out.exists():
            raise InvalidInput("out", f"{self.out} exists already; name another folder")
        with _shown(Console(stderr=True)) as tell:
            count = sharpest_frames(self.images, folder, self.per_second, tell)
            tell(f"{count} frames in {folder}")
        return folder

    def _place(self, images: Path, field: Path | None) -> None:
        if field is None:
            self._among_pictures(images)
        else:
            self._in_field(images, field)

    def _field(self) -> Path | None:
        """Return the archive to register to, told by its content; None for a dataset or none."""
        if self.register_to is None:
            return None
        if self.register_to.exists():
            return self.register_to if is_field_file(self.register_to) else None
        return field_path(self.register_to)

    def _in_field(self, images: Path, field: Path) -> None:
        from rich.console import Console

        from rfedge.fields.register import RegisterSettings, register_pictures

        settings = RegisterSettings(self.camera_model, self.parameters, self.up)
        opened = open_field(field, threads=self.threads)
        with _shown(Console(stderr=True)) as tell:
            line = register_pictures(images, self.out, opened, settings, tell)
        print(line)

    def _among_pictures(self, images: Path) -> None:
        from rich.console import Console

        from rfcore.dataset.video import is_video
        from rfedge.datasets.colmap_features import PoseSettings
        from rfedge.datasets.poses import pose_dataset

        matching = self.matching
        if matching == "auto":
            matching = "sequential" if is_video(self.images) else "exhaustive"
        settings = PoseSettings(
            matching=matching,
            camera=self.camera,
            model=self.camera_model,
            parameters=self.parameters,
            max_side_px=self.max_side_px,
            features=self.features,
            threads=self.threads,
            seed=self.seed,
        )
        with _shown(Console(stderr=True)) as tell:
            line = pose_dataset(images, self.out, self.register_to, settings, tell)
        print(line)


@contextmanager
def _shown(console: Console) -> Iterator[Callable[[str], None]]:
    """Show progress: in one changing line on a terminal, line by line in a log."""
    if not console.is_terminal:
        yield lambda text: console.print(f"  {text}", highlight=False)
        return
    with console.status("reading pictures") as status:
        yield status.update


@dataclass(frozen=True)
class Dataset:
    """Make datasets: convert, split or pose recordings, record a simulator."""

    verb: Annotated[
        Annotated[DatasetConvert, subcommand("convert")]
        | Annotated[DatasetSplit, subcommand("split")]
        | Annotated[DatasetPoses, subcommand("poses")]
        | Annotated[DatasetRecordCarla, subcommand("record-carla")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
