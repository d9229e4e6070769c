"""Measure one drive of the demo: the server's pictures against the camera's.

PSNR and SSIM are means over the pictures, in RGB and at the true size, against the camera's own
pixels: for the reconstruction, for the render, and for the encoders that we compare with.

Two savings at equal PSNR are measured: against the camera frames coded as I pictures, and against
low-delay x264 tuned for PSNR, which predicts each frame from the one before. Both rivals are coded
at several CRFs. Between them log(bytes) is interpolated linearly over decibels, because rate curves
of video are close to straight there. A quality outside the curve is refused.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.ffmpeg import EncoderOptions, H264Decoder, PictureKind, encode_pictures
from rfcore.errors import InvalidInput
from rfcore.image import I420, Rgb
from rfcore.metrics import psnr, ssim
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfedge.evaluate.rivals import Rival, x264_for_psnr
from rfedge.evaluate.savings import paper_savings, slice_nals

MIN_POINTS = 4
Quality = Callable[[I420, I420], float]


@dataclass(frozen=True)
class RatePoint:
    """Means over the frames at one CRF: bytes, and the quality in decibels."""

    crf: float
    mean_bytes: float
    mean_psnr_db: float


def intra_curve(
    frames: Sequence[I420], preset: str, crfs: Sequence[float], quality: Quality
) -> tuple[RatePoint, ...]:
    """Code each frame as an I picture at each CRF; return one point a CRF, best quality first.

    Bytes are those of the slices, without start codes. ``quality`` compares (decoded, frame) in
    decibels; it must be the measure at which savings are then asked for.

    Raises ``InvalidInput`` without frames, or for what ``CodecConfig`` refuses.
    """
    if not frames:
        raise InvalidInput("frames", "an intra curve needs at least one frame")
    return tuple(_intra_point(frames, preset, crf, quality) for crf in sorted(crfs))


def _intra_point(frames: Sequence[I420], preset: str, crf: float, quality: Quality) -> RatePoint:
    config = CodecConfig(*frames[0].size_px, effort_of_preset(preset), crf)
    options = EncoderOptions(config.coded_size_px, preset, crf, params={"keyint": "1"})
    units = encode_pictures(options, [(frame, PictureKind.I) for frame in frames])
    sizes = [sum(map(len, slice_nals(unit))) for unit in units]
    decoder = H264Decoder(config.coded_size_px)
    qualities = [
        quality(decoder.decode(unit).cropped(config.size_px), frame)
        for unit, frame in zip(units, frames, strict=True)
    ]
    return RatePoint(crf, float(np.mean(sizes)), float(np.mean(qualities)))


def rival_curve(
    frames: Sequence[I420], rival: Rival, rate_hz: float, crfs: Sequence[float], quality: Quality
) -> tuple[RatePoint, ...]:
    """Code the frames as one clip at each CRF, as ``intra_curve`` does; bytes are whole packets.

    Raises ``InvalidInput`` without frames, ``CodecError`` if the encoder fails or delays a frame.
    """
    if not frames:
        raise InvalidInput("frames", "a rate curve needs at least one frame")
    points = []
    for crf in sorted(crfs):
        made = rival.pictures(frames, rate_hz, crf)
        qualities = [quality(*pair) for pair in zip(made.decoded, frames, strict=True)]
        point = RatePoint(crf, float(np.mean(made.frame_bytes)), float(np.mean(qualities)))
        points.append(point)
    return tuple(points)


def saving_at_equal_psnr(curve: Sequence[RatePoint], coded_bytes: float, psnr_db: float) -> float:
    """Return 100 (1 - coded_bytes / the curve's bytes at the same ``psnr_db``), in percent.

    Raises ``InvalidInput`` for fewer than 4 points, a curve that is not strictly rising in both
    bytes and quality, or a quality outside it.
    """
    points = sorted(curve, key=lambda point: point.mean_psnr_db)
    qualities = np.array([point.mean_psnr_db for point in points])
    log_bytes = np.log([point.mean_bytes for point in points])
    if len(points) < MIN_POINTS:
        raise InvalidInput("curve", f"{len(points)} points where {MIN_POINTS} are needed")
    if not (np.isfinite(qualities).all() and (np.diff(qualities) > 0).all()):
        raise InvalidInput("curve", f"qualities {qualities} must be finite and distinct")
    if not (np.diff(log_bytes) > 0).all():
        raise InvalidInput("curve", "bytes must rise with quality; take CRFs further apart")
    if not (coded_bytes > 0 and qualities[0] <= psnr_db <= qualities[-1]):
        raise InvalidInput(
            "psnr_db",
            f"{psnr_db:.2f} dB at {coded_bytes:g} bytes is outside the curve's "
            f"{qualities[0]:.2f}..{qualities[-1]:.2f} dB; code the rival at more CRFs",
        )
    curve_bytes = math.exp(float(np.interp(psnr_db, qualities, log_bytes)))
    return 100.0 * (1.0 - coded_bytes / curve_bytes)


FrameAddress = tuple[int, int]
"""(epoch, sequence)"""
INTRA_CRFS = (14.0, 18.0, 22.0, 26.0, 30.0, 34.0)
X264_CRFS = (10.0, *INTRA_CRFS, 38.0)


@dataclass(frozen=True)
class Pictures:
    """One frame's pictures, uint8 [H, W, 3]."""

    name: str
    camera: Rgb
    render: Rgb
    reconstruction: Rgb


@dataclass(frozen=True)
class DriveOutcome:
    """Reports of the processes about one drive, and the settings of its coding."""

    agent_rows: Sequence[Mapping[str, Any]]
    """The agent's report, a row a frame, in order."""
    server_digests: Mapping[FrameAddress, str]
    """The digest of each picture that the server wrote."""
    link: Mapping[str, Any]
    """The link's report."""
    pictures: Sequence[Pictures]
    """The frames that the server reconstructed."""
    elsewhere: Rgb
    """A render of the same field at another place."""
    preset: str
    crf: float
    rate_hz: float


@dataclass(frozen=True)
class FrameFigures:
    """One frame: bytes, quality of reconstruction and render, and where the time went."""

    name: str
    sequence: int
    payload_bytes: int
    packet_bytes: int
    psnr_db: float
    ssim: float
    rf_psnr_db: float
    """PSNR of the render alone."""
    latency_ms: float
    """Time from the picture in memory to its Ack."""
    stage_ms: Mapping[str, float]


@dataclass(frozen=True)
class DriveFigures:
    """One drive: bytes are sums, qualities are means over the frames that were reconstructed."""

    frames: int
    frames_reconstructed: int
    digest_matches: int
    payload_bytes: int
    packet_bytes: int
    wire_bytes: int
    """Bytes that the link carried from the vehicle."""
    psnr_db: float
    ssim: float
    rf_psnr_db: float
    paper_savings_percent: float
    """100 I / (I + P) of a two-frame clip, with the field's render as I."""
    paper_savings_percent_wrong_street: float
    """The same with a render of another place, and below with a grey picture."""
    paper_savings_percent_grey: float
    saving_vs_intra_percent: float
    """Saving at equal PSNR against I pictures."""
    latency_ms: Mapping[str, float]
    """Percentiles ``p50`` and ``p99``."""
    link_tau_error_percent: float
    """The link's busy time against bytes / throughput."""
    stage_ms: Mapping[str, float]
    """Median of each stage."""
    per_frame: Sequence[FrameFigures]
    saving_vs_x264_percent: float
    """Saving at equal PSNR against low-delay x264."""
    x264_setting: str


def measure_drive(outcome: DriveOutcome) -> DriveFigures:
    """Return the drive's entry of ``result.json``.

    Raises ``InvalidInput`` when the reconstruction's quality is outside what a rival reaches.
    """
    rows = {row["name"]: row for row in outcome.agent_rows}  # a lost picture is captured again
    frames = [_measure_frame(rows[pictures.name], pictures) for pictures in outcome.pictures]
    packet_bytes = sum(frame.packet_bytes for frame in frames)
    psnr_db = statistics.fmean(frame.psnr_db for frame in frames)
    cameras = [pictures.camera for pictures in outcome.pictures]
    rivals = Rivals(cameras, outcome.preset, outcome.rate_hz)
    return DriveFigures(
        frames=len(rows),
        frames_reconstructed=len(outcome.pictures),
        digest_matches=_digest_matches(outcome),
        payload_bytes=sum(frame.payload_bytes for frame in frames),
        packet_bytes=packet_bytes,
        wire_bytes=outcome.link["uplink"]["bytes"],
        psnr_db=psnr_db,
        ssim=statistics.fmean(frame.ssim for frame in frames),
        rf_psnr_db=statistics.fmean(frame.rf_psnr_db for frame in frames),
        **_published_metric(outcome),
        saving_vs_intra_percent=rivals.saving_vs_intra(packet_bytes / len(frames), psnr_db),
        latency_ms=_percentiles([frame.latency_ms for frame in frames]),
        link_tau_error_percent=outcome.link["uplink"]["tau_error_percent"],
        stage_ms=_median_stages(frames),
        per_frame=frames,
        saving_vs_x264_percent=rivals.saving_vs_x264(packet_bytes / len(frames), psnr_db),
        x264_setting=rivals.x264.name,
    )


def _measure_frame(row: Mapping[str, Any], pictures: Pictures) -> FrameFigures:
    return FrameFigures(
        name=pictures.name,
        sequence=row["sequence"],
        payload_bytes=row["payload_bytes"],
        packet_bytes=row["packet_bytes"],
        psnr_db=psnr(pictures.reconstruction, pictures.camera),
        ssim=ssim(pictures.reconstruction, pictures.camera),
        rf_psnr_db=psnr(pictures.render, pictures.camera),
        latency_ms=row["latency_ms"],
        stage_ms=row["stage_ms"],
    )


def _digest_matches(outcome: DriveOutcome) -> int:
    """Count the pictures that the server wrote with the digest that the vehicle sent a part of."""
    shown = (
        (row, outcome.server_digests.get((row["epoch"], row["sequence"]), ""))
        for row in outcome.agent_rows
    )
    return sum(made.startswith(row["reconstruction_digest"] or "no slice") for row, made in shown)


def _published_metric(outcome: DriveOutcome) -> dict[str, float]:
    """Return the paper's figure with the render, and with two that know nothing of the place."""
    grey = np.full_like(outcome.elsewhere, 128)
    savings: dict[str, list[float]] = {"": [], "_wrong_street": [], "_grey": []}
    for pictures in outcome.pictures:
        camera = i420_from_rgb(pictures.camera)
        references = (pictures.render, outcome.elsewhere, grey)
        for reference, found in zip(references, savings.values(), strict=True):
            shown = i420_from_rgb(reference)
            found.append(paper_savings(camera, shown, outcome.preset, outcome.crf).percent)
    return {
        f"paper_savings_percent{name}": statistics.fmean(found) for name, found in savings.items()
    }


@dataclass(frozen=True)
class Rivals:
    """The camera frames of a drive, coded by other encoders at the drive's preset and rate."""

    cameras: Sequence[Rgb]
    preset: str
    rate_hz: float

    @property
    def x264(self) -> Rival:
        """Low-delay x264, tuned for the measure of the comparison."""
        return x264_for_psnr(self.preset)

    def saving_vs_intra(self, packet_bytes: float, psnr_db: float) -> float:
        """Return the bytes saved against I pictures of the same mean RGB PSNR, in percent.

        Ours are whole packets, theirs bare slices: no header is held against the I pictures.
        """
        curve = intra_curve(self._frames, self.preset, INTRA_CRFS, self._rgb_psnr_db)
        return saving_at_equal_psnr(curve, packet_bytes, psnr_db)

    def saving_vs_x264(self, packet_bytes: float, psnr_db: float) -> float:
        """Return the bytes saved against low-delay x264; every frame counts, the first too."""
        curve = rival_curve(self._frames, self.x264, self.rate_hz, X264_CRFS, self._rgb_psnr_db)
        return saving_at_equal_psnr(curve, packet_bytes, psnr_db)

    @cached_property
    def _frames(self) -> list[I420]:
        return [i420_from_rgb(camera) for camera in self.cameras]

    @cached_property
    def _camera_of(self) -> dict[bytes, Rgb]:
        digests = (frame.digest() for frame in self._frames)
        return dict(zip(digests, self.cameras, strict=True))

    def _rgb_psnr_db(self, decoded: I420, frame: I420) -> float:
        return psnr(rgb_from_i420(decoded), self._camera_of[frame.digest()])


def _median_stages(frames: Sequence[FrameFigures]) -> dict[str, float]:
    return {
        stage: statistics.median(frame.stage_ms[stage] for frame in frames)
        for stage in frames[0].stage_ms
    }


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    return {"p50": float(np.percentile(values, 50)), "p99": float(np.percentile(values, 99))}
