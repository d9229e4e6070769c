"""The reference pictures of a frame, computed identically by both ends.

``PREVIOUS``, ``WARP`` and ``CORRECTION`` need an earlier frame; ``RENDER`` is always there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from rfcore.codec.photometric import Photometric, adapt, lit_by
from rfcore.codec.references import Past, Reference, References
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import correct_i420, relight_i420, warp_i420
from rfcore.views import FieldView


@dataclass(frozen=True, eq=False)
class Prediction:
    """Everything a frame can be predicted from, which both ends have before anything is sent.

    ``view`` is what the field shows at the frame's pose, with its render under the frame's light;
    ``past`` is the earlier frame to predict from. ``threads`` changes no picture.
    """

    view: FieldView
    past: Past | None = None
    threads: int = 1
    photometric: Photometric = ()
    """The matrix that changed the light of the render of ``view``; empty for none."""
    is_relit: bool = False
    """True if the render is under ``light`` or, without one, under the light learnt from
    ``past``."""
    light: bytes = b""
    plain_render: I420 | None = None
    """The field's own render, if the render of ``view`` is under another light."""

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
        """Return the prediction with the render of ``view`` under ``light``; without one, under the
        light of the frame ``past``.

        Raises ``InvalidInput`` for bytes that are no light, for neither a light nor a past, and for
        a past of another size.
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
        """True if the light is learnt from the frame in ``past``."""
        return self.is_relit and not self.light

    def past_of(self, picture: I420, digest: bytes | None = None) -> Past:
        """Return the past of later frames once this frame was decoded to ``picture``.

        ``digest``: the picture's digest, if it is known already.
        """
        return Past(picture, self.view.without_opacity(), digest, self.plain_render)

    @property
    def available(self) -> frozenset[Reference]:
        """The references that can be computed."""
        return frozenset({Reference.RENDER} if self.past is None else Reference)

    @property
    def render(self) -> I420:
        """The field's render at the frame's pose, under the frame's light."""
        return self.view.render

    @cached_property
    def warp(self) -> I420:
        """The earlier frame carried to the present pose, with holes filled from the render."""
        past = self._past()
        return warp_i420(past.picture, past.view, self.view, self.threads)

    @cached_property
    def correction(self) -> I420:
        """The render plus most of the earlier frame's difference from its own render."""
        past = self._past()
        return correct_i420(past.picture, past.view, self.view, self.threads)

    def _past(self) -> Past:
        if self.past is None:
            raise InvalidInput("references", "there is no earlier frame to predict from")
        return self.past

    def picture(self, reference: Reference) -> I420:
        """Return one reference; raise ``InvalidInput`` if it needs an earlier frame that is
        missing."""
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
