"""Posed pictures from a COLMAP model and the folder ``images`` it was made from.

The model lies in ``sparse/0``, ``sparse`` or the folder itself, in text or binary form (binary goes
first, as in COLMAP). Pictures come out in the order of their names.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rfcore.dataset.colmap_binary import read_binary_model
from rfcore.dataset.colmap_model import ColmapImage, ColmapModel
from rfcore.dataset.colmap_text import read_text_model
from rfcore.dataset.picture_file import check_size, find_picture, read_picture
from rfcore.dataset.source import Source, SourcePicture
from rfcore.errors import DatasetError

__all__ = ["colmap_model_folder", "read_colmap_source"]


def colmap_model_folder(folder: Path) -> Path | None:
    """Return where a dataset's model lies, ``None`` without one."""
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder):
        if any((candidate / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return candidate
    return None


def read_colmap_source(model_folder: Path) -> Source:
    """Read a model and find its pictures. Raises ``DatasetError`` naming the file."""
    binary = (model_folder / "images.bin").is_file()
    model = read_binary_model(model_folder) if binary else read_text_model(model_folder)
    images_folder = _images_folder(model_folder)
    ordered = sorted(model.images, key=lambda image: image.name)
    return Source(
        file=model_folder / ("images.bin" if binary else "images.txt"),
        pictures=tuple(_picture(model, images_folder, image) for image in ordered),
        points=model.points,
    )


def _images_folder(model_folder: Path) -> Path:
    above = (model_folder, *model_folder.absolute().parents[:2])
    for candidate in (folder / "images" for folder in above):
        if candidate.is_dir():
            return candidate
    raise DatasetError(f"{model_folder}: no folder 'images' beside the model or two levels above")


def _picture(model: ColmapModel, folder: Path, image: ColmapImage) -> SourcePicture:
    camera = model.cameras.get(image.camera_id)
    if camera is None:
        raise DatasetError(f"{image.where}: camera {image.camera_id} is not in the model")
    path = find_picture(image.where, folder, image.name)
    check_size(path, camera.intrinsics)
    return SourcePicture(
        where=image.where,
        name=image.name,
        camera=camera,
        world_from_cam=image.cam_from_world.inverse(),
        read=partial(read_picture, path, camera.intrinsics),
    )
