"""The interface of every kind of radiance field.

A field is immutable, may be shared between threads, and is identified by the SHA-256 of its
archive. The same field, camera and quality give the same bytes on every machine.

A field's metadata is in the JSON header of its archive, which can be read without its arrays.
``bounds`` is stored beside the values of ``FieldMetadata``; ``kind`` is the archive's own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose, TileOrigin, Vec3
from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive
from rfcore.field.quality import FULL, Quality
from rfcore.geodesy import Anchor, anchor_of_values, anchor_values
from rfcore.native.yuv import field_view_from_view
from rfcore.raster.gaussians import sky_of
from rfcore.vertical import MOST_SIGHTS, Z_UP, Sight, check_direction
from rfcore.views import FieldView, View

SPLATS = "splats"
"""3D Gaussian Splatting (Kerbl et al. 2023)."""
NGP = "ngp"
"""Multiresolution hash grid with a small network (Mueller et al. 2022)."""
KINDS = (SPLATS, NGP)
LATER_KEYS = ("anchor", "up", "sights", "focal_px")
"""Keys of a header that are left out where nothing is known."""
LAYER, DELTA = "layer", "delta"
"""Archives that need the splats of their base: ``rfcore.field.layer`` and
``rfcore.field.delta``."""


@dataclass(frozen=True)
class Bounds:
    """An axis-aligned box, lowest and highest corner in metres, relative to the tile's origin."""

    low_m: Vec3
    high_m: Vec3

    def __post_init__(self) -> None:
        corners = (self.low_m, self.high_m)
        if any(len(c) != 3 or not all(map(math.isfinite, c)) for c in corners):
            raise InvalidInput("bounds", f"{corners} must be two corners of three finite metres")
        if any(low > high for low, high in zip(*corners, strict=True)):
            raise InvalidInput("bounds", f"{corners}: the lowest corner is not the lowest")

    @staticmethod
    def around(points_m: NDArray[np.float32]) -> Bounds:
        """Return the box around the ``points_m`` [N, 3] that are not sky; the origin if there are
        none."""
        points_m = points_m[~sky_of(points_m)]
        if not len(points_m):
            return Bounds((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        low, high = points_m.min(axis=0).tolist(), points_m.max(axis=0).tolist()
        return Bounds((low[0], low[1], low[2]), (high[0], high[1], high[2]))


@dataclass(frozen=True)
class FieldMetadata:
    """Facts about a field besides its parameters.

    ``training_digest`` is the digest of the pictures, points and settings it was trained with,
    empty for an imported field. ``held_out_psnr_db`` and ``held_out_ssim`` are means over pictures
    it was not trained on, ``None`` if they were not measured. ``antialiased``: the splats were
    trained to be drawn with an opacity that compensates the screen-space blur. ``anchor``: where on
    the Earth the field's axes are, ``None`` if that was not stated. ``up``: the vertical as the
    training cameras show it, ``None`` if they were not asked or do not agree; ``sights``: where
    some of them stood; ``focal_px``: the median focal length of the training pictures, ``None`` if
    it is not known.
    """

    name: str = ""
    tile_origin: TileOrigin = field(default_factory=TileOrigin)
    training_digest: str = ""
    held_out_psnr_db: float | None = None
    held_out_ssim: float | None = None
    antialiased: bool = False
    kind: str = SPLATS
    anchor: Anchor | None = None
    up: Vec3 | None = None
    sights: tuple[Sight, ...] = ()
    focal_px: float | None = None

    def __post_init__(self) -> None:
        if self.focal_px is not None and not 0 < self.focal_px < math.inf:
            raise InvalidInput("field.focal_px", f"{self.focal_px} must be positive and finite")
        if self.up is not None:
            check_direction("field.up", self.up)
        if len(self.sights) > MOST_SIGHTS:
            raise InvalidInput("field.sights", f"{len(self.sights)} are more than {MOST_SIGHTS}")
        if self.kind not in KINDS:
            raise InvalidInput("field.kind", f"'{self.kind}' is none of {', '.join(KINDS)}")
        if self.antialiased and self.kind != SPLATS:
            raise InvalidInput("field.antialiased", f"is a property of {SPLATS}, not {self.kind}")
        db, ssim = self.held_out_psnr_db, self.held_out_ssim
        if db is not None and not math.isfinite(db):
            raise InvalidInput("field.held_out_psnr_db", f"{db} must be finite or not given")
        if ssim is not None and not -1 <= ssim <= 1:
            raise InvalidInput("field.held_out_ssim", f"{ssim} is outside -1..1")

    @property
    def states_up(self) -> bool:
        """Whether the vertical is known, rather than taken to be z."""
        return self.up is not None or self.anchor is not None

    @property
    def vertical(self) -> Vec3:
        """Up in the field's axes: as the anchor states, else ``up``, else z."""
        if self.anchor is not None:
            return Pose((0.0, 0.0, 0.0), self.anchor.enu_from_world).inverse().apply(Z_UP)
        return self.up or Z_UP


class Renderer(Protocol):
    """The part of a radiance field that the codec needs."""

    def render(self, camera: Camera, quality: Quality) -> View:
        """Return colour, depth and opacity as ``camera`` sees them."""


@runtime_checkable
class CodecPictureRenderer(Protocol):
    """A renderer that makes the codec's picture itself, faster than from the colours."""

    @property
    def is_on_device(self) -> bool:
        """True if a device renders. Depth and opacity of a ``field_view`` stay there until somebody
        asks for them; the colours are never copied."""

    def field_view(self, camera: Camera, quality: Quality) -> FieldView:
        """Render, and return what ``field_view_from_view`` would make of it."""


class RadianceField(Protocol):
    """A radiance field that renders, with its metadata."""

    @property
    def metadata(self) -> FieldMetadata:
        """Facts about the field besides its parameters."""

    @property
    def field_id(self) -> str:
        """SHA-256 of the field's archive, in hex."""

    @property
    def bounds(self) -> Bounds:
        """The box that the field was made for; it may show things beyond it."""

    @property
    def primitives(self) -> int:
        """The number of Gaussians, or of trained numbers of a hash grid."""

    @property
    def isa(self) -> str:
        """The instruction set it renders with, which changes the time of a picture but no byte."""

    @property
    def most_detail(self) -> float:
        """The highest ``Quality.detail`` that can be drawn: 1, unless only a part of the archive
        was loaded."""

    def prepare(self, quality: Quality = FULL) -> None:
        """Prepare rendering at ``quality``, so that the first picture is not slow."""

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Render colour, depth and opacity as ``camera`` sees them."""

    def render_colour(self, camera: Camera, quality: Quality = FULL) -> NDArray[np.float32]:
        """Render only colour, float32 [H, W, 3]: the same bytes as ``render``, faster."""

    def archive(self) -> Archive:
        """Return the content of the field's file."""

    def with_threads(self, threads: int) -> RadianceField:
        """Return the same field with a renderer of its own and so many threads. The parameters are
        shared; neither renderer waits for the other."""


def render_field_view(renderer: Renderer, camera: Camera, quality: Quality = FULL) -> FieldView:
    """Render what ``camera`` sees, in the form that both ends of the codec use.

    A sender passes the camera that it sends: ``Camera.rounded``.

    >>> from pathlib import Path
    >>> from rfcore.camera import Intrinsics, Pose
    >>> from rfcore.field import load_field
    >>> field = load_field(Path("samples/fields/street.rff"), threads=2)
    >>> camera = Camera(Intrinsics(64, 36, 50.0, 50.0, 32.0, 18.0), Pose.identity())
    >>> view = render_field_view(field, camera.rounded(), Quality(detail=0.25))
    >>> view.render.size_px
    (64, 36)
    """
    quicker = codec_renderer(renderer)
    if quicker is not None:
        return quicker.field_view(camera, quality)
    return field_view_from_view(renderer.render(camera, quality), camera)


def codec_renderer(renderer: Renderer) -> CodecPictureRenderer | None:
    """Return the renderer if its class has a way of its own to the codec's picture.

    A proxy that changes ``render`` and forwards the rest has none: it must not be passed by.
    """
    has_field_view = hasattr(type(renderer), "field_view")
    return renderer if has_field_view and isinstance(renderer, CodecPictureRenderer) else None


def base_of(archive: Archive) -> str | None:
    """Return the id of the field that an archive is a layer or a delta of, if it is one."""
    return str(archive.metadata["base"]) if archive.kind in (LAYER, DELTA) else None


def stored_metadata(metadata: FieldMetadata, bounds: Bounds) -> dict[str, Any]:
    """Return a field's metadata as its header stores it."""
    values = asdict(metadata)
    for key in ("kind", *LATER_KEYS):
        del values[key]
    if metadata.anchor is not None:
        values["anchor"] = anchor_values(metadata.anchor)
    if metadata.up is not None:
        values["up"] = list(metadata.up)
    if metadata.sights:
        values["sights"] = [[*each.eye_m, *each.towards] for each in metadata.sights]
    if metadata.focal_px is not None:
        values["focal_px"] = metadata.focal_px
    return {**values, "bounds": {"low_m": list(bounds.low_m), "high_m": list(bounds.high_m)}}


def metadata_of_header(kind: str, stored: Mapping[str, Any]) -> FieldMetadata:
    """Return the metadata of a header.

    Raises ``InvalidInput`` for a value of the wrong type or out of range, and ``KeyError``,
    ``TypeError`` or ``AttributeError`` where the header is of another shape.
    """
    for key in ("name", "training_digest"):
        if not isinstance(stored[key], str):
            raise InvalidInput(f"field.{key}", f"{stored[key]!r} is not text")
    antialiased = stored["antialiased"]
    if not isinstance(antialiased, bool):
        raise InvalidInput("field.antialiased", f"{antialiased!r} is neither true nor false")
    return FieldMetadata(
        name=stored["name"],
        tile_origin=TileOrigin(**{axis: float(v) for axis, v in stored["tile_origin"].items()}),
        training_digest=stored["training_digest"],
        held_out_psnr_db=_measured(stored, "held_out_psnr_db"),
        held_out_ssim=_measured(stored, "held_out_ssim"),
        antialiased=antialiased,
        kind=kind,
        anchor=anchor_of_values(stored["anchor"]) if "anchor" in stored else None,
        up=_triple(stored["up"]) if "up" in stored else None,
        sights=tuple(
            Sight(_triple(values[:3]), _triple(values[3:])) for values in stored.get("sights", ())
        ),
        focal_px=_measured(stored, "focal_px") if "focal_px" in stored else None,
    )


def bounds_of_header(stored: Mapping[str, Any]) -> Bounds | None:
    """Return the bounds in a header, or ``None``; raises as ``metadata_of_header``."""
    if "bounds" not in stored:
        return None
    return Bounds(_triple(stored["bounds"]["low_m"]), _triple(stored["bounds"]["high_m"]))


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _measured(stored: Mapping[str, Any], key: str) -> float | None:
    value = stored[key]
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidInput(f"field.{key}", f"{value!r} is not a number")
    return float(value)
