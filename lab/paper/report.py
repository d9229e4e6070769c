"""Means, savings frame by frame and tables of the rows of the published experiment.

The savings of a frame are its mean over presets and rate factors; spreads are over frames. Beside
the published metric, which compares pictures of two contents and qualities, stands what a P picture
takes of an I picture of the same frame at its quality.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of


@dataclass(frozen=True)
class PaperRow:
    """One frame coded after its render as the published two-frame clip, at one setting."""

    field: str
    """Name of the field; ``name:behind`` and ``name:grey`` are controls."""
    scene: str
    width: int
    height: int
    render: str
    """``downscaled`` from the camera's size, as published, or ``native``: rendered at this one."""
    preset: str
    crf: float
    frame: str
    i_bytes: int
    p_bytes: int
    second_type: str
    """``P``, unless x264 found an I picture cheaper."""
    header_bytes: int
    savings_percent: float
    """100 I / (I + P)."""
    i_psnr_db: float | None
    """PSNR of the I picture against the render; None if they are identical, as all PSNRs here."""
    psnr_db: float | None
    ssim: float
    camera_i_bytes: int
    """The camera frame coded by itself."""
    camera_i_psnr_db: float | None
    rf_psnr_db: float
    """PSNR of the render against the camera, as ``rf_ssim``, ``rf_residual_bands``, ``rf_flip``."""
    rf_ssim: float
    rf_residual_bands: Sequence[float]
    """Energy of the difference over the camera's, by band of spatial frequency."""
    rf_flip: float | None = None
    """FLIP of the render; None of controls and native renders, as the next two."""
    rf_lpips: float | None = None
    rf_lpips_vgg: float | None = None
    """LPIPS of the render by AlexNet and VGG16, where weights were given."""

    @staticmethod
    def of(row: Mapping[str, Any]) -> PaperRow:
        """Return what ``published_rows`` yields, with None for an infinite PSNR."""
        values = {
            name: None if isinstance(value, float) and math.isinf(value) else value
            for name, value in row.items()
        }
        (made,) = rows_of(PaperRow, [values])
        return made

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    @property
    def is_control(self) -> bool:
        """Whether the render knows nothing of the place."""
        return ":" in self.field


@dataclass(frozen=True)
class SettingColumns:
    """The columns of ``PaperRow`` at one preset and CRF, a value a frame in their order."""

    preset: str
    """Preset of x264."""
    crf: float
    i_bytes: Sequence[int]
    """Slice bytes of the render's picture, a frame."""
    p_bytes: Sequence[int]
    """Slice bytes of the camera's picture after it, a frame."""
    second_types: str
    """A letter a frame."""
    header_bytes: Sequence[int]
    """Bytes of both pictures beside their slices."""
    i_psnr_db: Sequence[float | None]
    """PSNR of the decoded I picture against the render."""
    psnr_db: Sequence[float | None]
    """PSNR of the decoded P picture against the camera."""
    ssim: Sequence[float]
    """SSIM of the same."""
    camera_i_bytes: Sequence[int]
    """Slice bytes of the camera's picture coded alone."""
    camera_i_psnr_db: Sequence[float | None]
    """PSNR of that picture."""


@dataclass(frozen=True)
class PaperTable:
    """The rows of one field, scene, size and way of rendering as the result file has them.

    A row for each of 144 frames and nine settings would take ten times as much. Rounded: decibels
    to hundredths, other shares to five decimals; savings are left out, bytes say them.
    """

    field: str
    """Name of the field; ``name:behind`` and ``name:grey`` are controls."""
    scene: str
    width: int
    """Width of the coded pictures."""
    height: int
    """Height of the coded pictures."""
    render: str
    """``downscaled`` from the camera's size, as published, or ``native``: rendered at this one."""
    frames: Sequence[str]
    """Names of the frames; lists below have a value for each."""
    rf_psnr_db: Sequence[float]
    """PSNR of the render against the camera."""
    rf_ssim: Sequence[float]
    """SSIM of the render."""
    rf_residual_bands: Sequence[Sequence[float]]
    """Energy of the difference over the camera's, for each of ``bands_cycles_per_px``."""
    settings: Sequence[SettingColumns]
    """The pictures coded at each preset and CRF."""
    rf_flip: Sequence[float] | None = None
    """FLIP of the render; not of controls and native renders, as the next two."""
    rf_lpips: Sequence[float] | None = None
    """LPIPS of the render by AlexNet, where weights were given."""
    rf_lpips_vgg: Sequence[float] | None = None
    """LPIPS of the render by VGG16."""


DISTANCES = ("rf_flip", "rf_lpips", "rf_lpips_vgg")
"""Columns of a table that not every table has."""
OF_A_SETTING = (
    "header_bytes",
    "i_psnr_db",
    "psnr_db",
    "ssim",
    "camera_i_bytes",
    "camera_i_psnr_db",
)
"""Columns whose values are those of the rows, rounded, beside bytes and types of the pictures."""


def paper_tables(rows: Sequence[PaperRow]) -> list[PaperTable]:
    """Return rows as tables; raise ``InvalidInput`` where a setting lacks a frame of its table."""
    return [_table_of(group) for group in _groups(rows)]


def paper_rows(result: Result) -> list[PaperRow]:
    """Return the rows of a result of ``rfedge-lab paper``."""
    return [row for table in rows_of(PaperTable, result["tables"]) for row in _rows_of_table(table)]


def _groups(rows: Sequence[PaperRow]) -> list[list[PaperRow]]:
    """Return rows by field, scene, size and way of rendering, in the order of the first of each."""
    groups: dict[tuple[Any, ...], list[PaperRow]] = {}
    for row in rows:
        groups.setdefault((row.field, row.scene, row.size_px, row.render), []).append(row)
    return list(groups.values())


def _table_of(group: Sequence[PaperRow]) -> PaperTable:
    first, by_setting = group[0], dict[tuple[str, float], list[PaperRow]]()
    for row in group:
        by_setting.setdefault((row.preset, row.crf), []).append(row)
    of_frames = next(iter(by_setting.values()))
    frames = [row.frame for row in of_frames]
    for setting, rows in by_setting.items():
        if [row.frame for row in rows] != frames:
            raise InvalidInput("rows", f"{setting} of {first.field} has other frames than the rest")
    return PaperTable(
        field=first.field,
        scene=first.scene,
        width=first.width,
        height=first.height,
        render=first.render,
        frames=frames,
        rf_psnr_db=_rounded(of_frames, "rf_psnr_db"),
        rf_ssim=_rounded(of_frames, "rf_ssim"),
        rf_residual_bands=[[round(band, 5) for band in r.rf_residual_bands] for r in of_frames],
        **{n: _rounded(of_frames, n) for n in DISTANCES if getattr(first, n) is not None},
        settings=[_columns_of(rows) for rows in by_setting.values()],
    )


def _columns_of(rows: Sequence[PaperRow]) -> SettingColumns:
    return SettingColumns(
        preset=rows[0].preset,
        crf=rows[0].crf,
        i_bytes=[row.i_bytes for row in rows],
        p_bytes=[row.p_bytes for row in rows],
        second_types="".join(row.second_type for row in rows),
        **{name: _rounded(rows, name) for name in OF_A_SETTING},
    )


def _rounded(rows: Sequence[PaperRow], name: str) -> list[Any]:
    digits = 2 if name.endswith("_db") else 5
    values = [getattr(row, name) for row in rows]
    return [round(value, digits) if isinstance(value, float) else value for value in values]


def _rows_of_table(table: PaperTable) -> list[PaperRow]:
    rows = []
    for setting in rows_of(SettingColumns, cast("Sequence[Mapping[str, Any]]", table.settings)):
        for n, frame in enumerate(table.frames):
            i_bytes, p_bytes = setting.i_bytes[n], setting.p_bytes[n]
            rows.append(
                PaperRow(
                    field=table.field,
                    scene=table.scene,
                    width=table.width,
                    height=table.height,
                    render=table.render,
                    preset=setting.preset,
                    crf=setting.crf,
                    frame=frame,
                    i_bytes=i_bytes,
                    p_bytes=p_bytes,
                    second_type=setting.second_types[n],
                    savings_percent=100.0 * i_bytes / (i_bytes + p_bytes),
                    rf_psnr_db=table.rf_psnr_db[n],
                    rf_ssim=table.rf_ssim[n],
                    rf_residual_bands=table.rf_residual_bands[n],
                    **{d: v[n] for d in DISTANCES if (v := getattr(table, d)) is not None},
                    **{name: getattr(setting, name)[n] for name in OF_A_SETTING},
                )
            )
    return rows


@dataclass(frozen=True)
class PaperMean:
    """Means over frames for one field, scene, size and way of rendering.

    ``ci95_percent`` is that of a normal mean. A P picture that x264 made an I picture counts as it
    is; ``second_not_p`` is the share of such clips.
    """

    name: str = field(metadata=shown("field"))
    """Name of the field."""
    scene: str = field(metadata=shown("scene"))
    size_px: tuple[int, int]
    making: str = field(metadata=shown("render"))
    frames: int
    savings_percent: float = field(metadata=shown("100 I/(I+P) %", ".1f"))
    settings_percent: tuple[float, float] = field(
        metadata=shown("by setting, least..most", "{:.0f}..{:.0f}")
    )
    """Least and most of the means over frames at each preset and CRF."""
    sd_percent: float = field(metadata=shown("sd", ".1f"))
    ci95_percent: float = field(metadata=shown("95 %, ±", ".1f"))
    against_intra_percent: float | None = field(
        metadata=shown("P against I of its PSNR, %", "+.1f")
    )
    """Bytes of P pictures at the middle CRF above those of I pictures of the same frames and
    PSNR."""
    rf_psnr_db: float = field(metadata=shown("RF dB", ".2f"))
    rf_ssim: float = field(metadata=shown("SSIM", ".3f"))
    rf_flip: float | None = field(metadata=shown("FLIP", ".3f"))
    rf_lpips: float | None = field(metadata=shown("LPIPS", ".3f"))
    rf_lpips_vgg: float | None = field(metadata=shown("LPIPS, VGG16", ".3f"))
    bands: tuple[float, ...]
    second_not_p: float


def means_of(rows: Sequence[PaperRow]) -> list[PaperMean]:
    """Return a mean for every combination there is, in the order of the rows."""
    return [_mean(group) for group in _groups(rows)]


def savings_by_frame(
    rows: Sequence[PaperRow], field: str, scene: str
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return for each size the savings of every frame, rendered as published, in frame order.

    Raises ``InvalidInput`` without rows of this field and scene.
    """
    wanted = (field, scene, "downscaled")
    kept = [row for row in rows if (row.field, row.scene, row.render) == wanted]
    if not kept:
        raise InvalidInput("rows", f"there is none of field {field!r} in scene {scene!r}")
    sizes = dict.fromkeys(row.size_px for row in kept)
    return {
        size: _by_frame([(r.frame, r.savings_percent) for r in kept if r.size_px == size])
        for size in sizes
    }


def _mean(group: Sequence[PaperRow]) -> PaperMean:
    first = group[0]
    savings = _by_frame([(row.frame, row.savings_percent) for row in group])
    sd = float(np.std(savings, ddof=1)) if len(savings) > 1 else 0.0
    settings: dict[tuple[str, float], list[float]] = {}
    for row in group:
        settings.setdefault((row.preset, row.crf), []).append(row.savings_percent)
    of_settings = [float(np.mean(values)) for values in settings.values()]
    return PaperMean(
        name=first.field,
        scene=first.scene,
        size_px=first.size_px,
        making=first.render,
        frames=len(savings),
        savings_percent=float(np.mean(savings)),
        settings_percent=(min(of_settings), max(of_settings)),
        sd_percent=sd,
        ci95_percent=1.96 * sd / len(savings) ** 0.5,
        against_intra_percent=_against_intra_percent(group),
        rf_psnr_db=float(np.mean(_by_frame([(row.frame, row.rf_psnr_db) for row in group]))),
        rf_ssim=float(np.mean(_by_frame([(row.frame, row.rf_ssim) for row in group]))),
        **{name: _mean_distance(group, name) for name in DISTANCES},
        bands=tuple(np.mean([row.rf_residual_bands for row in group], axis=0).tolist()),
        second_not_p=float(np.mean([row.second_type != "P" for row in group])),
    )


def _mean_distance(group: Sequence[PaperRow], name: str) -> float | None:
    values = [(row.frame, v) for row in group if (v := getattr(row, name)) is not None]
    return float(np.mean(_by_frame(values))) if values else None


def _against_intra_percent(group: Sequence[PaperRow]) -> float | None:
    """Geometric mean over frames and presets; I pictures are interpolated between their CRFs, never
    beyond: None where no P picture's PSNR lies within theirs."""
    clips = dict[tuple[str, str], list[PaperRow]]()
    for row in group:
        clips.setdefault((row.frame, row.preset), []).append(row)
    logs = [log for rows in clips.values() if (log := _log_against_intra(rows)) is not None]
    return 100 * math.expm1(float(np.mean(logs))) if logs else None


def _log_against_intra(rows: Sequence[PaperRow]) -> float | None:
    rows = sorted(rows, key=lambda row: row.crf)
    coded = rows[len(rows) // 2]
    intra = sorted(
        (row.camera_i_psnr_db, math.log(row.camera_i_bytes))
        for row in rows
        if row.camera_i_psnr_db is not None
    )
    if coded.psnr_db is None or not intra or not intra[0][0] <= coded.psnr_db <= intra[-1][0]:
        return None
    qualities_db, log_bytes = np.array(intra).T
    return math.log(coded.p_bytes) - float(np.interp(coded.psnr_db, qualities_db, log_bytes))


def _by_frame(values: Sequence[tuple[str, float]]) -> NDArray[np.float64]:
    """Return the mean of each frame's values, in the order of the frames."""
    frames: dict[str, list[float]] = {}
    for frame, value in values:
        frames.setdefault(frame, []).append(value)
    return np.array([np.mean(of_frame) for of_frame in frames.values()])


NAMES = ("name", "scene")
SIZE = Column("size", lambda mean: mean.size_px, "{}x{}")
METRIC = (
    "Published metric: means over frames, and over three presets at CRF 18, 23 and 28; the "
    "controls `:behind` and `:grey` at medium, CRF 23 alone. sd and 95 % are over frames."
)
WORDS = (
    "Qualities of renders are means over frames. Residual: luma energy of camera - render over "
    "the camera's, by cycles a pixel {bands}. LPIPS {lpips}."
)


def paper_parts(result: Result) -> Iterator[Table | str]:
    """Yield the savings by the published metric, and the quality of the renders."""
    means = means_of(paper_rows(result))
    same = (*NAMES, SIZE, "making")
    savings = (
        "savings_percent",
        "settings_percent",
        "sd_percent",
        "ci95_percent",
        "against_intra_percent",
    )
    yield Table(METRIC, columns(PaperMean, *same, *savings), means)
    measured = [n for n in DISTANCES if any(getattr(mean, n) is not None for mean in means)]
    quality = columns(PaperMean, *same, "rf_psnr_db", "rf_ssim", *measured, BANDS_TEXT)
    yield Table("Renders against the camera", quality, means)
    bands = ", ".join("{:.3g}..{:.3g}".format(*band) for band in result["bands_cycles_per_px"])
    frames = ", ".join(map(str, dict.fromkeys(mean.frames for mean in means)))
    yield "Camera and renders of the first frames: [views](figures/fig2_views.svg)."
    yield f"{frames} frames. " + WORDS.format(bands=bands, lpips=result["lpips"])


BANDS_TEXT = Column(
    "residual by band", lambda mean: " / ".join(f"{ratio:.2f}" for ratio in mean.bands)
)
