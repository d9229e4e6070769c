"""Measure one drive of the demo: what the server showed against what the camera saw.

All PSNR and SSIM figures are means over pictures of the RGB metric on the true size, against the
camera's own pixels, for the reconstruction, for the render, and for the intra baseline alike.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rfcore.codec.intra import intra_curve, saving_at_equal_psnr
from rfcore.codec.paper import paper_savings_percent
from rfcore.image import I420, Rgb
from rfcore.metrics import psnr, ssim
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420

__all__ = ["DriveOutcome", "FrameAddress", "Pictures", "measure_drive"]

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
