"""One drive of a comparison with everybody who codes it, read and rendered before anything runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.references import RENDER_ONLY
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.train import mean_psnr_db
from rfedge.evaluate.clip import ClipCoder
from rfedge.evaluate.compare import Contest
from rfedge.evaluate.compare_rivals import foreign_coder, rival_families
from rfedge.evaluate.drives import DECIMATION, DriveFrames, DriveName, read_drive
from rfedge.evaluate.foreground import ForegroundCoder, foreground_mask
from rfedge.evaluate.own import FieldCoder, SeenClip, see_clip
from rfedge.evaluate.result_file import check_result_path
from rfedge.provenance import revision

__all__ = ["Bout", "CompareJob", "read_bouts"]

QUICK_FRAMES = 8


@dataclass(frozen=True)
class CompareJob:
    """What to compare; see ``rfedge eval compare --help``."""

    field: Path
    drives: Sequence[str]
    preset: str
    out: Path
    cells: Path
    decimated: Sequence[str] = ()
    backgrounds: Sequence[str] = ()
    methods: Sequence[str] = ()
    quick: bool = False
    retime: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if not (self.drives or self.decimated):
            raise InvalidInput("drives", "there is none")


@dataclass(frozen=True)
class Bout:
    """One drive with everybody who codes it, ours (``methods``) from what the field shows.

    ``foregrounds``: bool [H, W] a frame, what differs from the empty street, if a ``background``
    drive shows that; else nothing. ``background``: its digest.
    """

    contest: Contest
    seen: SeenClip
    foregrounds: Sequence[NDArray[np.bool_]]
    background: str | None
    methods: Sequence[FieldCoder]
    families: Mapping[str, Sequence[ClipCoder]]
    foreground_only: ForegroundCoder | None

    @property
    def coders(self) -> list[ClipCoder]:
        """All of them, ours first."""
        rivals = (coder for family in self.families.values() for coder in family)
        last = [] if self.foreground_only is None else [self.foreground_only]
        return [*self.methods, *rivals, *last]


def read_bouts(job: CompareJob, field: RadianceField) -> list[Bout]:
    """Return a bout per drive.

    Raises ``InvalidInput`` for a background that does not fit its drive, and as ``read_drive``.
    """
    limit = QUICK_FRAMES if job.quick else None
    backgrounds = {_name(text): text for text in job.backgrounds}
    unknown = backgrounds.keys() - {_name(text) for text in job.drives}
    if unknown:
        raise InvalidInput("background", f"there is no drive {sorted(unknown)} to stand behind")
    slow = [read_drive(text).every(DECIMATION) for text in job.decimated]
    bouts = [_bout(job, drive, None, field) for drive in slow]
    for text in job.drives:
        behind = backgrounds.get(_name(text))
        background = None if behind is None else read_drive(behind, limit)
        bouts.append(_bout(job, read_drive(text, limit), background, field))
    return bouts


def _name(text: str) -> tuple[str, float]:
    name = DriveName.parse(text)
    return name.scene, name.rate_hz


def _bout(
    job: CompareJob, drive: DriveFrames, background: DriveFrames | None, field: RadianceField
) -> Bout:
    name, quality_db = drive.name, mean_psnr_db(field, drive.pictures)
    contest = Contest(name.scene, name.rate_hz, drive.frames, drive.digest, quality_db)
    families = rival_families(job.preset, quick=job.quick)
    families |= {coder.name: [coder] for coder in map(foreign_coder, job.methods)}
    seen = see_clip(field, drive.cameras)
    foregrounds = _foregrounds(drive, background)
    behind = None if background is None else background.digest
    stamp = revision() if behind is None else f"{revision()}-before-{behind[:16]}"
    coders = [
        FieldCoder(
            seen,
            f"{name}-{job.preset}-{seen.field_id[:12]}",
            stamp,
            preset=job.preset,
            references=references,
            foregrounds=() if behind is None else foregrounds,
        )
        for name, references in (("rfedge", None), ("rfedge-render-only", RENDER_ONLY))
    ]
    rival = None
    if behind is not None:
        rival_stamp = f"{stamp}-{seen.field_id}"
        rival = ForegroundCoder.of(job.preset, foregrounds, seen.renders, rival_stamp)
    return Bout(contest, seen, foregrounds, behind, coders, families, rival)


def _foregrounds(drive: DriveFrames, background: DriveFrames | None) -> list[NDArray[np.bool_]]:
    if background is None:
        return [np.zeros(frame.y.shape, bool) for frame in drive.frames]
    if len(background.frames) != len(drive.frames):
        counts = f"{len(background.frames)} frames where the drive has {len(drive.frames)}"
        raise InvalidInput("background", f"{drive.name.scene}: {counts}")
    pairs = zip(drive.frames, background.frames, strict=True)
    return [foreground_mask(*pair) for pair in pairs]
