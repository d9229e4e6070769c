"""Measure one drive of the demo: what the server showed against what the camera saw.

All PSNR and SSIM figures are means over pictures of the RGB metric on the true size, against the
camera's own pixels, for the reconstruction, for the render, and for the intra baseline alike.

Savings at equal quality: what the camera frames cost as I pictures of the same PSNR.

An intra curve holds the mean bytes and mean quality of frames coded as I pictures at several CRFs.
Between its points, log(bytes) is interpolated linearly over the quality in decibels, as rate
curves of video are close to straight there. Outside its points it says nothing.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.ffmpeg import EncoderOptions, H264Decoder, PictureKind, encode_pictures
from rfcore.errors import InvalidInput
from rfcore.image import I420, Rgb
from rfcore.metrics import psnr, ssim
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfedge.experiments.paper.published import paper_savings_percent, slice_nals

__all__ = [
    "DriveOutcome",
    "FrameAddress",
    "IntraPoint",
    "Pictures",
    "intra_curve",
    "luma_psnr_db",
    "measure_drive",
    "saving_at_equal_psnr",
]


MIN_POINTS = 4
Quality = Callable[[I420, I420], float]


@dataclass(frozen=True)
class IntraPoint:
    """Means over the frames: slice bytes without start codes, and the quality in decibels."""

    crf: float
    mean_bytes: float
    mean_psnr_db: float


def luma_psnr_db(a: I420, b: I420) -> float:
    """Return the PSNR of the luma planes, peak 255; infinite for identical planes."""
    return psnr(a.y, b.y)


def intra_curve(
    frames: Sequence[I420], preset: str, crfs: Sequence[float], quality: Quality = luma_psnr_db
) -> tuple[IntraPoint, ...]:
    """Code each frame as an I picture at each CRF; one point per CRF, best quality first.

    ``quality`` compares (decoded, frame) in decibels and must be the measure the saving is asked
    for. Raises ``InvalidInput`` without frames, or for what ``CodecConfig`` refuses.
    """
    if not frames:
        raise InvalidInput("frames", "an intra curve needs at least one frame")
    return tuple(_point(frames, preset, crf, quality) for crf in sorted(crfs))


def saving_at_equal_psnr(curve: Sequence[IntraPoint], coded_bytes: float, psnr_db: float) -> float:
    """Return 100 (1 - coded_bytes / intra bytes at the same ``psnr_db``), in percent.

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
            f"{qualities[0]:.2f}..{qualities[-1]:.2f} dB; code I pictures at more CRFs",
        )
    intra_bytes = math.exp(float(np.interp(psnr_db, qualities, log_bytes)))
    return 100.0 * (1.0 - coded_bytes / intra_bytes)


def _point(frames: Sequence[I420], preset: str, crf: float, quality: Quality) -> IntraPoint:
    config = CodecConfig(*frames[0].size_px, preset=preset, crf=crf)
    options = EncoderOptions(config.coded_size_px, preset, crf, params={"keyint": "1"})
    units = encode_pictures(options, [(frame, PictureKind.I) for frame in frames])
    sizes = [sum(map(len, slice_nals(unit))) for unit in units]
    decoder = H264Decoder(config.coded_size_px)
    qualities = [
        quality(_cropped(decoder.decode(unit), config), frame)
        for unit, frame in zip(units, frames, strict=True)
    ]
    return IntraPoint(crf, float(np.mean(sizes)), float(np.mean(qualities)))


def _cropped(picture: I420, config: CodecConfig) -> I420:
    width_px, height_px = config.size_px
    return I420(picture.y[:height_px, :width_px], picture.u, picture.v)


FrameAddress = tuple[int, int]
"""(epoch, sequence)"""
INTRA_CRFS = (14.0, 18.0, 22.0, 26.0, 30.0, 34.0)


@dataclass(frozen=True)
class Pictures:
    """One frame's pictures, uint8 [H, W, 3]."""

    name: str
    camera: Rgb
    render: Rgb
    reconstruction: Rgb


@dataclass(frozen=True)
class DriveOutcome:
    """What the processes reported of one drive.

    ``agent_rows``: one mapping a frame, in order, from the agent's report; ``server_digests``: the
    digest of each picture the server wrote; ``link``: the link's report;
    ``pictures``: the frames the server reconstructed; ``wrong_street``: a render of the same field
    somewhere else.
    """

    agent_rows: Sequence[Mapping[str, Any]]
    server_digests: Mapping[FrameAddress, str]
    link: Mapping[str, Any]
    pictures: Sequence[Pictures]
    wrong_street: Rgb
    preset: str
    crf: float


def measure_drive(outcome: DriveOutcome) -> dict[str, Any]:
    """Return the drive's entry of ``result.json``."""
    rows = {row["name"]: row for row in outcome.agent_rows}  # a lost picture is captured again
    frames = [_measure_frame(rows[pictures.name], pictures) for pictures in outcome.pictures]
    packet_bytes = sum(frame["packet_bytes"] for frame in frames)
    psnr_db = statistics.fmean(frame["psnr_db"] for frame in frames)
    return {
        "frames": len(rows),
        "frames_reconstructed": len(outcome.pictures),
        "digest_matches": _digest_matches(outcome),
        "payload_bytes": sum(frame["payload_bytes"] for frame in frames),
        "packet_bytes": packet_bytes,
        "wire_bytes": outcome.link["uplink"]["bytes"],
        "psnr_db": psnr_db,
        "ssim": statistics.fmean(frame["ssim"] for frame in frames),
        "rf_psnr_db": statistics.fmean(frame["rf_psnr_db"] for frame in frames),
        **_published_metric(outcome),
        "saving_vs_intra_percent": _saving_vs_intra(outcome, packet_bytes, psnr_db),
        "latency_ms": _percentiles([frame["latency_ms"] for frame in frames]),
        "link_tau_error_percent": outcome.link["uplink"]["tau_error_percent"],
        "stage_ms": _median_stages(frames),
        "per_frame": frames,
    }


def _measure_frame(row: Mapping[str, Any], pictures: Pictures) -> dict[str, Any]:
    return {
        "name": pictures.name,
        "sequence": row["sequence"],
        "payload_bytes": row["payload_bytes"],
        "packet_bytes": row["packet_bytes"],
        "psnr_db": psnr(pictures.reconstruction, pictures.camera),
        "ssim": ssim(pictures.reconstruction, pictures.camera),
        "rf_psnr_db": psnr(pictures.render, pictures.camera),
        "latency_ms": row["latency_ms"],
        "stage_ms": row["stage_ms"],
    }


def _digest_matches(outcome: DriveOutcome) -> int:
    return sum(
        outcome.server_digests.get((row["epoch"], row["sequence"])) == row["reconstruction_digest"]
        for row in outcome.agent_rows
    )


def _published_metric(outcome: DriveOutcome) -> dict[str, float]:
    """The paper's figure, with the render and with two renders that know nothing of the place."""
    grey = np.full_like(outcome.wrong_street, 128)
    savings: dict[str, list[float]] = {"render": [], "wrong_street": [], "grey": []}
    for pictures in outcome.pictures:
        camera = i420_from_rgb(pictures.camera)
        stand_ins = {
            "render": pictures.render,
            "wrong_street": outcome.wrong_street,
            "grey": grey,
        }
        for name, picture in stand_ins.items():
            savings[name].append(
                paper_savings_percent(camera, i420_from_rgb(picture), outcome.preset, outcome.crf)
            )
    return {
        "paper_savings_percent": statistics.fmean(savings["render"]),
        "paper_savings_percent_wrong_street": statistics.fmean(savings["wrong_street"]),
        "paper_savings_percent_grey": statistics.fmean(savings["grey"]),
    }


def _saving_vs_intra(outcome: DriveOutcome, packet_bytes: int, psnr_db: float) -> float:
    """Bytes saved against the camera coded as I pictures of the same mean RGB PSNR.

    Ours are whole packets, theirs bare slices: no header is held against the I pictures.
    """
    cameras = {
        i420_from_rgb(pictures.camera).digest(): pictures.camera for pictures in outcome.pictures
    }

    def rgb_psnr_db(decoded: I420, frame: I420) -> float:
        return psnr(rgb_from_i420(decoded), cameras[frame.digest()])

    frames = [i420_from_rgb(pictures.camera) for pictures in outcome.pictures]
    curve = intra_curve(frames, outcome.preset, INTRA_CRFS, rgb_psnr_db)
    return saving_at_equal_psnr(curve, packet_bytes / len(frames), psnr_db)


def _median_stages(frames: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    return {
        stage: statistics.median(frame["stage_ms"][stage] for frame in frames)
        for stage in frames[0]["stage_ms"]
    }


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    return {"p50": float(np.percentile(values, 50)), "p99": float(np.percentile(values, 99))}
