"""The coders of a comparison on each drive: ours, families of rival settings, a user's.

Drives are read and rendered, and users' codecs loaded, before anything is coded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.references import RENDER_ONLY, References
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.field.own import OwnField
from rfcore.train.trainer import mean_psnr_db
from rfedge.arguments import open_field
from rfedge.evaluate.clips import (
    DECIMATION,
    QUICK,
    Clip,
    ClipCoder,
    Drive,
    DriveName,
    DriveOfField,
    read_drive,
)
from rfedge.evaluate.compare import EvalCompare
from rfedge.evaluate.compare.foreground import ForegroundCoder, foreground_mask
from rfedge.evaluate.field_coder import CRFS, WITHOUT_FIELD, FieldCoder, RenderedClip, render_clip
from rfedge.evaluate.noted_coder import FrameNotes, NotedCoder, PictureCoder
from rfedge.evaluate.own_coder import OwnCoder, own_coder
from rfedge.evaluate.rate_curve import QUICK_POINTS
from rfedge.evaluate.rivals import (
    Rival,
    svtav1_lowdelay,
    x264_for_psnr,
    x264_for_ssim,
    x264_lowdelay,
    x264_with_our_tools,
    x265_for_psnr,
    x265_for_ssim,
    x265_lowdelay,
)
from rfedge.evaluate.runner import program_version

PAID_AGAINST = "x264-lowdelay-psnr"
"""The rival against which a field has to save its own bytes."""
KEYINTS = (10, 30, 250)
OUR_TOOLS_PRESETS = ("veryfast", "medium", "veryslow")


def rival_families(preset: str) -> dict[str, list[ClipCoder]]:
    """Return the rivals by codec: the anchors alone of their kind, the others at several settings.

    The first anchor is x264 as it comes, which is what a user has. It spends bits on looks that a
    PSNR does not see, and our encoder does not; the second is tuned for PSNR as ours is, and so are
    the stronger presets. `x264-our-tools` has every tool of our slices besides, so that only the
    field is left between the two.
    """
    anchors: dict[str, list[ClipCoder]] = {
        "x264-lowdelay": [x264_lowdelay(preset)],
        PAID_AGAINST: [x264_for_psnr(preset)],
    }
    return {
        **anchors,
        **{f"x264-our-tools-{p}": [x264_with_our_tools(p)] for p in (*OUR_TOOLS_PRESETS, preset)},
        "x265-medium": [x265_for_psnr("medium")],
        "svtav1-p6": [svtav1_lowdelay(6)],
        "x264-stronger": [x264_for_psnr(p) for p in ("medium", "veryslow")],
        **{f"x264-keyint-{n}": [_with_key_frames(preset, n)] for n in KEYINTS},
        "x264-intra-refresh": [_with_intra_refresh(preset)],
        "x265-lowdelay": [
            x265_lowdelay("veryfast"),
            *(x265_for_psnr(p) for p in ("veryfast", "medium")),
        ],
        "svtav1-lowdelay": [svtav1_lowdelay(p) for p in (10, 8, 6, 4)],
    }


def ssim_rivals() -> dict[str, list[ClipCoder]]:
    """Return the rivals of a comparison by SSIM, tuned for it; SVT-AV1 cannot be at low delay."""
    return {
        "x264-ssim": [x264_for_ssim("veryfast")],
        "x264-ssim-medium": [x264_for_ssim("medium")],
        "x265-ssim-medium": [x265_for_ssim("medium")],
        "svtav1-p6": [svtav1_lowdelay(6)],
    }


def _with_key_frames(preset: str, keyint: int) -> Rival:
    return x264_lowdelay(preset, f"x264-keyint-{keyint}-{preset}", keyint=str(keyint))


def _with_intra_refresh(preset: str) -> Rival:
    """A column of intra blocks crosses the picture in ten frames; x264 waits as long before it."""
    params = {"intra-refresh": "1", "keyint": "10"}
    return x264_lowdelay(preset, f"x264-intra-refresh-10-{preset}", **params)


@dataclass(frozen=True)
class Method:
    """Settings of our coder; None leaves references to the encoder, the effort to the job."""

    references: References | None = None
    effort: str | None = None


METHODS = (
    ("rfedge", Method()),
    ("rfedge", Method(effort="thorough")),
    ("rfedge-render-only", Method(RENDER_ONLY)),
    ("rfedge-without-field", Method(WITHOUT_FIELD)),
)
"""Our coder as it is; with nearly as much time for a slice as x264 medium takes; and without a past
and without a field, which tells what each is worth."""
QUICK_METHODS = (METHODS[0], METHODS[-1])


def asked_families(job: EvalCompare) -> dict[str, list[ClipCoder]]:
    """Return the rivals that are asked for, and the one that a field is paid for against.

    Raises ``InvalidInput`` for a name that is neither a family of rivals nor a setting of one.
    """
    families = rival_families(job.preset)
    known = dict.fromkeys([*families, *(c.name for those in families.values() for c in those)])
    for name in job.rivals:
        if name not in known:
            raise InvalidInput("rivals", f"{name!r} is none of {', '.join(known)}")
    unasked = [f"x264-our-tools-{job.preset}"] if job.quick else families
    wanted = {PAID_AGAINST, *(job.rivals or unasked)}
    asked = {
        family: [c for c in those if family in wanted or c.name in wanted]
        for family, those in families.items()
    }
    return {family: those for family, those in asked.items() if those}


def jobs_of_drives(job: EvalCompare) -> list[EvalCompare]:
    """Return a job for every drive, each with the background that stands behind it."""
    behind = {_name(DriveName.parse(text)): text for text in job.background}

    def whole(text: str) -> EvalCompare:
        background = behind.get(_name(DriveOfField.parse(text, job.field).name))
        backgrounds = () if background is None else (background,)
        return replace(job, drives=(text,), decimated=(), background=backgrounds)

    slow = [replace(job, drives=(), decimated=(d,), background=()) for d in job.decimated]
    return [*map(whole, job.drives), *slow]


@dataclass(frozen=True)
class DriveComparison:
    """One drive with every coder of it, ours (``methods``) with what the field shows.

    ``field`` is the field's archive, or a user's class, and ``field_bytes`` its size.
    ``foregrounds`` has a bool [H, W] for each frame, true where
    it differs from the empty street that the drive of digest ``background`` shows; without one
    nothing differs.
    """

    clip: Clip
    rendered: RenderedClip
    field: Path
    field_bytes: int
    foregrounds: Sequence[NDArray[np.bool_]]
    background: str | None
    methods: Sequence[ClipCoder]
    families: Mapping[str, Sequence[ClipCoder]]
    for_ssim: Mapping[str, Sequence[ClipCoder]]
    foreground_only: ForegroundCoder | None
    own: Sequence[OwnCoder]
    """Codecs of ``--method``, which are among the families, too."""

    @property
    def compared(self) -> list[ClipCoder]:
        """All coders that take part in the BD-rates, ours first."""
        rivals = [coder for family in self.families.values() for coder in family]
        return [*self.methods, *{rival.name: rival for rival in rivals}.values()]

    @property
    def coders(self) -> list[ClipCoder]:
        """All coders, ours first."""
        last = [] if self.foreground_only is None else [self.foreground_only]
        return [*self.compared, *(c for family in self.for_ssim.values() for c in family), *last]


def read_drive_comparisons(job: EvalCompare) -> list[DriveComparison]:
    """Return a comparison per drive.

    Raises ``InvalidInput`` for a background that does not fit its drive, and as ``read_drive``.
    """
    limit = QUICK if job.quick else None
    drives, slow = (
        [DriveOfField.parse(text, job.field) for text in texts]
        for texts in (job.drives, job.decimated)
    )
    behind = {_name(name): name for name in map(DriveName.parse, job.background)}
    unknown = behind.keys() - {_name(drive.name) for drive in drives}
    if unknown:
        raise InvalidInput("background", f"there is no drive {sorted(unknown)} to stand behind")
    opened = cache(open_field)
    comparisons = []
    for given in slow:
        field = opened(given.field)
        drive = read_drive(given.name, field=(field, given.field)).every(DECIMATION)
        if job.quick:
            drive = drive.spread(QUICK)
        comparisons.append(_drive_comparison(job, given, drive, None, field))
    for given in drives:
        field, name = opened(given.field), behind.get(_name(given.name))
        drive = read_drive(given.name, limit, (field, given.field))
        background = None if name is None else read_drive(name, limit)
        comparisons.append(_drive_comparison(job, given, drive, background, field))
    return comparisons


def _name(name: DriveName) -> tuple[str, float]:
    return name.scene, name.rate_hz


def _drive_comparison(
    job: EvalCompare,
    given: DriveOfField,
    drive: Drive,
    background: Drive | None,
    field: RadianceField,
) -> DriveComparison:
    clip = drive.clip(field_psnr_db=mean_psnr_db(field, drive.pictures))
    families = asked_families(job)
    if job.quick:
        families = {name: [*map(_at_few_points, those)] for name, those in families.items()}
    rendered = render_clip(field, drive.cameras)
    foregrounds = _foregrounds(drive, background)
    behind = None if background is None else background.digest
    stamp = program_version()
    if behind is not None:
        stamp += f", before {behind[:16]}"
    coders = {}
    for own, method in QUICK_METHODS if job.quick else METHODS:
        effort = method.effort or job.effort
        name = f"{own}-{effort}-{rendered.field_id[:12]}"
        coders[name] = FieldCoder(
            rendered,
            name,
            stamp,
            effort=effort,
            references=method.references,
            points=_few(CRFS) if job.quick else CRFS,
            foregrounds=() if behind is None else foregrounds,
        )
    rival = None
    if behind is not None:
        rival_stamp = f"{stamp}, field {rendered.field_id}"
        rival = ForegroundCoder.of(job.preset, foregrounds, rendered.renders, rival_stamp)
    methods: list[ClipCoder] = list(coders.values())
    if job.lpips_weights is not None:
        from rfedge.evaluate.lpips import Lpips

        noted = partial(_noted, Lpips(job.lpips_weights))
        methods = [*map(noted, methods)]
        families = {name: [*map(noted, those)] for name, those in families.items()}
    users = [own_coder(text) for text in job.method]
    families |= {coder.name: [coder] for coder in users}
    by_ssim = {} if job.rivals or job.quick else ssim_rivals()
    field_bytes = field.size_bytes if isinstance(field, OwnField) else given.field.stat().st_size
    return DriveComparison(
        clip,
        rendered,
        given.field,
        field_bytes,
        foregrounds,
        behind,
        methods,
        families,
        by_ssim,
        rival,
        users,
    )


def _few(points: Sequence[float]) -> tuple[float, ...]:
    """Return every second of eight or more points: BD-rates recorded with all move by 1.1 points
    at most."""
    return tuple(points[1::2] if len(points) >= 2 * QUICK_POINTS else points)


def _at_few_points(coder: ClipCoder) -> ClipCoder:
    return replace(coder, points=_few(coder.points)) if isinstance(coder, Rival) else coder


def _noted(noted: FrameNotes, coder: ClipCoder) -> ClipCoder:
    return NotedCoder(coder, noted) if isinstance(coder, PictureCoder) else coder


def _foregrounds(drive: Drive, background: Drive | None) -> list[NDArray[np.bool_]]:
    if background is None:
        return [np.zeros(frame.y.shape, bool) for frame in drive.frames]
    if len(background.frames) != len(drive.frames):
        counts = f"{len(background.frames)} frames where the drive has {len(drive.frames)}"
        raise InvalidInput("background", f"{drive.name.scene}: {counts}")
    pairs = zip(drive.frames, background.frames, strict=True)
    return [foreground_mask(*pair) for pair in pairs]
