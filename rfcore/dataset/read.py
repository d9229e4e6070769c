"""A dataset of any format, recognised by the files that are there.

``transforms.json`` (nerfstudio, instant-ngp), a COLMAP model, a KITTI odometry sequence or raw
drive, INRIA's ``cameras.json``, ``camera.toml`` for a recording of one's own, or what servers
recorded: one ``recording.jsonl``, or a folder that they lie below, together in order of time. A
folder with more than one of the others is ambiguous: the file itself is to be named.

``read_inria_source`` reads the ``cameras.json`` of the INRIA 3D Gaussian Splatting code: each entry
has ``img_name``, ``width``, ``height``, ``fx``, ``fy`` in pixels, ``position`` in the
world and ``rotation``, the rows of world_from_cam with OpenCV camera axes; the principal point is
the middle. The pictures are expected in ``images`` beside the file. ``input.ply`` beside it holds
the points training started from, ``point_cloud/iteration_N/point_cloud.ply`` the trained Gaussians.
"""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Any

from rfcore.camera import Intrinsics, TileOrigin
from rfcore.dataset.assemble import Dataset, Distortion, ReadOptions, assemble
from rfcore.dataset.colmap import colmap_model_folder, read_colmap_source
from rfcore.dataset.keys import blamed_on, load_json, pose_of_rows, table_at
from rfcore.dataset.kitti import OXTS, read_kitti_raw_source, read_kitti_source
from rfcore.dataset.picture_file import check_size, find_picture, read_picture
from rfcore.dataset.recorded_session import RECORDING_NAME, read_recorded_source, recordings_under
from rfcore.dataset.recording import read_recording_source
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, read_points
from rfcore.dataset.transforms import read_transforms_source, transforms_file
from rfcore.errors import DatasetError
from rfcore.tables import Table


def read_inria_source(file: Path) -> Source:
    """Read a ``cameras.json``. Raises ``DatasetError`` naming the file, the entry and the key."""
    entries = load_json(file)
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{file}: must be a list of at least one camera")
    pictures = tuple(_picture(file, i, entry) for i, entry in enumerate(entries))
    points = file.parent / "input.ply"
    return Source(file, pictures, read_points(points) if points.is_file() else None)


def trained_ply(folder: Path) -> Path:
    """Return the trained Gaussians of the last iteration that a training folder holds."""
    found = folder.glob("point_cloud/iteration_*/point_cloud.ply")
    numbered = [(path.parent.name.rpartition("_")[2], path) for path in found]
    iterations = [(int(digits), path) for digits, path in numbered if digits.isdecimal()]
    if not iterations:
        raise DatasetError(f"{folder}: no point_cloud/iteration_N/point_cloud.ply")
    return max(iterations)[1]


def _picture(file: Path, index: int, entry: Any) -> SourcePicture:
    where = f"{file}: [{index}]"
    name = table_at(where, entry).text("img_name")
    where = f"{where} ({name})"
    keys = table_at(where, entry)
    camera = _camera(where, keys)
    position = keys.numbers("position", 3)
    rotation = keys.matrix("rotation", ((3, 3),))
    rows = [[*row, t] for row, t in zip(rotation, position, strict=True)]
    path = find_picture(where, file.parent / "images", name)
    check_size(path, camera.intrinsics)
    return SourcePicture(
        where=where,
        name=name,
        camera=camera,
        world_from_cam=pose_of_rows(where, "rotation", rows),
        read=partial(read_picture, path, camera.intrinsics),
    )


def _camera(where: str, keys: Table) -> SourceCamera:
    width_px, height_px = keys.whole("width"), keys.whole("height")
    with blamed_on(where):
        focal_px = keys.number("fx"), keys.number("fy")
        return SourceCamera(Intrinsics(width_px, height_px, *focal_px, width_px / 2, height_px / 2))


VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp")
EXPECTED = (
    "transforms.json, sparse/0 of COLMAP, calib.txt or oxts of KITTI, cameras.json of INRIA, "
    "camera.toml, recording.jsonl of a server"
)


def read_dataset(
    path: Path,
    *,
    tile_origin: TileOrigin | None = None,
    distortion: Distortion | str = Distortion.REFUSE,
    size_px: tuple[int, int] | None = None,
) -> Dataset:
    """Read a dataset's folder, or the file that describes it; pixels are read on demand.

    >>> from pathlib import Path
    >>> from rfcore.dataset import read_dataset
    >>> dataset = read_dataset(Path("samples/street/transforms_drive_empty.json"))
    >>> len(dataset.pictures), dataset.rate_hz
    (24, 10.0)
    >>> first = dataset.pictures[0]
    >>> first.read().shape, first.camera.world_from_cam.translation_m[2]
    ((360, 640, 3), 1.62)

    ``ReadOptions`` explains the options. Raises ``DatasetError`` naming the file and the key at
    fault.
    """
    options = ReadOptions(tile_origin, Distortion(distortion), size_px)
    return assemble(read_source(path), options)


def read_source(path: Path) -> Source:
    """Read what is there, with its lenses and its own world."""
    if path.is_dir():
        return read_kitti_raw_source(path.parent) if path.name == OXTS else _read_folder(path)
    if not path.exists():
        raise DatasetError(f"{path}: cannot be read (it does not exist)")
    refuse_video(path)
    if path.suffix == ".toml":
        return read_recording_source(path)
    if path.name == RECORDING_NAME:
        return read_recorded_source(path)
    if path.name == "calib.txt":
        return read_kitti_source(path.parent)
    if path.suffix in (".bin", ".txt"):
        return read_colmap_source(path.parent)
    if path.suffix != ".json":
        raise DatasetError(f"{path}: is no file that describes a dataset ({EXPECTED})")
    return read_inria_source(path) if path.name == "cameras.json" else read_transforms_source(path)


def is_video(path: Path) -> bool:
    """Tell whether a file is a video, by its name."""
    return path.suffix.lower() in VIDEOS and not path.is_dir()


def refuse_video(path: Path) -> None:
    """Raise ``DatasetError`` for a video, saying how pictures with poses are made of it."""
    if is_video(path):
        raise DatasetError(
            f"{path}: is a video, which has no poses; find those of its sharpest frames: "
            f"rfedge dataset poses {shlex.quote(str(path))} --out DATASET; or, "
            "with a trajectory, describe it in a camera.toml (docs/how-to/data.md)"
        )


def _read_folder(folder: Path) -> Source:
    """Read the one dataset a folder holds; several are a ``DatasetError`` that asks which."""
    found = _candidates(folder)
    recorded = [] if found else recordings_under(folder)
    if recorded:
        return read_recorded_source(*recorded)
    if not found:
        raise DatasetError(f"{folder}: no dataset is recognised there (none of {EXPECTED})")
    if len(found) > 1:
        names = ", ".join(str(file) for file in found)
        raise DatasetError(f"{folder}: holds several datasets, name one of them: {names}")
    return read_source(found[0])


def _candidates(folder: Path) -> list[Path]:
    named = [folder / name for name in ("camera.toml", "cameras.json", "calib.txt")]
    found = [file for file in named if file.is_file()]
    transforms = transforms_file(folder)
    model = colmap_model_folder(folder)
    if (folder / OXTS / "data").is_dir():
        found.append(folder / OXTS)
    if transforms is not None:
        found.append(transforms)
    if model is not None:
        found.append(next(f for f in (model / "images.bin", model / "images.txt") if f.is_file()))
    return found
