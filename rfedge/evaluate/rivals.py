"""The codecs a user would pick instead: x264, x265 and SVT-AV1 set for low delay, one thread.

Each runs as a user would run it on a vehicle: every frame goes out before the next comes in (no
reordering, no lookahead; an encoder that holds a frame back is an error), rate by CRF, one key
frame at the start unless the rival is about key frames. Options are the libraries' own names.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from time import process_time_ns
from typing import Literal, cast

import av
import numpy as np
from av.error import FFmpegError

from rfcore.codec.h264.config import even_size_px
from rfcore.codec.h264.ffmpeg import picture_of, video_frame
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import CodedClip, Notes, luma_mse
from rfedge.evaluate.ssim import luma_ssim


@contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Give all threads of this process, new ones too, the scheduling policy this one had before.

    SVT-AV1 asks for real-time scheduling when it runs as root: for its own threads and, for good,
    for the one that opened it. What is started afterwards inherits that and starves everything
    else, and times taken beside it are worth nothing. Linux only.
    """
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        for task in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # a thread may end meanwhile
                if os.sched_getscheduler(int(task.name)) != policy:
                    os.sched_setscheduler(int(task.name), policy, priority)


X264_CRFS = (17.0, 20.0, 23.0, 26.0, 29.0, 32.0, 35.0, 38.0, 41.0)
X265_CRFS = (19.0, 22.0, 25.0, 28.0, 31.0, 34.0, 37.0, 40.0, 43.0)
SVT_CRFS = (20.0, 27.0, 34.0, 41.0, 48.0, 55.0)
"""Spans the headline window of 32..35 dB on most street pictures, with room on either side."""
H26X_LIMITS, SVT_LIMITS = (1.0, 51.0), (1.0, 63.0)
"""CRFs of the best and the worst quality; 0 would be lossless."""

PROBE = I420(np.full((48, 64), 128, np.uint8), *[np.full((24, 32), 128, np.uint8)] * 2)
PROBE_HZ, PROBE_CRF = 10.0, 30.0
SETTINGS = re.compile(rb"x26[45] [^\0]*options: [^\0\x80]*")
"""The SEI message that x264 and x265 write about themselves into the first packet."""

os.environ.setdefault("SVT_LOG", "1")  # read when the library opens: errors only


@dataclass(frozen=True)
class CodedPictures:
    """Bytes of each frame, the pictures a decoder made of them, the processor time of both, and the
    coder's notes."""

    frame_bytes: Sequence[int]
    decoded: Sequence[I420]
    cpu_ms: float
    decoder_cpu_ms: float
    notes: Mapping[str, Notes] = field(default_factory=dict)

    def measured(self, point: float, frames: Sequence[I420], **notes: Notes) -> CodedClip:
        """Return the clip, coded at ``point``, with its errors against the camera's ``frames``, and
        with ``notes`` besides."""
        pairs = list(zip(self.decoded, frames, strict=True))
        return CodedClip(
            point,
            np.array(self.frame_bytes, np.int64),
            np.array([luma_mse(*pair) for pair in pairs]),
            np.array([luma_ssim(ours.y, theirs.y) for ours, theirs in pairs]),
            self.cpu_ms,
            {**self.notes, **notes},
            self.decoder_cpu_ms,
        )


@dataclass(frozen=True)
class Rival:
    """One encoder with its options; codes a clip by feeding frames one at a time."""

    name: str
    encoder: str
    decoder: str
    options: Mapping[str, str]
    points: Sequence[float] = field(default=X264_CRFS)
    limits: tuple[float, float] = H26X_LIMITS

    @property
    def version(self) -> str:
        """The libraries, which come with PyAV, and the options that the encoder runs with."""
        return f"PyAV {av.__version__}; {self.effective_options}"

    @property
    def effective_options(self) -> str:
        """The encoder's own statement of its version and settings, presets and tunes resolved.

        x264 and x265 write it into the stream; SVT-AV1 does not: the options as they are given.
        """
        return _effective_options(self.encoder, tuple(self.options.items()))

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` at CRF ``point``.

        Raises ``InvalidInput`` without frames, ``CodecError`` if a library fails or holds a frame
        back.
        """
        if not frames:
            raise InvalidInput("frames", "a rival needs at least one frame")
        return self.pictures(frames, rate_hz, point).measured(point, frames)

    def pictures(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedPictures:
        """Return what ``code`` measures; raises as it does, but does not look at the sizes."""
        began_ns = process_time_ns()
        packets = self._encoded(frames, rate_hz, point)
        coded_ns = process_time_ns()
        decoded = self._decoded(packets, frames[0].size_px)
        decoder_ms = (process_time_ns() - coded_ns) / 1e6
        sizes = [len(packet) for packet in packets]
        return CodedPictures(sizes, decoded, (coded_ns - began_ns) / 1e6, decoder_ms)

    def frames_ms(
        self, frames: Sequence[I420], rate_hz: float, point: float
    ) -> list[tuple[float, float]]:
        """Return what each frame takes of a processor to code and to decode, in milliseconds.

        Raises ``CodecError`` as ``code`` does.
        """
        decoder = _decoder(self.decoder)
        took_ms, began_ns = [], process_time_ns()
        for packet in self._packets(frames, rate_hz, point):
            coded_ns = process_time_ns()
            for _ in decoder.decode(av.Packet(packet)):
                pass
            decoded_ns = process_time_ns()
            took_ms.append(((coded_ns - began_ns) / 1e6, (decoded_ns - coded_ns) / 1e6))
            began_ns = process_time_ns()
        return took_ms

    def _encoded(self, frames: Sequence[I420], rate_hz: float, point: float) -> list[bytes]:
        return list(self._packets(frames, rate_hz, point))

    def _packets(self, frames: Sequence[I420], rate_hz: float, point: float) -> Iterator[bytes]:
        try:
            even_px = even_size_px(frames[0].size_px)
            encoder = self._encoder(even_px, rate_hz, point)
            for index, frame in enumerate(frames):
                made = encoder.encode(video_frame(frame, even_px, index))
                if len(made) != 1:
                    raise CodecError(f"{self.name}: frame {index} came out as {len(made)} packets")
                yield bytes(made[0])
            if encoder.encode(None):
                raise CodecError(f"{self.name}: kept a frame until the end")
        except (FFmpegError, ValueError) as error:
            raise CodecError(f"{self.name}: {error}") from error

    def _encoder(
        self, size_px: tuple[int, int], rate_hz: float, point: float
    ) -> av.VideoCodecContext:
        encoder = _opened(self.encoder, "w")
        rate = Fraction(rate_hz).limit_denominator(1000)
        encoder.width, encoder.height = size_px
        encoder.pix_fmt = "yuv420p"
        encoder.time_base, encoder.framerate = 1 / rate, rate
        encoder.thread_count = 1
        encoder.options = {**self.options, "crf": f"{point:g}"}
        with ordinary_scheduling():
            encoder.open()
        return encoder

    def _decoded(self, packets: Sequence[bytes], size_px: tuple[int, int]) -> list[I420]:
        return [picture.cropped(size_px) for picture in decoded_pictures(self.decoder, packets)]


@cache
def _effective_options(encoder: str, options: tuple[tuple[str, str], ...]) -> str:
    rival = Rival(encoder, encoder, "", dict(options))
    first = rival._encoded([PROBE], PROBE_HZ, PROBE_CRF)[0]
    found = SETTINGS.search(first)
    return found[0].decode("ascii", "replace") if found else f"{encoder} {dict(options)}"


def x264_lowdelay(preset: str, name: str | None = None, **params: str) -> Rival:
    """Return x264 with ``tune=zerolatency``: IPPP, no scene cuts; ``params`` are added to it."""
    options = {"keyint": "infinite", "scenecut": "0", "threads": "1", **params}
    return Rival(
        name or f"x264-lowdelay-{preset}",
        "libx264",
        "h264",
        {"preset": preset, "tune": "zerolatency", "x264-params": _joined(options)},
    )


def x264_for_psnr(preset: str) -> Rival:
    """Return the same with ``tune=psnr``, as whoever compares PSNRs should have it."""
    plain = x264_lowdelay(preset, f"x264-lowdelay-psnr-{preset}")
    return _tuned(plain, "psnr")


def x264_for_ssim(preset: str) -> Rival:
    """Return the same with ``tune=ssim``, for a comparison by SSIM."""
    plain = x264_lowdelay(preset, f"x264-lowdelay-ssim-{preset}")
    return _tuned(plain, "ssim")


OUR_TOOLS = {"mixed-refs": "1", "ref": "3", "trellis": "2", "aq-mode": "0", "psy": "0"}
"""The tools of our slices at every effort: blocks that choose among three references,
rate-distortion optimised coefficients, no adaptive quantisation, no psychovisual terms."""
MORE_REFERENCES = ("slow", "slower", "veryslow", "placebo")


def x264_with_our_tools(preset: str) -> Rival:
    """Return x264 tuned for PSNR with every tool that our slices have, whatever the preset.

    Presets that search more references than three keep theirs: nothing is taken from a rival.
    """
    tools = dict(OUR_TOOLS)
    if preset in MORE_REFERENCES:
        del tools["ref"]
    plain = x264_lowdelay(preset, f"x264-our-tools-{preset}", **tools)
    return _tuned(plain, "psnr")


def _tuned(plain: Rival, metric: str) -> Rival:
    """Return an x264 of low delay tuned for a metric besides."""
    return replace(plain, options={**plain.options, "tune": f"zerolatency,{metric}"})


def percent_against_x264(ours: CodedClip, frames: Sequence[I420], rate_hz: float) -> float:
    """Return by how many percent ours needs more bytes than x264 with our tools at equal luma PSNR.

    The first frame is left out. Between two CRFs, at most 1 apart, the logarithm of x264's bytes is
    interpolated over decibels. Raises ``InvalidInput`` for a single frame, and where x264 has no
    CRF of that quality.
    """
    if len(frames) < 2:
        raise InvalidInput("against_x264", "needs two frames: the first is not compared")
    rival, wanted_db = x264_with_our_tools("medium"), ours.psnr_db()
    low, high = rival.limits
    finer, coarser = (rival.code(frames, rate_hz, crf) for crf in (low, high))
    if not coarser.psnr_db() <= wanted_db <= finer.psnr_db() or math.isinf(wanted_db):
        raise InvalidInput(
            "against_x264",
            f"{wanted_db:.2f} dB are outside x264's {coarser.psnr_db():.2f}.."
            f"{finer.psnr_db():.2f} dB; choose another --crf",
        )
    while coarser.point - finer.point > 1:
        between = rival.code(frames, rate_hz, (coarser.point + finer.point) // 2)
        finer, coarser = (between, coarser) if between.psnr_db() >= wanted_db else (finer, between)
    qualities_db = coarser.psnr_db(), finer.psnr_db()
    log_bytes = [math.log(clip.bytes_per_frame()) for clip in (coarser, finer)]
    equal_bytes = math.exp(float(np.interp(wanted_db, qualities_db, log_bytes)))
    return 100 * (ours.bytes_per_frame() / equal_bytes - 1)


def x265_lowdelay(preset: str) -> Rival:
    """Return x265 with ``tune=zerolatency``, one key frame."""
    return _x265(f"x265-lowdelay-{preset}", preset, {})


def x265_for_psnr(preset: str) -> Rival:
    """Return the same as ``tune=psnr`` would have it; x265 takes one tune only."""
    tuned = {"aq-mode": "0", "psy-rd": "0", "psy-rdoq": "0"}
    return _x265(f"x265-lowdelay-psnr-{preset}", preset, tuned)


def x265_for_ssim(preset: str) -> Rival:
    """Return the same as ``tune=ssim`` would have it: adaptive quantisation, nothing for looks."""
    tuned = {"aq-mode": "2", "psy-rd": "0", "psy-rdoq": "0"}
    return _x265(f"x265-lowdelay-ssim-{preset}", preset, tuned)


def _x265(name: str, preset: str, params: Mapping[str, str]) -> Rival:
    options = {
        "keyint": "-1",
        "scenecut": "0",
        "log-level": "none",
        "pools": "none",
        "frame-threads": "1",
        **params,
    }
    return Rival(
        name,
        "libx265",
        "hevc",
        {"preset": preset, "tune": "zerolatency", "x265-params": _joined(options)},
        X265_CRFS,
    )


def svtav1_lowdelay(preset: int) -> Rival:
    """Return SVT-AV1 with ``pred-struct=1`` (low delay), one key frame."""
    options = {"pred-struct": "1", "keyint": "-1", "lp": "1", "rc": "0"}
    return Rival(
        f"svtav1-lowdelay-p{preset}",
        "libsvtav1",
        "libdav1d",
        {"preset": str(preset), "svtav1-params": _joined(options)},
        SVT_CRFS,
        SVT_LIMITS,
    )


def decoded_pictures(codec: str, packets: Sequence[bytes]) -> list[I420]:
    """Return the pictures that FFmpeg's decoder ``codec`` makes of packets, on one thread."""
    decoder = _decoder(codec)
    frames = [frame for packet in packets for frame in decoder.decode(av.Packet(packet))]
    return [picture_of(frame) for frame in (*frames, *decoder.decode(None))]


def _decoder(codec: str) -> av.VideoCodecContext:
    decoder = _opened(codec, "r")
    decoder.thread_count = 1
    return decoder


def _opened(codec: str, mode: Literal["r", "w"]) -> av.VideoCodecContext:
    """PyAV knows only some codec names to be of video."""
    return cast(av.VideoCodecContext, av.CodecContext.create(codec, mode))


def _joined(options: Mapping[str, str]) -> str:
    return ":".join(f"{name}={value}" for name, value in options.items())
