"""Find and match the features of all pictures, in a COLMAP database.

Pictures lie under one root: those of the dataset in ``known``, as PNG, the new ones in ``new``.
COLMAP's cameras and poses have the same axes and pixel centres as ours; its poses are
cam_from_world, its quaternions x, y, z, w.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from rfcore.camera import Pose
from rfcore.dataset.colmap import camera_of, camera_parameters, parameter_count
from rfcore.dataset.keys import READ_MODELS, lens_model
from rfcore.dataset.picture_header import picture_header
from rfcore.dataset.source import SourceCamera, SourcePicture
from rfcore.errors import DatasetError, InvalidInput
from rfcore.extras import needs
from rfcore.image import write_png

with needs("colmap"):
    import pycolmap

T = TypeVar("T")

DATABASE = "database.db"
"""COLMAP's SQLite file, in the folder of the pictures."""


@dataclass(frozen=True)
class PoseSettings:
    """Options of structure from motion."""

    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    """Match all pairs of pictures, or neighbours only."""
    camera: Literal["dataset", "estimate"] = "dataset"
    """Take the intrinsics of new pictures from the dataset to register to, or estimate them."""
    model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the camera model of new pictures."""
    parameters: tuple[float, ...] = ()
    """Its parameters in COLMAP's order, which are then held; they are estimated if it is empty."""
    max_side_px: int = 1600
    """Pictures are reduced to this longest side to find features."""
    features: int = 8192
    """Most features of a picture."""
    threads: int = 2
    seed: int = 1
    """Seed of RANSAC."""

    def __post_init__(self) -> None:
        needed = parameter_count("model", self.model)
        if not lens_model("model", self.model).is_read:
            raise DatasetError(f"model: camera model {self.model} is none of {READ_MODELS}")
        if self.parameters and len(self.parameters) != needed:
            raise InvalidInput(
                "parameters", f"{self.model} has {needed}, not {len(self.parameters)}"
            )
        for name in ("max_side_px", "features", "threads"):
            if getattr(self, name) < 1:
                raise InvalidInput(name, f"{getattr(self, name)} must be at least 1")


def source_camera(camera: pycolmap.Camera) -> SourceCamera:
    """Return a camera that COLMAP estimated."""
    size_px = (camera.width, camera.height)
    return camera_of("estimated camera", camera.model.name, size_px, list(camera.params))


def rigid_of(world_from_cam: Pose) -> pycolmap.Rigid3d:
    """Return COLMAP's cam_from_world."""
    pose = world_from_cam.inverse()
    w, x, y, z = pose.rotation
    rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
    return pycolmap.Rigid3d(rotation, np.array(pose.translation_m))


def pose_from_colmap(cam_from_world: pycolmap.Rigid3d) -> Pose:
    """Return world_from_cam."""
    return Pose.from_matrix(cam_from_world.matrix().tolist()).inverse()


def add_known(root: Path, known: Sequence[SourcePicture], settings: PoseSettings) -> None:
    """Add a dataset's pictures with their own cameras, as ``known/000000.png`` and so on."""
    (root / "known").mkdir()
    groups: dict[SourceCamera, list[str]] = {}
    for i, picture in enumerate(known):
        name = f"known/{i:06d}.png"
        write_png(root / name, picture.read())
        groups.setdefault(picture.camera, []).append(name)
    for camera, names in groups.items():
        options = pycolmap.ImageReaderOptions()
        options.camera_model, parameters = camera_parameters(camera)
        options.camera_params = ",".join(repr(float(value)) for value in parameters)
        _extract(root, names, options, settings)


def add_new(root: Path, names: Sequence[str], settings: PoseSettings) -> None:
    """Add the new pictures: with the dataset's camera, or one to be estimated for each size."""
    options = pycolmap.ImageReaderOptions()
    options.camera_model = settings.model
    options.camera_params = ",".join(map(repr, settings.parameters))
    with pycolmap.Database.open(root / DATABASE) as database:
        cameras = database.read_all_cameras()
    if cameras and settings.camera == "dataset":
        options.existing_camera_id = _shared_camera(root, names, cameras)
    groups: dict[tuple[int, int], list[str]] = {}
    for name in names:
        groups.setdefault(picture_header(root / name).size_px, []).append(name)
    for group in groups.values():
        _extract(root, group, options, settings)


def match(root: Path, settings: PoseSettings) -> None:
    """Match features and keep what two-view geometry confirms."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, settings.threads
    sequential = settings.matching == "sequential"

    def seeded(*arguments: Any, **named: Any) -> None:
        pycolmap.set_random_seed(settings.seed)  # of the thread that matches
        run = pycolmap.match_sequential if sequential else pycolmap.match_exhaustive
        run(*arguments, **named)

    cancellable(seeded, root / DATABASE, options, device=pycolmap.Device.cpu)


def cancellable(call: Callable[..., T], *arguments: Any, **named: Any) -> T:
    """Return what a long call of COLMAP returns; a signal's exception ends it at once.

    COLMAP does not look for signals, so it runs in a thread of its own and is told to stop when
    the waiting main thread is interrupted.
    """
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as worker:
        result = worker.submit(call, *arguments, **named, cancellation_token=token)
        try:
            return result.result()
        except BaseException:
            token.cancel()
            raise


def _shared_camera(root: Path, names: Sequence[str], cameras: Sequence[pycolmap.Camera]) -> int:
    if len(cameras) > 1:
        raise DatasetError(
            f"the dataset has {len(cameras)} cameras; choose --camera estimate for new pictures"
        )
    size_px = (cameras[0].width, cameras[0].height)
    for name in names:
        found = picture_header(root / name).size_px
        if found != size_px:
            raise DatasetError(
                f"{Path(name).name}: {found} px is not the {size_px} px of the dataset's camera; "
                "choose --camera estimate"
            )
    return int(cameras[0].camera_id)


def _extract(
    root: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    settings: PoseSettings,
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, settings.threads
    options.max_image_size = settings.max_side_px
    options.sift.max_num_features = settings.features
    cancellable(
        pycolmap.extract_features,
        root / DATABASE,
        root,
        list(names),
        pycolmap.CameraMode.SINGLE,
        reader,
        options,
        pycolmap.Device.cpu,
    )
