"""Fill the report's template: tables, charts and pictures, all inside one file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from rfcore.files import write_whole
from rfedge.demo.measure import Pictures
from rfedge.report.figures import bytes_chart, quality_chart, stages_chart
from rfedge.report.strip import DIFFERENCE_GAIN, amplified_difference, embedded
from rfedge.report.summary import METRIC, SUMMARY

__all__ = ["write_report"]


def write_report(
    path: Path, result: Mapping[str, Any], pictures: Mapping[str, Sequence[Pictures]]
) -> None:
    """Write the page of one demo run.

    ``result`` is the content of ``result.json``; ``pictures`` the frames of each of its sequences.
    """
    environment = Environment(
        loader=PackageLoader("rfedge.report", "."), autoescape=True, undefined=StrictUndefined
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
