"""Picture files of a dataset: how large they are, and which of their pixels count.

A picture is read as it is stored or, where only that fits its camera, turned as its EXIF
orientation says: COLMAP, instant-ngp and nerfstudio know nothing of EXIF. Where pictures are copies
of another size (``images_4``), the camera is scaled to them. A picture's mask is the file that
the dataset names, or one beside the pictures: ``masks/NAME.png``, ``masks/STEM.png`` or
``masks/STEM_mask.png`` next to the folder ``images`` (COLMAP, gsplat, LichtFeld Studio, Metashape),
``NAME.mask.png``, ``STEM.mask.png`` or ``STEM_mask.png`` in the picture's folder (RealityScan,
OpenDroneMap), or instant-ngp's ``dynamic_mask_STEM.png``.
A mask of another size and the same shape is scaled. White is learnt and measured, black is not, but
for instant-ngp's masks, which are white where something moves. A transparent pixel is not learnt
either.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Container
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import MAX_SIDE_PX, Intrinsics, Pose
from rfcore.dataset.colour_profile import OTHER_PROFILE, PRIMARIES
from rfcore.dataset.orientation import Orientation
from rfcore.dataset.picture_header import (
    UNREAD,
    jpeg_segments,
    picture_format,
    picture_header,
    remedy,
)
from rfcore.dataset.picture_name import SUFFIXES, differs_in_case
from rfcore.dataset.source import SourceCamera, SourcePicture
from rfcore.errors import DatasetError
from rfcore.image import Rgb, read_frame, read_pixels
from rfcore.pixels import Pixels, pixels_of
from rfcore.views import Mask

MASK_FOLDERS, MASK_SUFFIXES = ("masks", "mask", "Masks"), (*SUFFIXES, ".tif", ".tiff")
LEAST_SCALE = 1.1
"""Sizes that are closer to each other are of a picture that was cropped, not scaled."""
JPEG_SCAN = 0xDA
JPEG_END = b"\xff\xd9"


def posed_picture(
    where: str,
    name: str,
    path: Path,
    camera: SourceCamera,
    world_from_cam: Pose,
    *,
    time_ns: int | None = None,
    mask: MaskFile | None = None,
) -> SourcePicture:
    """Return the picture that a dataset calls ``name``; its camera is scaled to the file's size.

    Raises ``DatasetError`` for a size of another shape than the camera's.
    """
    opened = PictureFile.of(path, camera.intrinsics, mask, may_scale=True)
    renamed = ("are found under names in other upper and lower case",)
    return SourcePicture(
        where=where,
        name=name.replace("\\", "/"),
        camera=replace(camera, intrinsics=opened.intrinsics),
        world_from_cam=world_from_cam,
        read=opened.read,
        time_ns=time_ns,
        mask=opened.mask,
        notes=opened.notes + (renamed if differs_in_case(path, name) else ()),
    )


def read_picture(path: Path, intrinsics: Intrinsics) -> Rgb:
    """Read a picture; raise ``DatasetError`` when its size is not the camera's."""
    return PictureFile.of(path, intrinsics).read()


@dataclass(frozen=True)
class PictureFile:
    """A picture file and its camera's intrinsics; pixels are read on demand.

    ``notes`` says what reading does to it, for "N pictures ...".
    """

    path: Path
    intrinsics: Intrinsics
    orientation: Orientation
    has_alpha: bool
    primaries: int | None
    mask_file: MaskFile | None
    notes: tuple[str, ...]

    @staticmethod
    def of(
        path: Path,
        intrinsics: Intrinsics,
        mask: MaskFile | None = None,
        *,
        may_scale: bool = False,
    ) -> PictureFile:
        """Open a picture; raise ``DatasetError`` when its header states another size.

        ``may_scale``: it may be a copy of another size, to which the intrinsics are scaled.
        """
        header = picture_header(path)
        wanted_px = (intrinsics.width_px, intrinsics.height_px)
        notes, orientation = [], Orientation.UPRIGHT
        shown_px = header.orientation.size(header.size_px)
        if may_scale and wanted_px not in (header.size_px, shown_px):
            fits = (size for size in (header.size_px, shown_px) if _is_scaled(size, wanted_px))
            if (size_px := next(fits, None)) is not None:
                (width, height), (before, above) = size_px, wanted_px
                notes.append(f"are {width}x{height} px: their camera of {before}x{above} is scaled")
                intrinsics, wanted_px = intrinsics.resized(width, height), size_px
        is_turned = header.orientation is not Orientation.UPRIGHT
        if is_turned and header.size_px != wanted_px == shown_px:
            orientation = header.orientation
            notes.append(f"are {orientation.words}, as EXIF says and their camera's size")
        else:
            require_size(path, header.size_px, intrinsics)
            if is_turned:
                notes.append(
                    f"are not {header.orientation.words}, though EXIF says so: their camera is of "
                    "the picture as stored"
                )
        if header.treatment is not None:
            notes.append(f"are {header.treatment} and become sRGB")
        if header.profile == OTHER_PROFILE:
            notes.append("have a colour profile that is not read: they are taken as sRGB")
        if header.has_alpha:
            notes.append(
                "have an alpha channel: they are composed over black, and what is transparent is "
                "not learnt or measured"
            )
        mask = mask or mask_beside(path)
        if mask is not None:
            scaled = " of another size, which is scaled" * mask.is_scaled(wanted_px)
            notes.append(f"have a mask{scaled}: what it hides is not learnt or measured")
        primaries = PRIMARIES.get(header.profile or "")
        return PictureFile(
            path, intrinsics, orientation, header.has_alpha, primaries, mask, tuple(notes)
        )

    @property
    def mask(self) -> Callable[[], Mask] | None:
        """Reader of which pixels count, ``None`` for all of them."""
        return self._mask if self.has_alpha or self.mask_file is not None else None

    def read(self) -> Rgb:
        """Read the pixels; raise ``DatasetError`` when their size is not the camera's."""
        return self.orientation.shown(self._pixels().rgb)

    def _pixels(self) -> Pixels:
        PictureFile.of(self.path, self.intrinsics, self.mask_file)  # it may have been replaced
        _require_length(self.path, self.intrinsics)
        _require_whole_jpeg(self.path)
        pixels = read_pixels(self.path, primaries=self.primaries)
        height, width, _ = pixels.rgb.shape
        require_size(self.path, self.orientation.size((width, height)), self.intrinsics)
        return pixels

    def _mask(self) -> Mask:
        k = self.intrinsics
        counted = np.ones((k.height_px, k.width_px), bool)
        if self.has_alpha and (opaque := self._pixels().opaque) is not None:
            counted &= self.orientation.shown(opaque)
        if self.mask_file is not None:
            counted &= self.mask_file.read(self)
        return counted


@dataclass(frozen=True)
class MaskFile:
    """A mask's file; ``hides_white`` is instant-ngp's convention, the other hides black."""

    path: Path
    hides_white: bool = False

    def read(self, picture: PictureFile) -> Mask:
        """Return which pixels count, bool [H, W]; raise ``DatasetError`` for another shape.

        White is what is brighter than half of the brightest: some masks have 0 and 1.
        """
        width, height = picture_header(self.path).size_px
        _require_length(self.path, replace(picture.intrinsics, width_px=width, height_px=height))
        values = self._values()
        is_white = np.asarray(values > values.max() / 2)
        size_px = (picture.intrinsics.width_px, picture.intrinsics.height_px)
        for turned in (is_white, picture.orientation.shown(is_white)):
            height, width = turned.shape
            if (width, height) == size_px:
                return np.asarray(turned != self.hides_white)
            if _is_scaled((width, height), size_px):
                return np.asarray(_nearest(turned, size_px) != self.hides_white)
        raise DatasetError(
            f"{self.path}: mask is {values.shape[1]}x{values.shape[0]} px, its picture "
            f"{size_px[0]}x{size_px[1]}; scale it to that size"
        )

    def is_scaled(self, size_px: tuple[int, int]) -> bool:
        """Return whether the mask is of another size than its picture, but of the same shape."""
        mask_px = picture_header(self.path).size_px
        return _is_scaled(mask_px, size_px) or _is_scaled(mask_px[::-1], size_px)

    def _values(self) -> NDArray[np.integer[Any]]:
        """Return the brightness [H, W]: of 16 bits as they are, of one colour its alpha."""
        frame = read_frame(self.path)
        if frame.format.name in ("gray16be", "gray16le"):
            return np.asarray(frame.to_ndarray())
        pixels = pixels_of(frame, str(self.path))
        values = np.asarray(pixels.rgb.max(axis=2))
        if pixels.opaque is not None and values.min() == values.max():
            return pixels.opaque.astype(np.uint8)
        return values


def mask_beside(path: Path) -> MaskFile | None:
    """Return the mask that lies beside a picture, ``None`` without one."""
    moving = path.with_name(f"dynamic_mask_{path.stem}.png")
    if moving.is_file():
        return MaskFile(moving, hides_white=True)
    if path.parent.name in MASK_FOLDERS:
        return None
    beside = (f"{path.name}.mask.png", f"{path.stem}.mask.png", f"{path.stem}_mask.png")
    for name in beside:
        if (path.parent / name).is_file():
            return MaskFile(path.parent / name)
    stems = (path.name, path.stem, f"{path.stem}_mask")
    for folder, masks_name in product(path.parents[:3], MASK_FOLDERS):
        masks = folder.parent / masks_name / path.parent.relative_to(folder)
        for stem, suffix in product(stems, MASK_SUFFIXES if masks.is_dir() else ()):
            if (masks / f"{stem}{suffix}").is_file():
                return MaskFile(masks / f"{stem}{suffix}")
    return None


def _is_mask(path: Path, names: Container[str]) -> bool:
    """Return whether a file of a folder is the mask of another one of the same folder."""
    if path.name.startswith("dynamic_mask_"):
        return True
    stem = path.stem.removesuffix(".mask").removesuffix("_mask")
    return stem != path.stem and (stem in names or any(stem + s in names for s in SUFFIXES))


def picture_paths(folder: Path) -> list[Path]:
    """Return the pictures of a folder, told by their content, in the order of their names.

    Raises ``DatasetError`` for formats that are not read, but where ``NAME.png`` is the converted
    copy, and without any.
    """
    if folder.is_file():
        raise DatasetError(f"{folder}: is neither a folder of pictures nor a video that is read")
    files = sorted(path for path in folder.glob("*") if path.is_file())
    formats = {path: picture_format(path) for path in files}
    names = {path.name for path in files}
    paths = [path for path in files if formats[path] and not _is_mask(path, names)]
    if not paths:
        raise DatasetError(f"{folder}: holds no pictures (PNG, JPEG, WebP, TIFF, OpenEXR, ...)")
    paths = [p for p in paths if formats[p] not in UNREAD or f"{p.name}.png" not in names]
    unread = [path for path in paths if formats[path] in UNREAD]
    if unread:
        found, pattern = str(formats[unread[0]]), f"{shlex.quote(str(folder))}/*{unread[0].suffix}"
        raise DatasetError(
            f"{folder}: {len(unread)} of {len(paths)} pictures are {found}, which is not read; "
            f"{remedy(found, pattern)}"
        )
    return paths


def _nearest(mask: Mask, size_px: tuple[int, int]) -> Mask:
    """Return a mask of another size: of each pixel's middle, the pixel that holds it."""
    rows, columns = (
        (np.arange(count) * 2 + 1) * side // (2 * count)
        for count, side in zip(size_px[::-1], mask.shape, strict=True)
    )
    return np.asarray(mask[rows[:, None], columns])


def _is_scaled(size_px: tuple[int, int], from_px: tuple[int, int]) -> bool:
    """Return whether a picture may be a copy, larger or smaller, of one of another size: its sides
    are the other's times one factor, each rounded somehow."""
    (width, height), (from_width, from_height) = size_px, from_px
    longest = max(*size_px, *from_px)
    is_off = abs(width * from_height - height * from_width) >= longest
    least, most = sorted((min(size_px), min(from_px)))
    return not is_off and most >= LEAST_SCALE * least and longest <= MAX_SIDE_PX


def require_size(where: Path | str, size_px: tuple[int, int], intrinsics: Intrinsics) -> None:
    """Raise ``DatasetError`` for a picture larger than any may be, or not of its camera's size."""
    if max(size_px) > MAX_SIDE_PX:
        raise DatasetError(
            f"{where}: picture is {size_px[0]}x{size_px[1]} px, over the limit of {MAX_SIDE_PX} px"
        )
    if size_px != (intrinsics.width_px, intrinsics.height_px):
        raise DatasetError(
            f"{where}: picture is {size_px[0]}x{size_px[1]} px, its camera says "
            f"{intrinsics.width_px}x{intrinsics.height_px}; take pictures or a camera of one size"
        )


LONGEST_PIXEL_BYTES, LONGEST_HEADER_BYTES = 8, 1 << 20
"""Four channels of 16 bits, stored; and metadata beside them."""


def _require_length(path: Path, intrinsics: Intrinsics) -> None:
    """FFmpeg, as the search for the end of a JPEG, reads the whole file at once."""
    pixels = intrinsics.width_px * intrinsics.height_px
    most_bytes, length_bytes = (
        pixels * LONGEST_PIXEL_BYTES + LONGEST_HEADER_BYTES,
        path.stat().st_size,
    )
    if length_bytes > most_bytes:
        raise DatasetError(
            f"{path}: {length_bytes} bytes are too many for {intrinsics.width_px}x"
            f"{intrinsics.height_px} px, at most {most_bytes}; save the picture anew"
        )


def _require_whole_jpeg(path: Path) -> None:
    with path.open("rb") as file:
        if not is_whole_jpeg(file):
            raise DatasetError(f"{path}: truncated, the JPEG has no end marker")


def is_whole_jpeg(file: BinaryIO) -> bool:
    """Return whether a file, from its start on, is no JPEG or one with an end.

    FFmpeg fills what is missing of a JPEG with grey and reports nothing. In a scan 0xFF is followed
    by 0 or a restart marker only, so that an end marker is one.
    """
    if file.read(2) != b"\xff\xd8":
        return True
    return JPEG_SCAN in jpeg_segments(file) and JPEG_END in file.read()
