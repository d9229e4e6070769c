"""Time the delta codec on both ends: 640x360 and 1280x720, 200k Gaussians, CRF 23.

With one thread, which is what the receiver's times are for, and with two. The camera frame is the
street's own render from the true pose plus seeded texture and boxes the field has never seen, so
the P picture has something to code; the camera drives 20 cm a frame. Each size is coded against one
reference (the render) and against three (previous frame, render, correction), by our slice coder
and by x264 medium: every frame by all of them, one after another, so that what disturbs the machine
disturbs them alike. On every frame the receiver's picture must equal the sender's closed loop.

The receiver decodes each frame twice, as a frame that comes alone and as one whose pose came ahead:
then ``ahead`` is what it does before the frame (render, and the references that the frame before
had), and ``last byte`` what is left. The stage ``relight`` is what an end takes beside its total
where the light is not the field's: these frames are in its light, so the render is mapped to that
of the frame before for the time alone.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any, TypeVar

import numpy as np

from lab.bench.street import street_camera, street_gaussians
from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import RECONSTRUCTION_DIGEST_BYTES, DeltaPacket, check_packet
from rfcore.codec.references import Reference, References
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.errors import CodecError
from rfcore.image import I420
from rfcore.metrics import psnr
from rfcore.native.warp import relight_i420
from rfcore.native.yuv import field_view_from_view, i420_from_rgb
from rfcore.raster.native import Rasterizer
from rfcore.views import FieldView

T = TypeVar("T")

SIZES_PX = ((640, 360), (1280, 720))
ONE: References = (Reference.RENDER,)
THREE: References = (Reference.PREVIOUS, Reference.RENDER, Reference.CORRECTION)
THREADS = (1, 2)
EFFORTS = ("default", "fast", "x264-medium")
STEP_M = 0.2
REPETITIONS = 20
WARM_UP = 3


class Coding:
    """Both ends of one coder, frame after frame, and the milliseconds of every stage."""

    def __init__(self, size_px: tuple[int, int], effort: str, threads: int) -> None:
        self.effort = effort
        config = CodecConfig(*size_px, effort)
        self._before: DeltaPacket | None = None
        self._encoder = DeltaEncoder(config, clock_ns=perf_counter_ns, threads=threads)
        self._decoder = DeltaDecoder(self._encoder.header, clock_ns=perf_counter_ns)
        self._sent, self._received = self._encoder.start(1), self._decoder.start(1)
        self._sender: dict[str, list[float]] = {}
        self._receiver: dict[str, list[float]] = {}
        self._payload_bytes: list[int] = []
        self._psnr_db: list[float] = []

    def code(self, frame: I420, view: FieldView, render_ms: float, choice: FrameChoice) -> None:
        """Code and decode one frame, and note its times."""
        past = self._sent.past
        total_ms, encoded = _timed(lambda: self._encoder.encode(self._sent, frame, view, choice))
        packet, received = encoded.packet, self._received
        if len(self._payload_bytes) % 2:  # what is done first finds colder caches
            ahead_ms, last_byte_ms, shown = self._decode_prepared(packet, view)
            decode_ms, decoded = _timed(lambda: self._decoder.decode(received, packet, view))
        else:
            decode_ms, decoded = _timed(lambda: self._decoder.decode(received, packet, view))
            ahead_ms, last_byte_ms, shown = self._decode_prepared(packet, view)
        for picture in (decoded.frame, shown):
            if picture.digest() != encoded.reconstruction.digest():
                raise CodecError("the receiver's picture differs from the sender's closed loop")
        self._sent, self._received, self._before = encoded.state, decoded.state, packet
        _note(self._sender, render_ms, total_ms, encoded.stage_ns)
        _note(self._receiver, render_ms, decode_ms, decoded.stage_ns)
        self._receiver.setdefault("ahead", []).append(render_ms + ahead_ms)
        self._receiver.setdefault("last byte", []).append(last_byte_ms)
        if past is not None:
            relight_ms, _ = _timed(
                lambda: relight_i420(past.picture, past.field_render, view.render)
            )
            for series in (self._sender, self._receiver):
                series.setdefault("relight", []).append(relight_ms)
        self._payload_bytes.append(len(encoded.packet.payload))
        self._psnr_db.append(psnr(decoded.frame.y, frame.y))

    def _decode_prepared(self, packet: DeltaPacket, view: FieldView) -> tuple[float, float, I420]:
        """Return the time before the frame comes, without the render, the time after it, and the
        picture."""
        state, past = self._received, self._sent.past
        base = b"" if past is None else past.digest[:RECONSTRUCTION_DIGEST_BYTES]
        ahead_ms, prepared = _timed(lambda: self._decoder.prepared(state, view, base, self._before))
        checked = check_packet(packet, state.epoch, state.next_sequence)
        last_byte_ms, decoded = _timed(
            lambda: self._decoder.decode_checked(state, checked, view, prepared)
        )
        return ahead_ms, last_byte_ms, decoded.frame

    def row(self, threads: int, size_px: tuple[int, int], references: int) -> CodecRow:
        """Return the medians of all frames after the first few."""
        return CodecRow(
            threads=threads,
            width=size_px[0],
            height=size_px[1],
            references=references,
            effort=self.effort,
            payload_bytes=statistics.median(self._payload_bytes[WARM_UP:]),
            psnr_db=statistics.median(self._psnr_db[WARM_UP:]),
            sender_ms=_medians(self._sender),
            receiver_ms=_medians(self._receiver),
        )


@dataclass(frozen=True)
class CodecRow:
    """A coder at one number of threads, size and number of references: median ms a stage."""

    threads: int
    width: int
    height: int
    references: int
    effort: str
    payload_bytes: float
    psnr_db: float
    """PSNR of the luma; times of two coders compare where it is about the same."""
    sender_ms: Mapping[str, float]
    receiver_ms: Mapping[str, float]


def codec_rows() -> list[CodecRow]:
    """Return a row for each number of threads, size, number of references and coder."""
    gaussians = street_gaussians()
    return [
        row
        for threads, rasterizer in ((n, Rasterizer(gaussians, threads=n)) for n in THREADS)
        for size_px in SIZES_PX
        for references in (ONE, THREE)
        for row in _rows(rasterizer, threads, size_px, references)
    ]


def _rows(
    rasterizer: Rasterizer, threads: int, size_px: tuple[int, int], references: References
) -> list[CodecRow]:
    first = street_camera(*size_px)
    codings = [Coding(size_px, effort, threads) for effort in EFFORTS]
    for index in range(WARM_UP + REPETITIONS):
        camera = _moved(first, index)
        frame = _camera_frame(rasterizer.render_colour(camera))
        render_ms, view = _timed(
            lambda: field_view_from_view(rasterizer.render(camera), camera)  # noqa: B023
        )
        choice = FrameChoice(references if index else ONE)
        turn = index % len(codings)
        for coding in (*codings[turn:], *codings[:turn]):
            coding.code(frame, view, render_ms, choice)
    return [coding.row(threads, size_px, len(references)) for coding in codings]


def _moved(camera: Camera, index: int) -> Camera:
    """Return the camera of frame ``index``."""
    x_m, y_m, z_m = camera.world_from_cam.translation_m
    pose = replace(camera.world_from_cam, translation_m=(x_m, y_m, z_m + STEP_M * index))
    return Camera(camera.intrinsics, pose)


def _camera_frame(colour: np.ndarray[Any, np.dtype[np.float32]]) -> I420:
    """The render, with fine texture (sd 4 levels) and six boxes nobody trained on."""
    rng = np.random.default_rng(7)
    rgb = np.clip(colour, 0, 1) * 255 + rng.normal(0, 4, colour.shape)
    height, width, _ = rgb.shape
    for _ in range(6):
        top, left = int(rng.integers(height // 2, height)), int(rng.integers(0, width))
        rgb[top : top + height // 8, left : left + width // 8] = rng.integers(0, 255, 3)
    return i420_from_rgb(np.clip(rgb, 0, 255).astype(np.uint8))


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


def _medians(series: Mapping[str, list[float]]) -> dict[str, float]:
    return {stage: statistics.median(ms[WARM_UP:]) for stage, ms in series.items()}
