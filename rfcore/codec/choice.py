"""Which references a frame gets."""

from __future__ import annotations

from rfcore.codec.photometric import Photometric
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import RENDER_ONLY, Reference, References
from rfcore.image import I420

__all__ = ["choose_photometric", "choose_references"]


def choose_references(frame: I420, prediction: Prediction, crf: float) -> References:
    """Return the references to use for ``frame``."""
    del frame, crf
    if Reference.CORRECTION in prediction.available:
        return (Reference.PREVIOUS, Reference.RENDER, Reference.CORRECTION)
    return RENDER_ONLY


def choose_photometric(frame: I420, render: I420) -> Photometric:
    """Return how the render's light is to be changed."""
    del frame, render
    return ()
