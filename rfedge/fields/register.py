"""Find the poses of new pictures in a field whose own pictures are no longer at hand.

The first picture is looked for all over the field: at places of a grid around its middle, in eight
directions; then each picture is looked for from where the last one was found. After three pictures
that were not found in a row the whole field is searched again. Pictures must be taken by a pinhole
camera that is known, in order, no further apart than a step of the grid.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose, Vec3
from rfcore.dataset.picture_file import picture_paths, read_picture
from rfcore.dataset.picture_header import picture_header
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import DatasetError, InvalidInput
from rfcore.field import FULL, RadianceField
from rfcore.files import whole_folder
from rfcore.image import Rgb
from rfcore.localise.estimate import PosePrior
from rfcore.localise.localiser import Localised, Localiser, LocaliserSettings, median_depth
from rfcore.vertical import direction, upright_from
from rfedge.fields.viewpoints import UPS, check_up, looking_at, middle_of, vertical

F64 = NDArray[np.float64]
Tell = Callable[[str], None]

DIRECTIONS = 8
GRID_STEPS = (0.0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75)
"""Places along each horizontal axis, in units of the field's radius, the middle first."""
NEXT_OF_DEPTH, NEXT_DEG = 0.15, 8.0
"""Largest step from one picture to the next: a share of the median depth, and degrees."""
AGAIN_AFTER = 3


@dataclass(frozen=True)
class RegisterSettings:
    """The camera of the pictures; ``up``: a key of ``UPS``, None for the field's own vertical."""

    model: str
    parameters: tuple[float, ...]
    up: str | None = None

    def __post_init__(self) -> None:
        if self.up is not None:
            check_up(self.up)

    def intrinsics(self, size_px: tuple[int, int]) -> Intrinsics:
        """Return the camera of pictures of a size; raise ``InvalidInput`` unless it is known."""
        if self.model == "SIMPLE_PINHOLE" and len(self.parameters) == 3:
            focal_px, cx_px, cy_px = self.parameters
            return Intrinsics(*size_px, focal_px, focal_px, cx_px, cy_px)
        if self.model == "PINHOLE" and len(self.parameters) == 4:
            return Intrinsics(*size_px, *self.parameters)
        raise InvalidInput(
            "camera_model",
            "a field does not say what camera takes the pictures: give --camera-model PINHOLE "
            "--parameters FX FY CX CY; pictures without a lens's distortion",
        )


class FieldRegistration:
    """Finds picture after picture in one field."""

    def __init__(self, field: RadianceField, intrinsics: Intrinsics, up: Vec3, tell: Tell) -> None:
        self._field, self._intrinsics, self._up, self._tell = field, intrinsics, up, tell
        self._near = Localiser(field, intrinsics)
        self._anywhere = Localiser(field, intrinsics, LocaliserSettings(most_hypotheses=1))
        self._last: Pose | None = None
        self._missed = 0

    def find(self, rgb: Rgb) -> Pose | None:
        """Return the pose of the camera that took uint8 [H, W, 3], None if it is not found."""
        found = None if self._last is None else self._near_last(rgb, self._last)
        if found is None:
            self._missed += 1
            if self._last is None or self._missed >= AGAIN_AFTER:
                found = self._search_all(rgb)
                self._missed = 0
        if found is not None:
            self._last, self._missed = found, 0
        return found

    def _near_last(self, rgb: Rgb, last: Pose) -> Pose | None:
        depth_m = median_depth(self._field.render(Camera(self._intrinsics, last), FULL))
        reach_m = NEXT_OF_DEPTH * depth_m or 1.0
        answer = self._near.localise(rgb, PosePrior(last, reach_m, NEXT_DEG))
        return answer.world_from_cam if isinstance(answer, Localised) else None

    def _search_all(self, rgb: Rgb) -> Pose | None:
        places = list(_grid(self._field, self._up))
        for number, (pose, step_m) in enumerate(places, 1):
            self._tell(f"searching the whole field: {number} of {len(places)} views")
            prior = PosePrior(pose, step_m, 180.0 / DIRECTIONS)
            answer = self._anywhere.localise(rgb, prior)
            if isinstance(answer, Localised):
                return answer.world_from_cam
        self._tell(f"not found in the whole field, where {direction(self._up)} is up (--up)")
        return None


def _grid(field: RadianceField, up: Vec3) -> Iterator[tuple[Pose, float]]:
    """Yield poses all over a field, its middle first, and the distance between them, m."""
    middle, radius_m = middle_of(field)
    east, north, _ = np.array(upright_from(up).rotation_matrix())
    places = [(a, b) for a in GRID_STEPS for b in GRID_STEPS]
    for a, b in sorted(places, key=lambda place: math.hypot(*place)):
        eye = middle + radius_m * (a * east + b * north)
        for step in range(DIRECTIONS):
            turn = 2 * math.pi * step / DIRECTIONS
            way = math.cos(turn) * east + math.sin(turn) * north
            yield looking_at(eye, eye + way, np.array(up)), 0.25 * radius_m


def register_pictures(
    images: Path, out: Path, field: RadianceField, settings: RegisterSettings, tell: Tell
) -> str:
    """Write ``out`` with the pictures found in the field's world; return one line about it.

    Raises ``DatasetError`` where there are no pictures or none is found, ``InvalidInput`` for a
    camera that is not known or an ``out`` that exists.
    """
    paths = picture_paths(images)
    intrinsics = settings.intrinsics(picture_header(paths[0]).size_px)
    up = vertical(field, settings.up)
    registration = FieldRegistration(field, intrinsics, up, tell)
    written: list[WrittenPicture] = []
    with whole_folder(out) as folder:
        (folder / "images").mkdir()
        for number, path in enumerate(paths, 1):
            tell(f"placing pictures: {number} of {len(paths)}, {len(written)} found")
            pose = registration.find(read_picture(path, intrinsics))
            if pose is not None:
                shutil.copyfile(path, folder / "images" / path.name)
                world = field.metadata.tile_origin.globalise(pose)
                camera = SourceCamera(intrinsics)
                written.append(WrittenPicture(f"images/{path.name}", camera, world))
        if not written:
            raise DatasetError(
                f"none of the {len(paths)} pictures was found in the field, where {direction(up)} "
                f"is up; if another axis is (--up {' or '.join(UPS)}), say so"
            )
        write_transforms(folder, written, None, None)
    return _summary(out, paths, written)


def _summary(out: Path, paths: Sequence[Path], written: Sequence[WrittenPicture]) -> str:
    line = f"{out}: {len(written)} of {len(paths)} pictures placed in the field"
    found = {Path(picture.file_path).name for picture in written}
    lost = [path.name for path in paths if path.name not in found]
    return f"{line}; not placed: {', '.join(lost)}" if lost else line
