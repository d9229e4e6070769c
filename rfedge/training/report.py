"""The page of one training run, and the section of the results page about all of them.

The page shows held-out pictures beside their renders and the curve of quality over time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from rfcore.dataset import Dataset
from rfcore.field import RadianceField
from rfcore.files import write_whole
from rfcore.image import Rgb, rgb_from_colour
from rfcore.metrics import psnr
from rfcore.views import PosedPicture
from rfedge.report.charts import DIFFERENCE_GAIN, amplified_difference, curve_chart, embedded
from rfedge.report.tables import table
from rfedge.results import Result, read_result

__all__ = ["training_section", "write_training_report"]


def write_training_report(
    path: Path, result: Mapping[str, Any], field: RadianceField, held_out: Dataset | None
) -> None:
    """Write the page of one run.

    ``result`` is the content of its JSON; ``held_out`` the pictures it was measured on, of which
    the best, the median and the worst are shown.
    """
    environment = Environment(
        loader=PackageLoader("rfedge.training", "."), autoescape=True, undefined=StrictUndefined
    )
    page = environment.get_template("training.html.j2").render(
        headline=_headline(result),
        result=result,
        curve_svg=curve_chart(result["curve"]) if result["curve"] else None,
        strips=_strips(field, held_out) if held_out is not None else [],
        provenance=json.dumps({key: result[key] for key in PROVENANCE}, indent=2),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page)


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
        psnr(render, picture.read())
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


RUN_COLUMNS = (
    "run",
    "views",
    "size",
    "held out dB",
    "SSIM",
    "seconds",
    "iterations",
    "primitives",
    "MB",
)


def training_section(paths: Sequence[Path]) -> str:
    """Return a table of training runs, and the command of each."""
    runs = {path.stem: read_result(path, "training") for path in paths}
    rows = [_run_cells(name, run) for name, run in runs.items()]
    commands = [
        f"* {name}: `{run['command']}` at `{run['revision']}`" for name, run in runs.items()
    ]
    return "\n\n".join(["## training", table(RUN_COLUMNS, rows), "\n".join(commands), ""])


def _run_cells(name: str, run: Result) -> list[str]:
    held_out = run["held_out"]
    psnr_db, ssim = held_out["psnr_db"], held_out["ssim"]
    return [
        name,
        str(run["views"]),
        f"{run['width']}x{run['height']}",
        "-" if psnr_db is None else f"{psnr_db:.2f}",
        "-" if ssim is None else f"{ssim:.3f}",
        f"{run['seconds']:.0f}",
        str(run["iterations"]),
        str(run["primitives"]),
        f"{run['bytes'] / 1e6:.1f}",
    ]
