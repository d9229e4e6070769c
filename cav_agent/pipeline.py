"""From a captured picture to a packet: read, convert, render, encode. Runs on a worker thread.

The encoder's state is a value; it starts afresh whenever the session asks for another epoch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cav_agent.frames import EncodedFrame, EncodeJob
from rfcore.camera import Camera, Intrinsics
from rfcore.codec import CodecConfig, DeltaEncoder, EncoderState, StreamHeader
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.native.yuv import i420_from_colour, i420_from_rgb
from rfcore.views import PosedPicture

__all__ = ["Pipeline", "Renderer"]

ClockNs = Callable[[], int]


class Renderer(Protocol):
    """A radiance field, ready to be looked at."""

    def render_colour(self, camera: Camera) -> NDArray[np.float32]:
        """Return the colour seen from ``camera``, float32 [H, W, 3]."""


class Pipeline:
    """Codes the pictures of one camera against renders of one field; one caller at a time."""

    def __init__(self, renderer: Renderer, config: CodecConfig, clock_ns: ClockNs) -> None:
        self._renderer = renderer
        self._config = config
        self._clock_ns = clock_ns
        self._encoder = DeltaEncoder(config, clock_ns)
        self._state: EncoderState | None = None

    @property
    def header(self) -> StreamHeader:
        """What the server needs before the first packet."""
        return self._encoder.header

    def encode(self, job: EncodeJob) -> EncodedFrame:
        """Return the packet of ``job``'s picture.

        Raises ``DatasetError`` for a picture that cannot be read, ``InvalidInput`` for one of
        another size, ``CodecError`` when x264 fails.
        """
        started_ns = self._clock_ns()
        rgb = self._read(job.capture.picture)
        read_ns = self._clock_ns()
        frame = i420_from_rgb(rgb)
        converted_ns = self._clock_ns()
        render = i420_from_colour(self._renderer.render_colour(job.capture.picture.camera))
        rendered_ns = self._clock_ns()
        state = self._state
        if state is None or state.epoch != job.epoch:
            state = self._encoder.start(job.epoch)
        encoded = self._encoder.encode(state, frame, render)
        self._state = encoded.state
        return EncodedFrame(
            encoded.packet,
            {
                "read": (read_ns - started_ns) / 1e9,
                "convert": (converted_ns - read_ns) / 1e9,
                "render": (rendered_ns - converted_ns) / 1e9,
                "encode": encoded.stage_ns["encode"] / 1e9,
                "closed_loop": encoded.stage_ns["closed_loop"] / 1e9,
            },
        )

    def _read(self, picture: PosedPicture) -> Rgb:
        k: Intrinsics = picture.camera.intrinsics
        if (k.width_px, k.height_px) != self._config.size_px:
            raise InvalidInput(
                picture.name,
                f"{k.width_px}x{k.height_px} px, the stream is coded at "
                f"{self._config.width_px}x{self._config.height_px} px",
            )
        return picture.read()
