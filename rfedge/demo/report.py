"""Fill the report's template: tables, charts and pictures, all inside one file.

The rows of a demo's tables, shared by the page, the terminal and the docs.

The summary table on the terminal.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from rich.console import Console
from rich.table import Table

from rfcore.files import write_whole
from rfedge.demo.measure import Pictures
from rfedge.report.charts import (
    DIFFERENCE_GAIN,
    amplified_difference,
    bytes_chart,
    embedded,
    quality_chart,
    stages_chart,
)

__all__ = ["METRIC", "SUMMARY", "print_table", "write_report"]


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


def print_table(console: Console, result: Mapping[str, Any], out: Path) -> None:
    """Print the report's summary table and where the files are."""
    sequences = result["sequences"]
    table = Table(title="Vehicle to edge server", title_justify="left")
    table.add_column("")
    for name in sequences:
        table.add_column(name, justify="right")
    for label, note, show in SUMMARY:
        table.add_row(f"{label}\n[dim]{note}[/]", *(show(entry) for entry in sequences.values()))
    console.print(table)
    for name in ("report.html", "reconstructed.mp4", "result.json"):
        console.print(f"  {out / name}")


def write_report(
    path: Path, result: Mapping[str, Any], pictures: Mapping[str, Sequence[Pictures]]
) -> None:
    """Write the page of one demo run.

    ``result`` is the content of ``result.json``; ``pictures`` the frames of each of its sequences.
    """
    environment = Environment(
        loader=PackageLoader("rfedge.demo", "."), autoescape=True, undefined=StrictUndefined
    )
    sequences = result["sequences"]
    page = environment.get_template("report.html.j2").render(
        headline=_headline(sequences),
        result=result,
        summary=[
            {"label": label, "note": note, "values": [show(s) for s in sequences.values()]}
            for label, note, show in SUMMARY
        ],
        metric_rows=[
            {"label": label, "values": [f"{s[key]:.1f}" for s in sequences.values()]}
            for label, key in METRIC
        ],
        sequences=[_sequence(name, sequences[name], pictures[name]) for name in sequences],
        provenance=json.dumps(
            {key: result[key] for key in ("command", "revision", "host", "settings", "field")},
            indent=2,
        ),
    )
    write_whole(path, page)


def _headline(sequences: Mapping[str, Any]) -> str:
    parts = [f"{s['saving_vs_intra_percent']:.0f} % ({name})" for name, s in sequences.items()]
    return "Fewer bytes than I pictures at equal quality: " + ", ".join(parts)


def _sequence(name: str, entry: Mapping[str, Any], pictures: Sequence[Pictures]) -> dict[str, Any]:
    frames = entry["per_frame"]
    return {
        "name": name,
        "bytes_svg": bytes_chart(frames),
        "quality_svg": quality_chart(frames),
        "stages_svg": stages_chart(entry["stage_ms"]),
        "strips": [_strip(frames[i], pictures[i]) for i in _shown(frames)],
    }


def _shown(frames: Sequence[Mapping[str, Any]]) -> list[int]:
    """First frame, the worst one, the last one."""
    worst = min(range(len(frames)), key=lambda i: frames[i]["psnr_db"])
    return sorted({0, worst, len(frames) - 1})


def _strip(frame: Mapping[str, Any], pictures: Pictures) -> dict[str, Any]:
    difference = amplified_difference(pictures.reconstruction, pictures.camera)
    captions = (
        (f"camera, frame {pictures.name}", pictures.camera),
        (f"render, {frame['rf_psnr_db']:.1f} dB", pictures.render),
        (
            f"reconstruction, {frame['psnr_db']:.1f} dB, {frame['packet_bytes']:,} bytes",
            pictures.reconstruction,
        ),
        (f"difference to the camera × {DIFFERENCE_GAIN}", difference),
    )
    return {
        "frame": pictures.name,
        "pictures": embedded(captions),
    }
