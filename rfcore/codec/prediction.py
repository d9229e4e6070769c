"""The references of a frame as pictures, made alike by both ends.

``PREVIOUS``, ``WARP`` and ``CORRECTION`` need an earlier frame; ``RENDER`` is always there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from rfcore.codec.photometric import Photometric, adapt, lit_by
from rfcore.codec.references import Reference, References
from rfcore.codec.state import Past
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import correct_i420, relight_i420, warp_i420
from rfcore.views import FieldView

__all__ = ["Prediction"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What both ends hold of a frame before a bit of it is sent.

    ``view`` is what the field shows at the frame's pose, its render under the frame's light;
    ``past`` the earlier frame to predict from. ``threads`` changes no picture.
    """

    view: FieldView
    past: Past | None = None
    threads: int = 1
    photometric: Photometric = ()
    """How the light of the render of ``view`` was changed by numbers."""
    is_relit: bool = False
    """Whether it is under ``light`` or, without one, that learnt from the frame in ``past``."""
    light: bytes = b""
    plain_render: I420 | None = None
    """The render of the field, where that of ``view`` is under another light."""

    @staticmethod
    def under_light(
        view: FieldView, photometric: Photometric, past: Past | None, threads: int = 1
    ) -> Prediction:
        """Return the prediction with the render of ``view`` changed by ``photometric``."""
        if not photometric:
            return Prediction(view, past, threads)
        lit = view.under(adapt(view.render, photometric))
        return Prediction(lit, past, threads, photometric, plain_render=view.render)

    @staticmethod
    def relit(
        view: FieldView, past: Past | None, threads: int = 1, light: bytes = b""
    ) -> Prediction:
        """Return the prediction with the render of ``view`` under ``light`` or, without one, under
        that which ``past`` was seen in.

        Raises ``InvalidInput`` for a light that is none, without either, or for an earlier frame of
        another size.
        """
        if light:
            render = lit_by(view.render, light)
        elif past is not None:
            render = relight_i420(past.picture, past.field_render, view.render)
        else:
            raise InvalidInput("relit", "there is no earlier frame to learn the light from")
        lit = view.under(render)
        return Prediction(lit, past, threads, (), True, light, view.render)

    @property
    def learns_light(self) -> bool:
        """Whether its light is learnt from the frame in ``past``."""
        return self.is_relit and not self.light

    def past_of(self, picture: I420, digest: bytes | None = None) -> Past:
        """Return what later frames predict from once this frame was decoded to ``picture``.

        ``digest``: the picture's, where it is known already.
        """
        return Past(picture, self.view.without_opacity(), digest, self.plain_render)

    @property
    def available(self) -> frozenset[Reference]:
        """Which references can be made."""
        return frozenset({Reference.RENDER} if self.past is None else Reference)

    @property
    def render(self) -> I420:
        """The field's picture at the frame's pose, under the frame's light."""
        return self.view.render

    @cached_property
    def warp(self) -> I420:
        """The earlier frame at the present pose, holes filled from the render."""
        past = self._past()
        return warp_i420(past.picture, past.view, self.view, self.threads)

    @cached_property
    def correction(self) -> I420:
        """The render, with most of what the earlier frame differed by from its own render."""
        past = self._past()
        return correct_i420(past.picture, past.view, self.view, self.threads)

    def _past(self) -> Past:
        if self.past is None:
            raise InvalidInput("references", "there is no earlier frame to predict from")
        return self.past

    def picture(self, reference: Reference) -> I420:
        """Return one reference; raise ``InvalidInput`` for one that cannot be made."""
        match reference:
            case Reference.RENDER:
                return self.render
            case Reference.WARP:
                return self.warp
            case Reference.CORRECTION:
                return self.correction
            case Reference.PREVIOUS:
                return self._past().picture

    def pictures(self, references: References) -> tuple[I420, ...]:
        """Return the references in their order."""
        return tuple(self.picture(reference) for reference in references)
