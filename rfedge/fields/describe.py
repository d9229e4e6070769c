"""Describe a field in words and figures, for ``rfedge field info`` and ``disagree``.

The figures are what the header states and what a frame of each level of detail takes on this
machine. ``disagreement_picture`` shows an operator where a field and the street disagree. The
render is brought to the frame's light first, each plane by one gain and offset; what is red then
has changed on the street, or was never learnt, and is not due to the hour of the day.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from rfcore.camera import Camera, Vec3
from rfcore.errors import InvalidInput
from rfcore.field import FULL, FieldMetadata, Quality, RadianceField, SplatField, render_field_view
from rfcore.field.interface import SPLATS
from rfcore.field.quality import DETAILS, kept_of
from rfcore.field.splat_archive import splats_of_archive
from rfcore.field.store import encode_field
from rfcore.geodesy import Anchor
from rfcore.image import I420, Rgb, rgb_from_colour
from rfcore.metrics import psnr
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfcore.vertical import direction
from rfcore.views import PosedPicture
from rfedge.timing import median_ms

SHOWN_FRAMES = 4
BLOCK_PX = 8
FULL_RED_LEVELS = 60
"""Mean absolute difference of a block's luma that is drawn fully red."""
CHANGED_LEVELS = 20
ROUNDS = 3


def disagreement_picture(
    field: RadianceField, pictures: Sequence[PosedPicture]
) -> tuple[Rgb, list[str]]:
    """Return frames evenly along ``pictures``, a row each, and a line about each.

    Raises ``InvalidInput`` without pictures or for pictures of several sizes, ``DatasetError`` for
    one that cannot be read.
    """
    if not pictures:
        raise InvalidInput("from", "no pictures to compare the field with")
    chosen = np.linspace(0, len(pictures) - 1, min(SHOWN_FRAMES, len(pictures))).round()
    rows, lines = [], []
    for picture in (pictures[int(place)] for place in chosen):
        seen = picture.read()
        frame = i420_from_rgb(seen)
        shown = _in_light_of(frame, field, picture)
        levels = block_differences(frame, shown)
        rows.append(np.concatenate([seen, rgb_from_i420(shown), _reddened(seen, levels)], axis=1))
        share = 100 * float((levels > CHANGED_LEVELS).mean())
        lines.append(f"{picture.name}: {share:.1f} % of the blocks differ")
    if len({row.shape for row in rows}) > 1:
        raise InvalidInput("from", "pictures of several sizes; give passes of one camera")
    return np.ascontiguousarray(np.concatenate(rows, axis=0)), lines


def block_differences(frame: I420, shown: I420) -> NDArray[np.float64]:
    """Return the mean absolute luma difference of each whole 8x8 block, [H // 8, W // 8]."""
    off = np.abs(frame.y.astype(np.float64) - shown.y)
    height, width = (side // BLOCK_PX for side in off.shape)
    blocks = off[: height * BLOCK_PX, : width * BLOCK_PX]
    means = blocks.reshape(height, BLOCK_PX, width, BLOCK_PX).mean(axis=(1, 3))
    return np.asarray(means)


def _in_light_of(frame: I420, field: RadianceField, picture: PosedPicture) -> I420:
    render = render_field_view(field, picture.camera).render
    y, u, v = map(_matched, render.planes, frame.planes)
    return I420(y, u, v)


def _matched(plane: NDArray[np.uint8], like: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return ``plane`` with the gain and offset, by least squares, that bring it to ``like``.

    Three times, each time without what is further than twice the median off: it has changed.
    """
    x, y = plane.astype(np.float64), like.astype(np.float64)
    keep, out = np.ones(x.shape, bool), x
    for _ in range(ROUNDS):
        middle, off = y[keep].mean(), x - x[keep].mean()
        gain = float((off * y)[keep].sum() / max(float((off * off)[keep].sum()), 1e-9))
        out = middle + gain * off
        error = np.abs(out - y)
        keep = error <= 2 * np.median(error) + 1e-9
    return np.asarray(np.clip(np.rint(out), 1, 255), np.uint8)


def _reddened(seen: Rgb, levels: NDArray[np.float64]) -> Rgb:
    share = np.zeros(seen.shape[:2])
    spread = np.clip(levels / FULL_RED_LEVELS, 0, 1).repeat(BLOCK_PX, 0).repeat(BLOCK_PX, 1)
    share[: spread.shape[0], : spread.shape[1]] = spread
    grey = seen.mean(axis=2, keepdims=True) * 0.6
    red = np.array([255.0, 0.0, 0.0])
    return np.asarray(grey + share[..., None] * (red - grey)).round().astype(np.uint8)


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
        ("up", _up(m)),
        ("bounds", f"{_corner(box.low_m)} to {_corner(box.high_m)} m"),
    ]
    if isinstance(field, SplatField):
        levels = ", ".join(f"{100 * detail:g} %" for detail in sorted(field.levels, reverse=True))
        rows += [
            ("SH degree", str(field.gaussians.sh_degree)),
            ("antialiased", "yes" if m.antialiased else "no"),
            ("encoding", _encoding(field)),
            ("fitted levels of detail", levels or "none: lower ones are plain prefixes"),
        ]
    return rows


def up_of_file(up: Vec3 | None) -> str:
    """Return a line about the vertical that a splat file states, None where it does not."""
    if up is None:
        return "up is taken to be z: the file does not state it (--up y or --up -y at import)"
    return f"up: {direction(up)}, as the file states"


def _up(metadata: FieldMetadata) -> str:
    """Return which way is up, and how that is known."""
    why = "as nothing else is known"
    if metadata.anchor is not None:
        why = "by the anchor"
    elif metadata.up is not None:
        trained = metadata.training_digest
        why = "as the training cameras show" if trained else "as stated at its import"
    return f"{direction(metadata.vertical)}, {why}"


def _encoding(field: SplatField) -> str:
    """Return how the splats are stored, what they take in memory, and how soon they are decoded."""
    archive = field.archive()
    kind = "compressed" if "encoding" in archive.metadata else "raw"
    decoded_mb = sum(array.nbytes for array in vars(field.gaussians).values()) / 1e6
    if archive.kind != SPLATS:
        return f"{kind}, on its base; {decoded_mb:.1f} MB when decoded"
    decode_ms = median_ms(lambda: splats_of_archive(archive), repetitions=3)
    return f"{kind}; {decoded_mb:.1f} MB when decoded, in {decode_ms:.0f} ms here"


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
    values = [
        psnr(rgb_from_colour(colour), seen.read(), mask=seen.read_mask())
        for colour, seen in zip(colours, pictures, strict=True)
    ]
    return float(np.mean(values))


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
