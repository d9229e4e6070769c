"""A field in words and figures, as ``rfedge field info`` prints it.

The figures are what the header states and what a frame of each level of detail takes on this
machine.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from rfcore.camera import Camera
from rfcore.field import FULL, Quality, RadianceField, SplatField
from rfcore.field.quality import DETAILS, kept_of
from rfcore.field.store import encode_field
from rfcore.geodesy import Anchor
from rfcore.metrics import psnr
from rfcore.views import PosedPicture
from rfedge.fields.check import to_rgb
from rfedge.timing import median_ms

__all__ = ["anchor_text", "describe_field", "frame_ms", "print_levels", "size_mb"]


def frame_ms(
    field: RadianceField, cameras: Sequence[Camera], quality: Quality = FULL, rounds: int = 3
) -> float:
    """Return the median time of a frame over ``rounds`` turns through ``cameras``."""
    field.prepare(quality)
    turns = itertools.cycle(cameras)
    return median_ms(
        lambda: field.render_colour(next(turns), quality), repetitions=rounds * len(cameras)
    )


def size_mb(field: RadianceField) -> float:
    """Return the size of the field's file in MB."""
    return len(encode_field(field)) / 1e6


def describe_field(field: RadianceField) -> list[tuple[str, str]]:
    """Return what is known about a field, as (name, value)."""
    m, box = field.metadata, field.bounds
    origin = m.tile_origin
    rows = [
        ("name", m.name or "none"),
        ("id", field.field_id),
        ("kind", m.kind),
        ("primitives", f"{field.primitives:,}"),
        ("file", f"{size_mb(field):.2f} MB"),
        ("held out", _quality(m.held_out_psnr_db, m.held_out_ssim)),
        ("trained on", m.training_digest or "unknown (imported)"),
        ("tile origin", f"{origin.east_m:g}, {origin.north_m:g}, {origin.up_m:g} m"),
        ("anchor", anchor_text(m.anchor)),
        ("bounds", f"{_corner(box.low_m)} to {_corner(box.high_m)} m"),
    ]
    if isinstance(field, SplatField):
        levels = ", ".join(f"{100 * detail:g} %" for detail in sorted(field.levels, reverse=True))
        rows += [
            ("SH degree", str(field.gaussians.sh_degree)),
            ("antialiased", "yes" if m.antialiased else "no"),
            ("encoding", "compressed" if "encoding" in field.archive().metadata else "raw"),
            ("fitted levels of detail", levels or "none: lower ones are plain prefixes"),
        ]
    return rows


def print_levels(
    console: Console,
    field: SplatField,
    cameras: Sequence[Camera],
    pictures: Sequence[PosedPicture] = (),
) -> None:
    """Measure every level on this machine and print the table.

    The time of a frame from ``cameras``, and where there are ``pictures`` the mean PSNR to them.
    """
    k = cameras[0].intrinsics
    table = Table(title=f"a frame of {k.width_px}x{k.height_px} px here")
    for heading in ("detail", "splats", "ms", *(["dB"] if pictures else [])):
        table.add_column(heading, justify="right")
    for quality in map(Quality, DETAILS):
        splats = kept_of(field.primitives, quality.detail)
        ms = frame_ms(field, cameras, quality)
        cells = [f"{100 * quality.detail:g} %", f"{splats:,}", f"{ms:.1f}"]
        if pictures:
            cells.append(f"{_mean_psnr_db(field, pictures, quality):.2f}")
        table.add_row(*cells)
    console.print(table)


def _mean_psnr_db(
    field: RadianceField, pictures: Sequence[PosedPicture], quality: Quality
) -> float:
    colours = [field.render_colour(picture.camera, quality) for picture in pictures]
    pairs = zip(colours, pictures, strict=True)
    return float(np.mean([psnr(to_rgb(colour), seen.read()) for colour, seen in pairs]))


def _quality(psnr_db: float | None, ssim: float | None) -> str:
    if psnr_db is None:
        return "not measured"
    return f"{psnr_db:.2f} dB" + (f", SSIM {ssim:.3f}" if ssim is not None else "")


def anchor_text(anchor: Anchor | None) -> str:
    """Return where on the Earth a field is, as text."""
    if anchor is None:
        return "none: `rfedge field anchor` states one"
    where = f"{anchor.latitude_deg:.8f}, {anchor.longitude_deg:.8f} deg, {anchor.height_m:.3f} m"
    return f"{where} at {_corner(anchor.point_m)} m"


def _corner(corner_m: tuple[float, float, float]) -> str:
    return f"({', '.join(f'{value:.1f}' for value in corner_m)})"
