"""A field in words and figures, as ``rfedge field info`` prints it."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from rfcore.camera import Camera
from rfcore.field import Quality, RadianceField, SplatField
from rfcore.field.detail import kept_of
from rfcore.field.load import encode_field
from rfcore.field.quality import DETAILS
from rfedge.fields.speed import frame_ms

__all__ = ["describe_field", "print_rungs", "size_mb"]


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
        ("bounds", f"{_corner(box.low_m)} to {_corner(box.high_m)} m"),
    ]
    if isinstance(field, SplatField):
        rungs = ", ".join(f"{100 * detail:g} %" for detail in sorted(field.rungs, reverse=True))
        rows += [
            ("SH degree", str(field.gaussians.sh_degree)),
            ("antialiased", "yes" if m.antialiased else "no"),
            ("encoding", "compressed" if "encoding" in field.archive().metadata else "raw"),
            ("fitted rungs", rungs or "none: lower rungs are plain prefixes"),
        ]
    return rows


def print_rungs(console: Console, field: SplatField, cameras: Sequence[Camera]) -> None:
    """Measure a frame of every rung on this machine and print the table."""
    k = cameras[0].intrinsics
    table = Table(title=f"a frame of {k.width_px}x{k.height_px} px here")
    for heading in ("detail", "splats", "ms"):
        table.add_column(heading, justify="right")
    for detail in DETAILS:
        ms = frame_ms(field, cameras, Quality(detail))
        splats = kept_of(field.primitives, detail)
        table.add_row(f"{100 * detail:g} %", f"{splats:,}", f"{ms:.1f}")
    console.print(table)


def _quality(psnr_db: float | None, ssim: float | None) -> str:
    if psnr_db is None:
        return "not measured"
    return f"{psnr_db:.2f} dB" + (f", SSIM {ssim:.3f}" if ssim is not None else "")


def _corner(corner_m: tuple[float, float, float]) -> str:
    return f"({', '.join(f'{value:.1f}' for value in corner_m)})"
