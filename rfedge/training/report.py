"""The page of one training run: held-out pictures beside their renders, and quality over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.dataset import Dataset
from rfcore.field import RadianceField
from rfcore.image import Rgb, rgb_from_colour
from rfcore.metrics import psnr
from rfcore.views import PosedPicture
from rfedge.report.charts import DIFFERENCE_GAIN, amplified_difference, curve_chart, embedded
from rfedge.report.page import write_page


def write_training_report(
    path: Path, result: Mapping[str, Any], field: RadianceField, held_out: Dataset | None
) -> None:
    """Write the page of one run.

    ``result`` is the content of its JSON. Of ``held_out``, the pictures that it was measured on,
    the page shows the best, the median and the worst.
    """
    write_page(
        path,
        "training/training.html.j2",
        _headline(result),
        {key: result[key] for key in PROVENANCE},
        result=result,
        curve_svg=curve_chart(result["curve"]) if result["curve"] else None,
        strips=_strips(field, held_out) if held_out is not None else [],
    )


PROVENANCE = ("command", "revision", "host", "seed", "settings", "training_digest", "field")


def _headline(result: Mapping[str, Any]) -> str:
    took = f"{result['seconds'] / 60:.1f} minutes of training"
    db = result["held_out"]["psnr_db"]
    return took if db is None else f"{db:.2f} dB on pictures never seen, after {took}"


def _strips(field: RadianceField, held_out: Dataset) -> list[dict[str, Any]]:
    """Return the best, the median and the worst held-out picture."""
    colours = [field.render_colour(picture.camera) for picture in held_out.pictures]
    renders = [rgb_from_colour(colour) for colour in colours]
    quality_db = [
        psnr(render, picture.read(), mask=picture.read_mask())
        for render, picture in zip(renders, held_out.pictures, strict=True)
    ]
    order = np.argsort(quality_db)[::-1].tolist()
    shown = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
    return [
        _strip(which, held_out.pictures[i], renders[i], quality_db[i]) for which, i in shown.items()
    ]


def _strip(which: str, picture: PosedPicture, render: Rgb, quality_db: float) -> dict[str, Any]:
    camera = picture.read()
    captions = (
        (f"camera, {picture.name}", camera),
        (f"render, {quality_db:.1f} dB", render),
        (f"difference × {DIFFERENCE_GAIN}", amplified_difference(render, camera)),
    )
    return {
        "which": which,
        "pictures": embedded(captions),
    }
