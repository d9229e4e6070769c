"""Time the delta codec on both ends: 640x360 and 1280x720, 200k Gaussians, medium, CRF 23.

With one thread, which is what the receiver's times are for, and with two. The camera frame is the
street's own render from the true pose plus seeded texture and boxes the field has never seen, so
the P picture has something to code; the camera drives 20 cm a frame. Each size is coded against one
reference (the render) and against three (previous frame, render, correction). On every frame the
receiver's picture must equal the sender's closed loop.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any, TypeVar

import numpy as np

from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import Reference, References
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.errors import CodecError
from rfcore.image import I420
from rfcore.native.yuv import field_view_from_view, i420_from_rgb
from rfcore.raster.native import Rasterizer
from rfcore.views import FieldView
from rfedge.bench.street import street_camera, street_gaussians

__all__ = ["CodecRow", "codec_rows"]

T = TypeVar("T")

SIZES_PX = ((640, 360), (1280, 720))
ONE: References = (Reference.RENDER,)
THREE: References = (Reference.PREVIOUS, Reference.RENDER, Reference.CORRECTION)
THREADS = (1, 2)
STEP_M = 0.2
REPETITIONS = 20
WARM_UP = 3


@dataclass(frozen=True)
class CodecSetup:
    """Everything one size needs: a renderer, the codec's two ends, and the first camera."""

    rasterizer: Rasterizer
    camera: Camera
    encoder: DeltaEncoder
    decoder: DeltaDecoder

    def at(self, index: int) -> Camera:
        """Return the camera of frame ``index``."""
        x_m, y_m, z_m = self.camera.world_from_cam.translation_m
        pose = replace(self.camera.world_from_cam, translation_m=(x_m, y_m, z_m + STEP_M * index))
        return Camera(self.camera.intrinsics, pose)

    def render(self, camera: Camera) -> FieldView:
        """Render as both ends do: field, then the project's own YUV conversion."""
        return field_view_from_view(self.rasterizer.render(camera), camera)


@dataclass(frozen=True)
class CodecRow:
    """One number of threads, size and number of references: median ms of each stage."""

    threads: int
    width: int
    height: int
    references: int
    sender_ms: Mapping[str, float]
    receiver_ms: Mapping[str, float]


def codec_rows() -> list[CodecRow]:
    """Return a row for each number of threads, size and number of references."""
    gaussians = street_gaussians()
    return [
        _row(_setup(rasterizer, threads, *size), threads, references)
        for threads, rasterizer in ((n, Rasterizer(gaussians, threads=n)) for n in THREADS)
        for size in SIZES_PX
        for references in (ONE, THREE)
    ]


def _setup(rasterizer: Rasterizer, threads: int, width_px: int, height_px: int) -> CodecSetup:
    camera = street_camera(width_px, height_px)
    config = CodecConfig(width_px, height_px)
    encoder = DeltaEncoder(config, clock_ns=perf_counter_ns, threads=threads)
    decoder = DeltaDecoder(encoder.header, clock_ns=perf_counter_ns)
    return CodecSetup(rasterizer, camera, encoder, decoder)


def _camera_frame(colour: np.ndarray[Any, np.dtype[np.float32]]) -> I420:
    """The render, with fine texture (sd 4 levels) and six boxes nobody trained on."""
    rng = np.random.default_rng(7)
    rgb = np.clip(colour, 0, 1) * 255 + rng.normal(0, 4, colour.shape)
    height, width, _ = rgb.shape
    for _ in range(6):
        top, left = int(rng.integers(height // 2, height)), int(rng.integers(0, width))
        rgb[top : top + height // 8, left : left + width // 8] = rng.integers(0, 255, 3)
    return i420_from_rgb(np.clip(rgb, 0, 255).astype(np.uint8))


def _row(setup: CodecSetup, threads: int, references: References) -> CodecRow:
    sender: dict[str, list[float]] = {}
    receiver: dict[str, list[float]] = {}
    send_state, receive_state = setup.encoder.start(1), setup.decoder.start(1)
    for repetition in range(WARM_UP + REPETITIONS):
        camera = setup.at(repetition)
        frame = _camera_frame(setup.rasterizer.render_colour(camera))
        render_ms, view = _timed(lambda: setup.render(camera))  # noqa: B023
        choice = FrameChoice(references if repetition else ONE)
        total_ms, encoded = _timed(
            lambda: setup.encoder.encode(send_state, frame, view, choice)  # noqa: B023
        )
        decode_ms, decoded = _timed(
            lambda: setup.decoder.decode(receive_state, encoded.packet, view)  # noqa: B023
        )
        if decoded.frame.digest() != encoded.reconstruction.digest():
            raise CodecError("the receiver's picture differs from the sender's closed loop")
        send_state, receive_state = encoded.state, decoded.state
        if repetition >= WARM_UP:
            _note(sender, render_ms, total_ms, encoded.stage_ns)
            _note(receiver, render_ms, decode_ms, decoded.stage_ns)
    k = setup.camera.intrinsics
    return CodecRow(
        threads=threads,
        width=k.width_px,
        height=k.height_px,
        references=len(references),
        sender_ms={stage: statistics.median(ms) for stage, ms in sender.items()},
        receiver_ms={stage: statistics.median(ms) for stage, ms in receiver.items()},
    )


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
