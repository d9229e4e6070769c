"""The rows of a demo's tables, shared by the page, the terminal and the docs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["METRIC", "SUMMARY"]

Entry = Mapping[str, Any]


def _frames(key: str) -> Callable[[Entry], str]:
    return lambda entry: f"{entry[key]} of {entry['frames']}"


def _kilobytes(entry: Entry) -> str:
    return " / ".join(
        f"{entry[key] / 1e3:.1f}" for key in ("payload_bytes", "packet_bytes", "wire_bytes")
    )


def _latency(entry: Entry) -> str:
    return f"{entry['latency_ms']['p50']:.0f} / {entry['latency_ms']['p99']:.0f} ms"


SUMMARY: tuple[tuple[str, str, Callable[[Entry], str]], ...] = (
    ("Frames reconstructed", "of those sent", _frames("frames_reconstructed")),
    (
        "Digests that match",
        "server's picture = vehicle's closed loop, byte for byte",
        _frames("digest_matches"),
    ),
    (
        "Quality of the reconstruction",
        "mean RGB PSNR; SSIM",
        lambda entry: f"{entry['psnr_db']:.2f} dB; {entry['ssim']:.3f}",
    ),
    (
        "Quality of the render alone",
        "mean RGB PSNR",
        lambda entry: f"{entry['rf_psnr_db']:.2f} dB",
    ),
    ("Payload / packet / wire", "kB over the drive", _kilobytes),
    (
        "Saving against I pictures",
        "at equal PSNR, whole packets",
        lambda entry: f"{entry['saving_vs_intra_percent']:.1f} %",
    ),
    (
        "Savings as published",
        "100·I/(I+P) of a two-frame clip",
        lambda entry: f"{entry['paper_savings_percent']:.1f} %",
    ),
    ("Latency", "picture in memory to acknowledged, p50 / p99", _latency),
    (
        "Link timing error",
        "measured busy time against bytes / throughput",
        lambda entry: f"{entry['link_tau_error_percent']:+.2f} %",
    ),
)

METRIC: tuple[tuple[str, str], ...] = (
    ("the field's render", "paper_savings_percent"),
    ("a render of another place on the street", "paper_savings_percent_wrong_street"),
    ("a grey picture", "paper_savings_percent_grey"),
)
