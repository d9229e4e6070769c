"""A dataset of any format, recognised by the files that are there.

``transforms.json`` (nerfstudio, instant-ngp), a COLMAP model, a KITTI odometry sequence, INRIA's
``cameras.json``, ``camera.toml`` for a recording of one's own, or what servers recorded: one
``recording.jsonl``, or a folder that they lie below, together in order of time. A folder with more
than one of the others is ambiguous: the file itself is to be named.
"""

from __future__ import annotations

import shlex
from pathlib import Path

from rfcore.camera import TileOrigin
from rfcore.dataset.assemble import Dataset, Distortion, ReadOptions, assemble
from rfcore.dataset.colmap import colmap_model_folder, read_colmap_source
from rfcore.dataset.inria import read_inria_source
from rfcore.dataset.kitti import read_kitti_source
from rfcore.dataset.recorded_session import RECORDING_NAME, read_recorded_source, recordings_under
from rfcore.dataset.recording import read_recording_source
from rfcore.dataset.source import Source
from rfcore.dataset.transforms import read_transforms_source, transforms_file
from rfcore.errors import DatasetError

__all__ = ["is_video", "read_dataset", "read_source", "refuse_video"]

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp")
EXPECTED = (
    "transforms.json, sparse/0 of COLMAP, calib.txt of KITTI, cameras.json of INRIA, camera.toml, "
    "recording.jsonl of a server"
)


def read_dataset(
    path: Path,
    *,
    tile_origin: TileOrigin | None = None,
    distortion: Distortion | str = Distortion.REFUSE,
    size_px: tuple[int, int] | None = None,
) -> Dataset:
    """Read a dataset's folder, or the file that describes it; pixels are read on demand.

    Options as ``ReadOptions`` says. Raises ``DatasetError`` naming the file and the key at fault.
    """
    options = ReadOptions(tile_origin, Distortion(distortion), size_px)
    return assemble(read_source(path), options)


def read_source(path: Path) -> Source:
    """Read what is there, with its lenses and its own world."""
    if path.is_dir():
        return _read_folder(path)
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
            f"rfedge scene poses {shlex.quote(str(path))} --out DATASET; or, "
            "with a trajectory, describe it in a camera.toml (docs/data.md)"
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
    if transforms is not None:
        found.append(transforms)
    if model is not None:
        found.append(next(f for f in (model / "images.bin", model / "images.txt") if f.is_file()))
    return found
