"""A dataset of any format, recognised by the files that are there.

``transforms.json`` (nerfstudio, instant-ngp), a COLMAP model, a KITTI odometry sequence or raw
drive, INRIA's ``cameras.json``, ``camera.toml`` for a recording of one's own, or what servers
recorded: one ``recording.jsonl``, or a folder that they lie below, together in order of time; an
MCAP file or ROS 2 bag; or a drive of a public set (``rfcore.dataset.drive_sets``). A folder with
more than one of the others is ambiguous: the file itself is to be named. ``PATH#NAME`` chooses a
camera of a set, or a topic of a bag.

``read_inria_source`` reads the ``cameras.json`` of the INRIA 3D Gaussian Splatting code: each entry
has ``img_name``, ``width``, ``height``, ``fx``, ``fy`` in pixels, ``position`` in the
world and ``rotation``, the rows of world_from_cam with OpenCV camera axes; the principal point is
the middle. The pictures are expected in ``images`` beside the file. ``input.ply`` beside it holds
the points training started from, ``point_cloud/iteration_N/point_cloud.ply`` the trained Gaussians.

``read_transforms_source`` reads nerfstudio's and instant-ngp's ``transforms.json``.
``transform_matrix`` is world_from_camera with OpenGL camera axes (x right, y up, z backward);
it becomes OpenCV axes here. Intrinsics, camera model and distortion stand at the top and may be
overridden per frame; where ``fl_y``, ``cx`` or ``cy`` are left out they are ``fl_x`` and the middle
of the picture, as both programs define it, and ``w`` and ``h`` its size. ``camera_angle_x`` (rad)
and ``x_fov`` (degrees) may stand for ``fl_x``. ``time`` is in seconds. A key whose value is null
is absent. Other keys are ignored. With instant-ngp's ``from_mitsuba`` camera axes are x left, y up,
z forward.
A frame with instant-ngp's ``sharpness`` whose picture is missing was sorted out as blurred and is
left out, as that program does; any other missing picture is an error.

nerfstudio's ``applied_transform`` A (a rotation and a shift) and ``applied_scale`` s say what was
done to the poses and points before the file was written, ``file = s (A original)``; it is undone,
so that the world is the one that was measured, in its metres.

A key of our own, ``anchor``, states where on the Earth that world is (``rfcore.geodesy``).
"""

from __future__ import annotations

import math
import shlex
from collections import ChainMap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.camera import Intrinsics, Pose, TileOrigin
from rfcore.dataset.assemble import Dataset, Distortion, ReadOptions, assemble
from rfcore.dataset.bag_file import is_bag
from rfcore.dataset.colmap import colmap_models, images_file, read_colmap_source
from rfcore.dataset.drive_set import DriveSet, read_chosen
from rfcore.dataset.drive_sets import drive_set_files, open_drive_set, without_choice
from rfcore.dataset.keys import (
    POSE_SHAPES,
    anchor_at,
    blamed_on,
    lens_of,
    load_json,
    pose_of_rows,
    table_at,
)
from rfcore.dataset.kitti import OXTS, read_kitti_raw_source, read_kitti_source
from rfcore.dataset.picture_file import MaskFile, posed_picture
from rfcore.dataset.picture_header import picture_format, picture_header
from rfcore.dataset.picture_name import file_inside, find_picture, is_absolute
from rfcore.dataset.recorded_session import RECORDING_NAME, read_recorded_source, recordings_under
from rfcore.dataset.recording import read_recording_source
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, SourcePoints, read_points
from rfcore.dataset.video import is_video
from rfcore.errors import DatasetError
from rfcore.tables import Range, Table

UNREAD_LENSES = ("ftheta_p0", "is_equirectangular", "is_latlong")
"""instant-ngp's lenses that are not read here."""


@dataclass(frozen=True)
class AppliedTransform:
    """A transform that was applied to the original world: ``file = scale (transform original)``."""

    original_from_turned: Pose
    scale: float

    def undo(self, pose: Pose) -> Pose:
        """Return a pose of the file in the original world."""
        x, y, z = (value / self.scale for value in pose.translation_m)
        return self.original_from_turned.compose(Pose((x, y, z), pose.rotation))

    def undo_points(self, points: SourcePoints) -> SourcePoints:
        """Return points of the file in the original world."""
        pose = self.original_from_turned
        turned = points.xyz_m / self.scale @ np.array(pose.rotation_matrix()).T
        return SourcePoints(turned + pose.translation_m, points.rgb, points.note)


def read_transforms_source(file: Path) -> Source:
    """Read a transforms file. Raises ``DatasetError`` naming the file, the key and the value."""
    content = _without_nulls(load_json(file))
    top = table_at(str(file), content)
    frames = [_without_nulls(frame) for frame in top.items("frames")]
    if not frames:
        raise top.error("frames", "must list at least one frame")
    applied = _applied(str(file), top)
    kept = [(i, frame) for i, frame in enumerate(frames) if not _sorted_out(file, i, frame)]
    pictures = tuple(_picture(file, content, i, frame) for i, frame in kept)
    notes: list[str] = []
    absolute = sum(is_absolute(picture.name) for picture in pictures)
    if absolute:
        notes.append(
            f"{absolute} of {len(frames)} pictures are named by absolute paths; the files below "
            f"{file.parent} are taken"
        )
    points = _points(file, top, notes)
    if applied is not None:
        pictures = tuple(
            replace(picture, world_from_cam=applied.undo(picture.world_from_cam))
            for picture in pictures
        )
        points = applied.undo_points(points) if points is not None else None
    missing = len(frames) - len(kept)
    exposure_varies = top.choice("exposure", ("auto", "fixed"), "fixed") == "auto"
    anchor = anchor_at(str(file), content.get("anchor"))
    return Source(file, pictures, points, missing, exposure_varies, anchor, tuple(notes))


def transforms_file(folder: Path) -> Path | None:
    """Return a folder's transforms.json or its only transforms*.json, ``None`` without any."""
    found = sorted(folder.glob("transforms*.json"))
    plain = folder / "transforms.json"
    if plain in found:
        return plain
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise DatasetError(f"{folder}: name one of its transforms files ({names})")
    return found[0] if found else None


def _without_nulls(values: Any) -> Any:
    """Return a table less its keys of null, with which some programs fill what they do not know."""
    if not isinstance(values, dict):
        return values
    return {key: value for key, value in values.items() if value is not None}


def _sorted_out(file: Path, index: int, frame: Any) -> bool:
    if not isinstance(frame, dict) or "sharpness" not in frame:
        return False
    where = f"{file}: frames[{index}]"
    return file_inside(where, file.parent, table_at(where, frame).text("file_path")) is None


def _picture(file: Path, content: dict[str, Any], index: int, frame: Any) -> SourcePicture:
    where = f"{file}: frames[{index}]"
    name = table_at(where, frame).text("file_path")
    where = f"{where} ({name})"
    keys = table_at(where, frame)
    path = find_picture(where, file.parent, name)
    camera = _camera(where, table_at(where, ChainMap(frame, content)), path)
    rows = keys.matrix("transform_matrix", POSE_SHAPES)
    mask = None
    if "mask_path" in keys:
        mask = MaskFile(find_picture(f"{where}: mask", file.parent, keys.text("mask_path")))
    x, z = (-1, 1) if content.get("from_mitsuba") else (1, -1)
    opencv_rows = [[x * r[0], -r[1], z * r[2], r[3]] for r in rows]
    pose = pose_of_rows(where, "transform_matrix", opencv_rows)
    time_ns = round(keys.number("time", Range(0.0)) * 1e9) if "time" in keys else None
    return posed_picture(where, name, path, camera, pose, time_ns=time_ns, mask=mask)


def _camera(where: str, keys: Table, picture: Path) -> SourceCamera:
    size_px = (0, 0) if "w" in keys and "h" in keys else picture_header(picture).size_px
    width_px, height_px = (
        keys.whole(key) if key in keys else side_px
        for key, side_px in zip(("w", "h"), size_px, strict=True)
    )
    fx_px = _focal(keys, "x", width_px)
    has_fy = any(key in keys for key in ("fl_y", "camera_angle_y", "y_fov"))
    with blamed_on(where):
        intrinsics = Intrinsics(
            width_px=width_px,
            height_px=height_px,
            fx_px=fx_px,
            fy_px=_focal(keys, "y", height_px) if has_fy else fx_px,
            cx_px=keys.number("cx", default=width_px / 2),
            cy_px=keys.number("cy", default=height_px / 2),
        )
    return SourceCamera(intrinsics, lens_of(where, _model(keys), keys))


def _model(keys: Table) -> object:
    for key in UNREAD_LENSES:
        if keys.value(key, None):
            raise keys.error(key, "names a lens that is not read here")
    if keys.value("is_fisheye", None):
        return "OPENCV_FISHEYE"
    return keys.value("camera_model", "OPENCV")


def _focal(keys: Table, axis: str, side: int) -> float:
    """Return a focal length in pixels, stated or by the full field of view."""
    focal, angle, degrees = f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"
    if focal in keys or (angle not in keys and degrees not in keys):
        return keys.number(focal)
    key = angle if angle in keys else degrees
    angle_rad = keys.number(key) if key == angle else math.radians(keys.number(key))
    if not 0 < angle_rad < math.pi:
        raise keys.error(key, f"is {angle_rad:g} rad, outside 0..pi")
    return 0.5 * side / math.tan(0.5 * angle_rad)


def _applied(where: str, content: Table) -> AppliedTransform | None:
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    turned_from_original = Pose.identity()
    if "applied_transform" in content:
        rows = content.matrix("applied_transform", POSE_SHAPES)
        turned_from_original = pose_of_rows(where, "applied_transform", rows)
    scale = content.number("applied_scale", default=1.0)
    if scale <= 0:
        raise content.error("applied_scale", f"is {scale}, must be above 0")
    return AppliedTransform(turned_from_original.inverse(), scale)


def _points(file: Path, content: Table, notes: list[str]) -> SourcePoints | None:
    if "ply_file_path" not in content:
        return None
    name = content.text("ply_file_path")
    path = file_inside(str(file), file.parent, name)
    if path is None:
        notes.append(f"no points: {name}, which {file.name} names, is missing")
        return None
    return _readable_points(path, notes)


def _readable_points(path: Path, notes: list[str]) -> SourcePoints | None:
    """Return a file's points; without them, and with a note, where it cannot be read: pictures and
    poses do without."""
    try:
        return read_points(path)
    except DatasetError as error:
        notes.append(f"no points: {error}")
        return None


def read_inria_source(file: Path) -> Source:
    """Read a ``cameras.json``. Raises ``DatasetError`` naming the file, the entry and the key."""
    entries = load_json(file)
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{file}: must be a list of at least one camera")
    pictures = tuple(_inria_picture(file, i, entry) for i, entry in enumerate(entries))
    path, notes = file.parent / "input.ply", list[str]()
    points = _readable_points(path, notes) if path.is_file() else None
    return Source(file, pictures, points, notes=tuple(notes))


def _inria_picture(file: Path, index: int, entry: Any) -> SourcePicture:
    where = f"{file}: [{index}]"
    name = table_at(where, entry).text("img_name")
    where = f"{where} ({name})"
    keys = table_at(where, entry)
    camera = _inria_camera(where, keys)
    position = keys.numbers("position", 3)
    rotation = keys.matrix("rotation", ((3, 3),))
    rows = [[*row, t] for row, t in zip(rotation, position, strict=True)]
    path = find_picture(where, file.parent / "images", name)
    return posed_picture(where, name, path, camera, pose_of_rows(where, "rotation", rows))


def _inria_camera(where: str, keys: Table) -> SourceCamera:
    width_px, height_px = keys.whole("width"), keys.whole("height")
    with blamed_on(where):
        focal_px = keys.number("fx"), keys.number("fy")
        return SourceCamera(Intrinsics(width_px, height_px, *focal_px, width_px / 2, height_px / 2))


EXPECTED = (
    "transforms.json, sparse/0 of COLMAP, calib.txt or oxts of KITTI, cameras.json of INRIA, "
    "camera.toml, recording.jsonl of a server, an MCAP file or ROS 2 bag, a log or scenes of "
    "Argoverse 2, nuScenes, 123D, comma2k19 or Boreas"
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


def read_source(path: Path, topics: tuple[str, ...] = ()) -> Source:
    """Read what is there, with its lenses and its own world; of a bag, what ``topics`` name.

    ``path`` may end in ``#NAME``: a camera of a set of drives, or a topic of a bag.
    """
    path, choice = without_choice(path)
    if topics or (choice and is_bag(path)):
        return _read_bag(path, (*topics, *([choice] if choice else [])))
    if (drives := drive_set_of(path)) is not None:
        return read_chosen(drives, path, choice)
    if choice:
        raise DatasetError(f"{path}: is read as a whole; leave out #{choice}")
    if path.is_dir():
        return read_kitti_raw_source(path.parent) if path.name == OXTS else _read_folder(path)
    if not path.exists():
        raise DatasetError(f"{path}: cannot be read (it does not exist)")
    if path.suffix == ".toml":
        return read_recording_source(path)
    if path.name == RECORDING_NAME:
        return read_recorded_source(path)
    if path.name == "calib.txt":
        return read_kitti_source(path.parent)
    if is_bag(path):
        return _read_bag(path)
    if path.suffix in (".bin", ".txt"):
        return read_colmap_source(path.parent)
    if path.suffix != ".json":
        refuse_video(path)
        raise DatasetError(f"{path}: is no file that describes a dataset ({EXPECTED})")
    return read_inria_source(path) if path.name == "cameras.json" else read_transforms_source(path)


def drive_set_of(path: Path) -> DriveSet | None:
    """Return the set of drives at a folder or its file, None where there is another dataset."""
    found = _candidates(path) if path.is_dir() else [path]
    return open_drive_set(found[0]) if len(found) == 1 else None


def _read_bag(path: Path, topics: tuple[str, ...] = ()) -> Source:
    from rfcore.dataset.bag import BagChoice, read_bag_source

    return read_bag_source(path, BagChoice(topics))


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
    if not found and is_bag(folder):
        return _read_bag(folder)
    if not found:
        _refuse_pictures_alone(folder)
        raise DatasetError(f"{folder}: no dataset is recognised there (none of {EXPECTED})")
    if len(found) > 1:
        names = ", ".join(str(file) for file in found)
        raise DatasetError(f"{folder}: holds several datasets, name one of them: {names}")
    models = colmap_models(folder)
    if models and found[0].parent == models[0]:
        return read_colmap_source(models[0], models[1:])
    return read_source(found[0])


def _refuse_pictures_alone(folder: Path) -> None:
    """Raise ``DatasetError`` for a folder of pictures, saying how their poses are found."""
    for place in (folder, folder / "images"):
        files = place.iterdir() if place.is_dir() else ()
        count = sum(picture_format(file) is not None for file in files)
        if count:
            raise DatasetError(
                f"{place}: holds {count} pictures and no poses; find those by structure from "
                f"motion: rfedge dataset poses {shlex.quote(str(place))} --out DATASET"
            )


def _candidates(folder: Path) -> list[Path]:
    named = [folder / name for name in ("camera.toml", "cameras.json", "calib.txt")]
    found = [file for file in named if file.is_file()] + drive_set_files(folder)
    transforms = transforms_file(folder)
    models = colmap_models(folder)
    if (folder / OXTS / "data").is_dir():
        found.append(folder / OXTS)
    if transforms is not None:
        found.append(transforms)
    found += [file for model in models[:1] if (file := images_file(model)) is not None]
    return found
