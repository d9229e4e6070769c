"""The report of a demo: one HTML file with tables, charts and pictures.

The terminal shows the summary of the same ``result.json``.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from rfedge.demo.measure import DriveFigures, FrameFigures, Pictures
from rfedge.report.charts import (
    DIFFERENCE_GAIN,
    amplified_difference,
    bytes_chart,
    embedded,
    quality_chart,
    stages_chart,
)
from rfedge.report.page import write_page
from rfedge.results import Result, as_json, rows_of


def figures_of(result: Result) -> dict[str, DriveFigures]:
    """Return the figures of each drive in a demo's result; raises as ``rows_of``."""
    sequences = result["sequences"]
    drives = rows_of(DriveFigures, sequences.values())
    return dict(zip(sequences, drives, strict=True))


SUMMARY: tuple[tuple[str, str, Callable[[DriveFigures], str]], ...] = (
    (
        "Saving against low-delay x264",
        "at equal quality (RGB PSNR), whole packets on both sides, x264 tuned for PSNR",
        lambda drive: f"{drive.saving_vs_x264_percent:.1f} %",
    ),
    (
        "Saving against I pictures",
        "at equal quality (RGB PSNR), our whole packets against their bare slices",
        lambda drive: f"{drive.saving_vs_intra_percent:.1f} %",
    ),
    (
        "Frames reconstructed",
        "of those sent",
        lambda drive: f"{drive.frames_reconstructed} of {drive.frames}",
    ),
    (
        "Digests that match",
        "server's picture = vehicle's closed loop, byte for byte",
        lambda drive: f"{drive.digest_matches} of {drive.frames}",
    ),
    (
        "Quality of the reconstruction",
        "mean RGB PSNR; SSIM",
        lambda drive: f"{drive.psnr_db:.2f} dB; {drive.ssim:.3f}",
    ),
    ("Quality of the render alone", "mean RGB PSNR", lambda drive: f"{drive.rf_psnr_db:.2f} dB"),
    (
        "Payload / packet / wire",
        "kB over the drive",
        lambda drive: (
            f"{drive.payload_bytes / 1e3:.1f} / {drive.packet_bytes / 1e3:.1f} / "
            f"{drive.wire_bytes / 1e3:.1f}"
        ),
    ),
    (
        "Savings as published",
        "100·I/(I+P) of a two-frame clip",
        lambda drive: f"{drive.paper_savings_percent:.1f} %",
    ),
    (
        "Latency",
        "picture in memory to acknowledged, p50 / p99",
        lambda drive: f"{drive.latency_ms['p50']:.0f} / {drive.latency_ms['p99']:.0f} ms",
    ),
    (
        "Link timing error",
        "measured busy time against bytes / throughput",
        lambda drive: f"{drive.link_tau_error_percent:+.2f} %",
    ),
)
"""Label, note and value of each row of the summary."""
METRIC: tuple[tuple[str, Callable[[DriveFigures], float]], ...] = (
    ("the field's render", lambda drive: drive.paper_savings_percent),
    (
        "a render of another place on the street",
        lambda drive: drive.paper_savings_percent_wrong_street,
    ),
    ("a grey picture", lambda drive: drive.paper_savings_percent_grey),
)
"""The published metric with references that show ever less of the place."""


def print_summary(console: Console, result: Result, out: Path) -> None:
    """Print the summary and where the files are."""
    drives = figures_of(result)
    table = Table(title="Vehicle to edge server", title_justify="left")
    table.add_column("")
    for name in drives:
        table.add_column(name, justify="right")
    for label, note, show in SUMMARY:
        table.add_row(f"{label}\n[dim]{note}[/]", *(show(drive) for drive in drives.values()))
    console.print(table)
    for name in ("report.html", "reconstructed.mp4", "result.json"):
        console.print(f"  {out / name}")


PROVENANCE = ("command", "revision", "dirty", "host", "settings", "field")


def write_report(
    path: Path,
    result: Result,
    pictures: Mapping[str, Sequence[Pictures]],
    video: Path | None = None,
) -> None:
    """Write the page of one demo run.

    ``result`` is the content of ``result.json``; ``pictures`` the frames of each of its sequences;
    ``video`` an MP4 file to embed.
    """
    drives = figures_of(result)
    write_page(
        path,
        "demo/report.html.j2",
        _headline(drives),
        {key: result[key] for key in PROVENANCE},
        gain=DIFFERENCE_GAIN,
        video=base64.b64encode(video.read_bytes()).decode() if video is not None else None,
        result=result,
        summary=[
            {"label": label, "note": note, "values": [show(drive) for drive in drives.values()]}
            for label, note, show in SUMMARY
        ],
        metric_rows=[
            {"label": label, "values": [f"{show(drive):.1f}" for drive in drives.values()]}
            for label, show in METRIC
        ],
        sequences=[_sequence(name, drive, pictures[name]) for name, drive in drives.items()],
    )


def _headline(drives: Mapping[str, DriveFigures]) -> str:
    savings = (
        ("low-delay x264", {name: d.saving_vs_x264_percent for name, d in drives.items()}),
        ("I pictures", {name: d.saving_vs_intra_percent for name, d in drives.items()}),
    )
    parts = []
    for rival, percent in savings:
        shown = ", ".join(f"{value:.0f} % ({name})" for name, value in percent.items())
        parts.append(f"than {rival}: {shown}")
    return "Fewer bytes at equal quality " + "; ".join(parts)


def _sequence(name: str, drive: DriveFigures, pictures: Sequence[Pictures]) -> dict[str, Any]:
    frames = rows_of(FrameFigures, as_json(drive.per_frame))
    return {
        "name": name,
        "bytes_svg": bytes_chart(
            [frame.payload_bytes for frame in frames], [frame.packet_bytes for frame in frames]
        ),
        "quality_svg": quality_chart(
            [frame.psnr_db for frame in frames], [frame.rf_psnr_db for frame in frames]
        ),
        "stages_svg": stages_chart(drive.stage_ms),
        "frames": [_frame(frame, shown) for frame, shown in zip(frames, pictures, strict=True)],
        "strips": [_strip(frames[i], pictures[i]) for i in _shown(frames)],
    }


def _frame(frame: FrameFigures, pictures: Pictures) -> dict[str, str]:
    """Return what the page's player shows of a frame."""
    said = (
        f"{frame.name}: reconstruction {frame.psnr_db:.2f} dB, render {frame.rf_psnr_db:.2f} dB, "
        f"{frame.packet_bytes:,} bytes"
    )
    camera, reconstruction = embedded(
        (("camera", pictures.camera), ("reconstruction", pictures.reconstruction))
    )
    return {
        "said": said,
        "camera": camera["data"],
        "reconstruction": reconstruction["data"],
    }


def _shown(frames: Sequence[FrameFigures]) -> list[int]:
    """First frame, the worst one, the last one."""
    worst = min(range(len(frames)), key=lambda i: frames[i].psnr_db)
    return sorted({0, worst, len(frames) - 1})


def _strip(frame: FrameFigures, pictures: Pictures) -> dict[str, Any]:
    difference = amplified_difference(pictures.reconstruction, pictures.camera)
    captions = (
        (f"camera, frame {pictures.name}", pictures.camera),
        (f"render, {frame.rf_psnr_db:.1f} dB", pictures.render),
        (
            f"reconstruction, {frame.psnr_db:.1f} dB, {frame.packet_bytes:,} bytes",
            pictures.reconstruction,
        ),
        (f"difference to the camera × {DIFFERENCE_GAIN}", difference),
    )
    return {
        "frame": pictures.name,
        "pictures": embedded(captions),
    }
