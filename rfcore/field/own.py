"""Fields that a user's class renders: ``--field MODULE:CLASS`` in place of an archive.

The class is an ``OwnRenderer``: an id and ``render``. ``OwnField`` makes a radiance field of it. It
calls these documented members and nothing else, one picture at a time. ``examples/own_field.py``
has one.

**Contract.** Both ends of a session need the class. Unless it says that it is ``exact``, its
sessions are inexact: a render may differ from the other end's by rounding (block means within one
level), frames are predicted from the render alone, and no digest proves the picture. ``exact`` is a
promise that both ends render the same bytes; a session of a class that breaks it has its frames
refused.
"""

from __future__ import annotations

import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive
from rfcore.field.folder import FIELD_ID
from rfcore.field.interface import Bounds, FieldMetadata
from rfcore.field.quality import FULL, Quality
from rfcore.named_class import make_named
from rfcore.views import View

MOST_MEAN = 2.0
"""A mean of colours or opacities above this is not one of 0..1, however far some pixels overshoot;
a picture in levels has it unless it is black."""
_TRIED = Intrinsics(32, 18, 24.0, 24.0, 16.0, 9.0)


class OwnRenderer(Protocol):
    """Members that a class needs to be a field.

    It may also have ``exact`` (bool; false without it), ``bounds`` (``Bounds``; the origin alone
    without it), ``metadata`` (``FieldMetadata``: the name, and the origin of the axes) and
    ``size_bytes`` (what a vehicle has to be given once; 0 without it).
    """

    @property
    def field_id(self) -> str:
        """64 hexadecimal digits that change with what is shown, as the SHA-256 of a checkpoint."""

    def render(self, camera: Camera, quality: Quality) -> View:
        """Return what ``camera`` sees: float32 colour [H, W, 3], 0..1, depth [H, W] in metres along
        z (0 where there is nothing) and opacity [H, W], 0..1. ``quality`` may be ignored."""


class OwnField:
    """A radiance field that an ``OwnRenderer`` renders.

    ``name`` is what the class is called. Raises ``InvalidInput`` naming what the object lacks, or
    what is wrong with a first small picture of it.
    """

    primitives = 0
    isa = "python"
    most_detail = 1.0

    def __init__(self, renderer: OwnRenderer, name: str) -> None:
        self._renderer = renderer
        self._lock = threading.Lock()
        self.name = name
        lacks = [key for key in ("field_id", "render") if not hasattr(renderer, key)]
        if lacks:
            raise InvalidInput("field", f"{name} lacks {', '.join(lacks)} of an OwnRenderer")
        self.field_id = renderer.field_id
        if not isinstance(self.field_id, str) or not FIELD_ID.fullmatch(self.field_id):
            problem = "is no field id; give 64 hexadecimal digits, as of hashlib.sha256"
            raise InvalidInput("field", f"{name}.field_id: {self.field_id!r} {problem}")
        self.size_bytes = int(getattr(renderer, "size_bytes", 0))
        self.exact = bool(getattr(renderer, "exact", False))
        self.bounds: Bounds = getattr(renderer, "bounds", Bounds((0, 0, 0), (0, 0, 0)))
        self.metadata: FieldMetadata = getattr(renderer, "metadata", FieldMetadata(name))
        self.render(Camera(_TRIED, Pose.identity()))

    def prepare(self, quality: Quality = FULL) -> None:
        """Do nothing: the class has its own way."""

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Render; raise ``InvalidInput`` for a view that is not of the declared form."""
        try:
            with self._lock:
                view = self._renderer.render(camera, quality)
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
            raise InvalidInput("field", f"{self.name}.render raised {problem}") from error
        if not isinstance(view, View):
            kind = type(view).__name__
            raise InvalidInput("field", f"{self.name}.render returned {kind}, not a View")
        k = camera.intrinsics
        shape = (k.height_px, k.width_px)
        wanted = {"colour": (*shape, 3), "depth": shape, "opacity": shape}
        for key, size in wanted.items():
            array = getattr(view, key)
            if not isinstance(array, np.ndarray) or (array.shape, array.dtype) != (
                size,
                np.float32,
            ):
                found = getattr(array, "dtype", type(array).__name__)
                problem = f"{found} {np.shape(array)} must be float32 {size}"
                problem += "" if key == "depth" else ", 0..1"
                raise InvalidInput("field", f"{self.name}.render: {key}: {problem}")
            if not np.isfinite(array).all():
                raise InvalidInput("field", f"{self.name}.render: {key} has NaN or infinite values")
            if key != "depth" and array.mean() > MOST_MEAN:
                problem = f"{key} is {array.mean():.3g} on average; give 0..1, not 0..255"
                raise InvalidInput("field", f"{self.name}.render: {problem}")
        return View(view.colour, view.depth, view.opacity)

    def render_colour(self, camera: Camera, quality: Quality = FULL) -> NDArray[np.float32]:
        """Render only colour, float32 [H, W, 3]."""
        return self.render(camera, quality).colour

    def archive(self) -> Archive:
        """Raise ``InvalidInput``: code has no archive."""
        raise InvalidInput("field", f"{self.name} is code; this needs an archive (.rff)")

    def with_threads(self, threads: int) -> OwnField:  # noqa: ARG002
        """Return this field, which renders one picture at a time."""
        return self


def own_field(text: str) -> OwnField:
    """Return the field of ``package.module:Class``; raise ``InvalidInput`` as the module says."""
    made = make_named("field", text)
    return OwnField(made, text.replace(":", "."))  # type: ignore[arg-type]  # checked there
