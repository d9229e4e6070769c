"""Time the delta codec on both ends: 640x360 and 1280x720, 200k Gaussians, medium, CRF 23.

The camera frame is the street's own render from the true pose plus seeded texture and boxes the
field has never seen, so the P picture has something to code. Before anything is timed, the
receiver's picture must equal the sender's closed loop on every frame.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any, TypeVar

import numpy as np

from rfcore.camera import Camera
from rfcore.codec import CodecConfig, DeltaDecoder, DeltaEncoder
from rfcore.errors import CodecError
from rfcore.image import I420
from rfcore.native.warp import PosedDepth
from rfcore.native.yuv import i420_from_colour, i420_from_rgb
from rfcore.raster.native import Rasterizer
from rfedge.bench.street import street_camera, street_gaussians

__all__ = ["codec_rows"]

T = TypeVar("T")

SIZES_PX = ((640, 360), (1280, 720))
REPETITIONS = 20
WARM_UP = 3


@dataclass(frozen=True)
class Ends:
    """Everything one size needs: a renderer, the codec's two ends, and a camera frame."""

    rasterizer: Rasterizer
    camera: Camera
    frame: I420
    encoder: DeltaEncoder
    decoder: DeltaDecoder

    def render(self) -> tuple[I420, PosedDepth]:
        """Render as both ends do: field, then the project's own YUV conversion."""
        view = self.rasterizer.render(self.camera)
        return i420_from_colour(view.colour), PosedDepth(self.camera, view.depth)


def codec_rows(threads: int = 1) -> list[dict[str, Any]]:
    """Return one row a size: medians in ms of the sender's and the receiver's stages."""
    gaussians = street_gaussians()
    rasterizer = Rasterizer(gaussians, threads=threads)
    return [_row(_ends(rasterizer, *size)) for size in SIZES_PX]


def _ends(rasterizer: Rasterizer, width_px: int, height_px: int) -> Ends:
    camera = street_camera(width_px, height_px)
    encoder = DeltaEncoder(CodecConfig(width_px, height_px), clock_ns=perf_counter_ns)
    decoder = DeltaDecoder(encoder.header, clock_ns=perf_counter_ns)
    frame = _camera_frame(rasterizer.render_colour(camera))
    return Ends(rasterizer, camera, frame, encoder, decoder)


def _camera_frame(colour: np.ndarray[Any, np.dtype[np.float32]]) -> I420:
    """The render, with fine texture (sd 4 levels) and six boxes nobody trained on."""
    rng = np.random.default_rng(7)
    rgb = np.clip(colour, 0, 1) * 255 + rng.normal(0, 4, colour.shape)
    height, width, _ = rgb.shape
    for _ in range(6):
        top, left = int(rng.integers(height // 2, height)), int(rng.integers(0, width))
        rgb[top : top + height // 8, left : left + width // 8] = rng.integers(0, 255, 3)
    return i420_from_rgb(np.clip(rgb, 0, 255).astype(np.uint8))


def _row(ends: Ends) -> dict[str, Any]:
    sender: dict[str, list[float]] = {}
    receiver: dict[str, list[float]] = {}
    send_state, receive_state = ends.encoder.start(1), ends.decoder.start(1)
    for repetition in range(WARM_UP + REPETITIONS):
        render_ms, render = _timed(ends.render)
        total_ms, encoded = _timed(lambda: ends.encoder.encode(send_state, ends.frame, *render))  # noqa: B023
        decode_ms, decoded = _timed(
            lambda: ends.decoder.decode(receive_state, encoded.packet, *render)  # noqa: B023
        )
        if decoded.frame.digest() != encoded.reconstruction.digest():
            raise CodecError("the receiver's picture differs from the sender's closed loop")
        send_state, receive_state = encoded.state, decoded.state
        if repetition >= WARM_UP:
            _note(sender, render_ms, total_ms, encoded.stage_ns)
            _note(receiver, render_ms, decode_ms, decoded.stage_ns)
    width_px, height_px = ends.frame.size_px
    return {
        "width": width_px,
        "height": height_px,
        "sender_ms": {stage: statistics.median(ms) for stage, ms in sender.items()},
        "receiver_ms": {stage: statistics.median(ms) for stage, ms in receiver.items()},
    }


def _timed(call: Callable[[], T]) -> tuple[float, T]:
    start = perf_counter_ns()
    value = call()
    return (perf_counter_ns() - start) / 1e6, value


def _note(
    series: dict[str, list[float]], render_ms: float, coding_ms: float, stage_ns: Mapping[str, int]
) -> None:
    stages = {"render": render_ms, **{name: ns / 1e6 for name, ns in stage_ns.items()}}
    for name, ms in {**stages, "total": render_ms + coding_ms}.items():
        series.setdefault(name, []).append(ms)
