"""Make a dataset with poses of a folder of pictures, in a new world or in a dataset's own.

To register, points are triangulated from the dataset's pictures at their given poses; the new
pictures are then resected against them and refined, while every given pose and camera is held.
Alone, COLMAP's incremental mapping finds a world of its own, whose scale is not metres.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import astuple, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rfcore.camera import Pose, TileOrigin
from rfcore.dataset.assemble import Distortion, chosen_origin
from rfcore.dataset.orientation import Orientation
from rfcore.dataset.picture_file import picture_paths
from rfcore.dataset.picture_header import picture_header
from rfcore.dataset.read import read_dataset, read_source, refuse_video
from rfcore.dataset.source import SourceCamera, SourcePicture, SourcePoints
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import DatasetError, named
from rfcore.extras import needs
from rfcore.files import whole_folder
from rfcore.image import read_rgb, write_png
from rfcore.wire.waits import waiting
from rfedge.datasets.colmap_features import (
    DATABASE,
    PoseSettings,
    add_known,
    add_new,
    cancellable,
    match,
    pose_from_colmap,
    rigid_of,
    source_camera,
)

with needs("colmap"):
    import pycolmap

Tell = Callable[[str], None]
"""Called with a line that says what is being done."""
MIN_PICTURES = 3
PLAIN = ("PNG", "JPEG")
"""Formats that COLMAP reads; pycolmap 4.2's wheels read no WebP, without saying so."""
ANY_FORWARD_MOTION = 1.0
"""A drive moves forward; COLMAP's default, 0.95, would refuse every pair to start from."""
START_ANGLES_DEG = (16.0, 2.0)
"""Angles that points of the first pair are to be seen under, tried one after the other: COLMAP's
default, which it lowers to 4 by itself, and that of a short drive on which all pictures overlap."""


def pose_dataset(
    images: Path,
    out: Path,
    register_to: Path | None,
    settings: PoseSettings,
    tell: Tell,
) -> str:
    """Write ``out`` with the pictures that could be placed; return one line about it.

    ``tell`` is called with what is being done. Raises ``DatasetError`` when nothing can be placed
    or the lens found is none, ``InvalidInput`` when ``out`` exists.
    """
    fewest = 1 if register_to is not None else MIN_PICTURES
    paths, said = _of_one_size(images, _pictures(images, fewest), fewest, settings)
    known = read_source(register_to).pictures if register_to is not None else ()
    with whole_folder(out) as folder, TemporaryDirectory(dir=folder) as work:
        root = Path(work)
        (root / "new").mkdir()
        told: list[str] = []
        names = [f"new/{_copied(path, root / 'new', told.append).name}" for path in paths]
        for words, count in Counter(line.partition(": ")[2] for line in told).items():
            tell(f"{count} of {len(paths)} pictures: {words}")
        try:
            solution = solve_poses(root, names, known, settings, tell)
        except DatasetError as error:
            raise DatasetError(f"{error}{said}") from error
        _write(folder, root, names, solution)
        if register_to is None:
            _check_lens(images, folder, f"{len(solution.placed)} of {len(paths)}")
    found = not settings.parameters and (not known or settings.camera == "estimate")
    return _summary(out, solution) + (_focal_lengths(solution) if found else "") + said


def _of_one_size(
    images: Path, paths: Sequence[Path], fewest: int, settings: PoseSettings
) -> tuple[Sequence[Path], str]:
    """Return the pictures of the size that most have where the camera's parameters are given, which
    belong to one size; and what is said about the others."""
    headers = {path: picture_header(path) for path in paths}
    sizes = {path: one.orientation.size(one.size_px) for path, one in headers.items()}
    counts = Counter(sizes.values())
    if not settings.parameters or len(counts) == 1:
        return paths, ""
    ((most_px, _), *_) = counts.most_common()
    kept = [path for path in paths if sizes[path] == most_px]
    others = [path.name for path in paths if sizes[path] != most_px]
    shown = ", ".join("x".join(map(str, size)) for size in counts)
    said = (
        f"; pictures are of {len(counts)} sizes ({shown} px), and --parameters are of one: left "
        f"out are {', '.join(others)} (without --parameters each size gets a camera of its own)"
    )
    if len(kept) < fewest:
        raise DatasetError(f"{images}: {len(kept)} pictures are left of {len(paths)}{said}")
    return kept, said


def _check_lens(images: Path, folder: Path, placed: str) -> None:
    """Raise ``DatasetError`` where the lens that was found makes no pinhole picture."""
    try:
        read_dataset(folder, distortion=Distortion.UNDISTORT)
    except DatasetError as error:
        raise DatasetError(
            f"{images}: COLMAP placed {placed} pictures, with a lens that no camera has "
            f"({str(error).rpartition('): ')[2]}); take more pictures that overlap, the camera "
            "turned to the side, or give it: --camera-model PINHOLE --parameters FX FY CX CY"
        ) from error


def _pictures(images: Path, at_least: int) -> Sequence[Path]:
    refuse_video(images)
    try:
        paths = picture_paths(images)
    except DatasetError:
        for path in sorted(images.glob("*")):
            refuse_video(path)
        raise
    if len(paths) < at_least:
        raise DatasetError(f"{images}: holds {len(paths)} pictures, at least {at_least} are needed")
    return paths


def _copied(path: Path, folder: Path, tell: Tell) -> Path:
    """Copy a picture; as PNG where COLMAP would not read it as it is shown.

    What is turned by EXIF is turned here, since COLMAP knows nothing of it.
    """
    header = picture_header(path)
    upright = header.orientation is Orientation.UPRIGHT
    if upright and header.format in PLAIN and not (header.has_alpha or header.treatment):
        return Path(shutil.copyfile(path, folder / path.name))
    target = folder / f"{path.name}.png"
    write_png(target, header.orientation.shown(read_rgb(path)))
    words = header.orientation.words if not upright else f"{header.format}, written as PNG"
    tell(f"{path.name}: {words}")
    return target


def _write(folder: Path, root: Path, names: Sequence[str], solution: PlacedPictures) -> None:
    (folder / "images").mkdir()
    written = []
    for name in names:
        if name in solution.placed:
            camera, pose = solution.placed[name]
            target = f"images/{Path(name).name}"
            (root / name).rename(folder / target)
            written.append(WrittenPicture(target, camera, pose))
    write_transforms(folder, written, solution.points if len(solution.points.xyz_m) else None)


def _summary(out: Path, solution: PlacedPictures) -> str:
    line = f"{out}: {len(solution.placed)} pictures placed, {len(solution.points.xyz_m):,} points"
    if not solution.lost:
        return line
    return f"{line}; not placed: {', '.join(Path(name).name for name in solution.lost)}"


def _focal_lengths(solution: PlacedPictures) -> str:
    cameras = dict.fromkeys(camera.intrinsics for camera, _ in solution.placed.values())
    lengths = named((f"{k.fx_px:.0f} px ({k.width_px}x{k.height_px})" for k in cameras), "none")
    return f"; focal length found: {lengths}"


@dataclass(frozen=True)
class PlacedPictures:
    """Cameras and world_from_cam by name for the pictures that were placed, and the points."""

    placed: Mapping[str, tuple[SourceCamera, Pose]]
    lost: tuple[str, ...]
    points: SourcePoints


def solve_poses(
    root: Path,
    names: Sequence[str],
    known: Sequence[SourcePicture],
    settings: PoseSettings,
    tell: Tell,
) -> PlacedPictures:
    """Place the pictures ``root / name``; with ``known`` pictures, in their world.

    Raises ``DatasetError`` when fewer than two pictures, or none of the new ones, can be placed.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    origin = chosen_origin(known) if known else TileOrigin()
    if known:
        with _told(tell, f"features of the dataset's {len(known)} pictures"):
            add_known(root, known, settings)
    with _told(tell, f"features of {len(names)} new pictures"):
        add_new(root, names, settings)
    with _told(tell, f"matching {len(known) + len(names)} pictures ({settings.matching})"):
        match(root, settings)
    placing = _PlacingProgress(tell, len(known) + len(names))
    if known:
        model = _registered(root, known, origin, settings, placing)
    else:
        model = _alone(root, settings, placing)
    return _solution(model, names, origin)


def _told(tell: Tell, what: str) -> AbstractContextManager[object]:
    """Say what begins and, as long as the block lasts, for how long it has been."""
    tell(what)
    return waiting(what, lambda what, since_s: tell(f"{what}: {since_s:.0f} s so far"))


class _PlacingProgress:
    """Counts the pictures that COLMAP has placed and reports the count."""

    def __init__(self, tell: Tell, total: int) -> None:
        self.tell = tell
        self._total, self._placed = total, 0

    def start_from(self, placed: int) -> None:
        """Take ``placed`` pictures as placed already."""
        self._placed = placed

    def one_more(self) -> None:
        """Take one more picture as placed."""
        self._placed += 1
        self.tell(f"placing pictures: {self._placed} of {self._total}")


def _alone(
    root: Path, settings: PoseSettings, placing: _PlacingProgress
) -> pycolmap.Reconstruction:
    folder = root / "model"
    folder.mkdir()
    options = _options(settings)
    options.ba_refine_focal_length = options.ba_refine_extra_params = not settings.parameters
    options.mapper.init_max_forward_motion = ANY_FORWARD_MOTION
    models: dict[int, pycolmap.Reconstruction] = {}
    for angle_deg in START_ANGLES_DEG:
        options.mapper.init_min_tri_angle = angle_deg
        models = models or cancellable(
            pycolmap.incremental_mapping,
            root / DATABASE,
            root,
            folder,
            options,
            initial_image_pair_callback=lambda: placing.start_from(2),
            next_image_callback=placing.one_more,
        )
    if not models:
        raise DatasetError("no two pictures share enough to start from; take them closer together")
    return max(models.values(), key=lambda model: model.num_reg_images())


def _registered(
    root: Path,
    known: Sequence[SourcePicture],
    origin: TileOrigin,
    settings: PoseSettings,
    placing: _PlacingProgress,
) -> pycolmap.Reconstruction:
    given = _given_poses(root, known, origin)
    held = set(given.cameras)
    options = _options(settings)
    options.fix_existing_frames = True
    options.constant_cameras = held
    if settings.camera == "dataset" or settings.parameters:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    for name in ("given", "model"):
        (root / name).mkdir()
    placing.tell("points of the dataset's pictures at their given poses")
    placing.start_from(len(known))
    cancellable(
        pycolmap.triangulate_points,
        given,
        root / DATABASE,
        root,
        root / "given",
        True,
        options,
        False,
    )
    models = cancellable(
        pycolmap.incremental_mapping,
        root / DATABASE,
        root,
        root / "model",
        options,
        root / "given",
        next_image_callback=placing.one_more,
    )
    if not models:
        raise DatasetError("the dataset's own pictures do not match at their given poses")
    return models[min(models)]


def _given_poses(
    root: Path, known: Sequence[SourcePicture], origin: TileOrigin
) -> pycolmap.Reconstruction:
    """Return the dataset's cameras and poses under the ids the database gave them."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(root / DATABASE) as database:
        cameras, images = database.read_all_cameras(), database.read_all_images()
    poses = {f"known/{i:06d}.png": picture.world_from_cam for i, picture in enumerate(known)}
    given = [image for image in images if image.name in poses]
    used = {image.camera_id for image in given}
    for camera in cameras:
        if camera.camera_id in used:
            model.add_camera_with_trivial_rig(camera)
    for image in given:
        bare = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(bare, rigid_of(origin.localise(poses[image.name])))
    return model


def _options(settings: PoseSettings) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = settings.threads, settings.seed
    return options


def _solution(
    model: pycolmap.Reconstruction, names: Sequence[str], origin: TileOrigin
) -> PlacedPictures:
    placed = {}
    for image in model.images.values():
        if image.has_pose and image.name in names:
            local = pose_from_colmap(image.cam_from_world())
            camera = source_camera(model.cameras[image.camera_id])
            placed[image.name] = (camera, origin.globalise(local))
    if not placed:
        raise DatasetError(f"none of the {len(names)} pictures could be placed; do they overlap?")
    lost = tuple(name for name in names if name not in placed)
    return PlacedPictures(placed, lost, _points(model, origin))


def _points(model: pycolmap.Reconstruction, origin: TileOrigin) -> SourcePoints:
    points = list(model.points3D.values())
    xyz_m = np.array([point.xyz for point in points]).reshape(-1, 3)
    rgb = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    return SourcePoints(xyz_m + np.array(astuple(origin)), rgb)
