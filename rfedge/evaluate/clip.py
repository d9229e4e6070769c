"""A clip as somebody coded it: bytes, pictures and processor time, and nothing of how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420

__all__ = ["ClipCoder", "CodedClip", "luma_mse", "luma_sse"]


@dataclass(frozen=True)
class CodedClip:
    """What coding a clip at one operating point gave, a value per frame in time order.

    ``frame_bytes`` int64 [N], all that would have to be sent for the frame; ``luma_mse`` float64
    [N], of the decoded luma against the camera's on the true size; ``ssim`` float64 [N], likewise;
    ``cpu_ms`` float64, processor time of the sender over the whole clip, of all its threads.
    """

    point: float
    frame_bytes: NDArray[np.int64]
    luma_mse: NDArray[np.float64]
    ssim: NDArray[np.float64]
    cpu_ms: float
    notes: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    """What the method wants to tell of each frame, by name: modes chosen, bits by kind..."""

    def __post_init__(self) -> None:
        shapes = {self.frame_bytes.shape, self.luma_mse.shape, self.ssim.shape}
        if len(shapes) != 1 or self.frame_bytes.ndim != 1 or not len(self.frame_bytes):
            raise InvalidInput("clip", f"shapes {shapes} must be one value per frame")
        if any(len(values) != len(self.frame_bytes) for values in self.notes.values()):
            raise InvalidInput("clip.notes", "must have one value per frame")


class ClipCoder(Protocol):
    """A codec under test. ``--method package:Class`` names one; it is called without arguments.

    ``name`` labels it in tables. ``points`` are its operating points (CRF, QP or whatever it
    takes), ordered from best to worst quality, and must span the quality window asked about.
    ``version`` names the program behind it: finished pieces of another version are done anew.
    """

    @property
    def name(self) -> str:
        """The label, with every setting that changes the result."""

    @property
    def points(self) -> Sequence[float]:
        """The operating points."""

    @property
    def version(self) -> str:
        """What the result depends on besides name, point and clip."""

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` with low delay: no frame may wait for a later one."""


def luma_mse(decoded: I420, frame: I420) -> float:
    """Return the mean squared error of the luma planes."""
    difference = decoded.y.astype(np.float64) - frame.y
    return float(np.mean(difference * difference))


def luma_sse(decoded: I420, frame: I420, where: NDArray[np.bool_]) -> float:
    """Return the sum of squared errors of the luma over the pixels ``where`` is true."""
    difference = (decoded.y.astype(np.float64) - frame.y)[where]
    return float(difference @ difference)
