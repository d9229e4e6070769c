"""Features and matches of all pictures, in a COLMAP database.

Pictures lie under one root: those of the dataset in ``known``, as PNG, the new ones in ``new``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rfcore.dataset.picture_file import picture_size_px
from rfcore.dataset.source import SourceCamera, SourcePicture
from rfcore.errors import DatasetError
from rfcore.image import write_png
from rfedge.poses.cameras import camera_parameters
from rfedge.poses.settings import Matching, PoseSettings, SharedCamera

__all__ = ["Workplace", "add_known", "add_new", "match"]


@dataclass(frozen=True)
class Workplace:
    """A folder with the pictures and the database."""

    root: Path

    @property
    def database(self) -> Path:
        """COLMAP's SQLite file."""
        return self.root / "database.db"


def add_known(place: Workplace, known: Sequence[SourcePicture], settings: PoseSettings) -> None:
    """Add a dataset's pictures with their own cameras, as ``known/000000.png`` and so on."""
    (place.root / "known").mkdir()
    groups: dict[SourceCamera, list[str]] = {}
    for i, picture in enumerate(known):
        name = f"known/{i:06d}.png"
        write_png(place.root / name, picture.read())
        groups.setdefault(picture.camera, []).append(name)
    for camera, names in groups.items():
        options = pycolmap.ImageReaderOptions()
        options.camera_model, parameters = camera_parameters(camera)
        options.camera_params = ",".join(repr(float(value)) for value in parameters)
        _extract(place, names, options, settings)


def add_new(place: Workplace, names: Sequence[str], settings: PoseSettings) -> None:
    """Add the new pictures: with the dataset's camera, or with one that is to be estimated."""
    options = pycolmap.ImageReaderOptions()
    options.camera_model = settings.model
    options.camera_params = ",".join(map(repr, settings.parameters))
    with pycolmap.Database.open(place.database) as database:
        cameras = database.read_all_cameras()
    if cameras and settings.camera is SharedCamera.DATASET:
        options.existing_camera_id = _shared_camera(place, names, cameras)
    _extract(place, names, options, settings)


def match(place: Workplace, settings: PoseSettings) -> None:
    """Match features and keep what two-view geometry confirms."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, settings.threads
    pycolmap.set_random_seed(settings.seed)
    if settings.matching is Matching.SEQUENTIAL:
        pycolmap.match_sequential(place.database, options, device=pycolmap.Device.cpu)
    else:
        pycolmap.match_exhaustive(place.database, options, device=pycolmap.Device.cpu)


def _shared_camera(
    place: Workplace, names: Sequence[str], cameras: Sequence[pycolmap.Camera]
) -> int:
    if len(cameras) > 1:
        raise DatasetError(
            f"the dataset has {len(cameras)} cameras; choose --camera estimate for new pictures"
        )
    size_px = (cameras[0].width, cameras[0].height)
    for name in names:
        found = picture_size_px(place.root / name)
        if found != size_px:
            raise DatasetError(
                f"{Path(name).name}: {found} px is not the {size_px} px of the dataset's camera; "
                "choose --camera estimate"
            )
    return int(cameras[0].camera_id)


def _extract(
    place: Workplace,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    settings: PoseSettings,
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, settings.threads
    options.max_image_size = settings.max_side_px
    options.sift.max_num_features = settings.features
    pycolmap.extract_features(
        place.database,
        place.root,
        list(names),
        pycolmap.CameraMode.SINGLE,
        reader,
        options,
        pycolmap.Device.cpu,
    )
