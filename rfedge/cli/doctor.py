"""``rfedge doctor``: what a file or folder is, what is understood of it, and what comes next."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import is_field_file, open_field

if TYPE_CHECKING:
    from rfcore.dataset.source import Source

EASY_SIDE_PX, LEAST_REDUCED = 1280, 0.8
"""Longest side of pictures that are trained on in minutes, and the scale from which to leave them.
"""
PLY_HEADER_BYTES = 8192
SPLAT_PROPERTIES = (b"opacity", b"packed_position")
"""Properties in the header of a ``.ply`` of splats, and of a compressed one."""


@dataclass(frozen=True)
class Doctor:
    """Say what a file or folder is, what is understood, changed and left out, and what comes next.

    Nothing is written. What cannot be read is an error, with what to do.
    """

    path: Annotated[Path, Positional, arg(metavar="FILE|FOLDER")]
    """Splats of any program, a field, a coded drive (.rfv), a dataset, an MCAP file or ROS 2 bag,
    pictures, a video. PATH#NAME is one camera of a set of drives."""

    def run(self) -> None:
        """Print a line for each thing."""
        from rfcore.dataset.bag_file import is_bag
        from rfcore.dataset.drive_sets import without_choice
        from rfcore.errors import DatasetError, InvalidData
        from rfcore.field.splat_file import looks_like_splats
        from rfcore.wire.drive_file import is_coded_drive

        path, choice = without_choice(self.path)
        if not path.exists():
            raise InvalidData(f"there is no {self.path}")
        try:
            if choice:
                lines = _of_dataset(self.path)
            elif is_field_file(self.path):
                lines = _of_field(self.path)
            elif is_coded_drive(self.path):
                lines = _of_coded_drive(self.path)
            elif looks_like_splats(self.path):
                lines = _of_splats(self.path)
            elif is_bag(self.path):
                lines = _of_bag(self.path)
            else:
                lines = _of_dataset(self.path)
            for line in lines:
                print(line)
        except DatasetError as error:
            inside = [file for file in _files(self.path) if _holds_splats(file)]
            if not inside:
                raise
            commands = ", ".join(f"rfedge doctor {shlex.quote(str(file))}" for file in inside[:3])
            raise DatasetError(
                f"{error}; it holds {len(inside)} splat files: {commands}"
            ) from error


def _holds_splats(file: Path) -> bool:
    """Tell whether a file is of splats; a ``.ply`` of points beside a dataset is not."""
    from rfcore.field.splat_file import looks_like_splats

    if not looks_like_splats(file):
        return False
    with file.open("rb") as content:
        header = content.read(PLY_HEADER_BYTES)
    return not header.startswith(b"ply") or any(name in header for name in SPLAT_PROPERTIES)


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.glob("*") if file.is_file()) if path.is_dir() else []


def _of_field(path: Path) -> Iterator[str]:
    from rfedge.fields.describe import describe_field

    yield f"{path}: a field"
    for name, value in describe_field(open_field(path)):
        yield f"{name:>13}  {value}"
    yield f"next: rfedge field info {shlex.quote(str(path))} --drive DATASET"


def _of_coded_drive(path: Path) -> Iterator[str]:
    from rfcore.wire.drive_file import read_drive

    drive = read_drive(path)
    k, field = drive.hello.cameras[0].intrinsics, drive.hello.field_ids[0]
    size = f"{len(drive.frames)} frames of {k.width_px}x{k.height_px} px"
    yield f"{path}: a coded drive of {size}, against the field {field[:12]}"
    yield f"next: rfedge decode {shlex.quote(str(path))} --field FIELD.rff --out FOLDER"


def _of_splats(path: Path) -> Iterator[str]:
    import numpy as np

    from rfedge.fields.confined_reader import read_splats
    from rfedge.fields.describe import up_of_file

    read = read_splats(path)
    splats = read.splats
    drawn = {None: "not stated", True: "yes", False: "no"}[read.antialiased]
    yield f"{path}: {len(splats):,} splats of SH degree {splats.sh_degree}; antialiased: {drawn}"
    if len(splats):
        low, high = np.percentile(splats.means, (5, 95), axis=0)
        sides = " x ".join(f"{side:.3g}" for side in high - low)
        yield f"nine in ten lie within {sides} units"
    yield from read.notes
    yield up_of_file(read.up)
    name = shlex.quote(path.stem.partition(".")[0] or "field")
    yield f"next: rfedge field import {shlex.quote(str(path))} --name {name}"


def _of_bag(path: Path) -> Iterator[str]:
    """Yield a line a topic, then what a dataset of it would be; what hinders one is no error."""
    from rfcore.dataset.bag import BagChoice, BagIndex, read_bag_source
    from rfcore.errors import DatasetError

    index = BagIndex.of(path)
    yield f"{path}: a bag of {sum(topic.count for topic in index.topics)} messages"
    for topic in sorted(index.topics, key=lambda topic: topic.name):
        refused = f"  ({topic.refused})" if topic.refused else ""
        rate = f"{topic.rate_hz:.3g} a second" if topic.rate_hz else ""
        yield f"  {topic.name}  {topic.type}  {topic.count}  {rate}{refused}"
    for feed in (*index.fixes, *index.poses):
        yield f"{feed}: a pose feed, which `rfedge dataset convert` writes beside the pictures"
    quoted = shlex.quote(str(path))
    cameras = list(index.pictures) if len(index.pictures) > 1 else [None]
    for camera in cameras:
        chosen = [] if camera is None else [camera]
        try:
            source = read_bag_source(path, BagChoice(tuple(chosen)))
        except DatasetError as error:
            yield f"no dataset yet: {error}"
            continue
        yield from _cameras(source)
        yield from source.notes
        source.pictures[0].read()
        topics = f" --topics {shlex.quote(camera)}" if camera is not None else ""
        yield f"next: rfedge dataset convert {quoted}{topics} --out DATASET"


def _of_dataset(path: Path) -> Iterator[str]:
    from rfcore.dataset.assemble import Distortion, ReadOptions, assemble
    from rfcore.dataset.drive_set import names_below
    from rfcore.dataset.drive_sets import without_choice
    from rfcore.dataset.read import drive_set_of, read_source

    place, choice = without_choice(path)
    drives = drive_set_of(place)
    if drives is not None and len(names := names_below(drives, choice)) > 1:
        yield f"{path}: {len(names)} cameras, one of which is named"
        for scene, cameras in groupby(names, lambda name: name.rpartition("/")[0]):
            shown = " ".join(name.rpartition("/")[2] for name in cameras)
            yield f"  {scene}: {shown}" if scene else f"  {shown}"
        yield f"next: rfedge doctor {shlex.quote(f'{place}#{names[0]}')}"
        return
    source = read_source(path)
    dataset = assemble(source, ReadOptions(distortion=Distortion.UNDISTORT))
    yield f"{path}: a dataset of {len(source.pictures)} pictures, described by {source.file}"
    yield from _cameras(source)
    points = "none" if dataset.points is None else f"{len(dataset.points.xyz_m):,}"
    rate = "without times" if dataset.rate_hz is None else f"{dataset.rate_hz:.3g} a second"
    yield f"points: {points}; pictures: {rate}"
    if source.sorted_out:
        yield f"{source.sorted_out} pictures are listed but not there, and left out"
    yield from dataset.changes
    source.pictures[0].read()
    given = shlex.quote(str(path)) + _smaller(source)
    for feed in source.feeds:
        yield f"{feed}: a pose feed, which `rfedge dataset convert` writes beside the pictures"
    if any(picture.camera.lens is not None for picture in source.pictures):
        yield f"next: rfedge dataset convert {given} --out DATASET (without the lens)"
    else:
        yield f"next: rfedge train {given} --out FIELD.rff"


def _smaller(source: Source) -> str:
    """Return ``--size`` where pictures have far more pixels than minutes of training are for."""
    shown = (picture.camera.intrinsics for picture in source.pictures)
    sizes = {(k.width_px, k.height_px) for k in shown}
    width_px, height_px = next(iter(sizes))
    scale = EASY_SIDE_PX / max(width_px, height_px)
    if len(sizes) > 1 or scale >= LEAST_REDUCED:
        return ""
    return f" --size {round(scale * width_px)}x{round(scale * height_px)}"


def _cameras(source: Source) -> Iterator[str]:
    """Yield a line for each camera: its lens, its size, its pictures."""
    from rfcore.dataset.colmap import camera_parameters

    for camera, count in Counter(picture.camera for picture in source.pictures).most_common(5):
        model, parameters = camera_parameters(camera)
        k = camera.intrinsics
        shown = " ".join(f"{value:.6g}" for value in parameters)
        yield f"{count} of {k.width_px}x{k.height_px} px: {model} {shown}"
