"""Run the published experiment over drives and fields; write one result file.

A finished piece is one frame at one size; its rows run over presets and rate factors. Two controls
stand beside every field, as render: ``grey`` knows nothing, ``behind`` is the field itself seen in
the opposite direction, the right kind of picture of the wrong place. They are rendered at the size
they are coded at, and at the largest of several sizes not at all: a hash grid takes long there.

``published_rows`` codes the two-frame clip of ``rfedge.evaluate.savings`` at every size,
preset and CRF; the camera frame alone, coded the same way, says what an I picture of it costs.
Nothing here is our own coding. PSNR and SSIM are of RGB, without the encoder's padding.
``downscaled`` renders and frames are made at the drive's size and reduced together, as published;
``native`` renders are made at the small size, which is what a vehicle would do.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console

from lab.paper import EvalPaper
from lab.paper.render_quality import (
    BANDS,
    RenderQuality,
    colour_ssim,
    flip,
    render_quality,
)
from lab.paper.report import PaperRow, paper_parts, paper_tables
from rfcore.camera import Camera, Pose
from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.ffmpeg import decode_clip
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.extras import needs, require
from rfcore.field import RadianceField
from rfcore.image import I420, Rgb, rgb_from_colour
from rfcore.metrics import psnr
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfcore.views import PosedPicture
from rfedge.arguments import open_field
from rfedge.evaluate.clips import Runs
from rfedge.evaluate.runner import Run, program_version
from rfedge.evaluate.savings import (
    intra_alone,
    published_clip,
    savings_of_clip,
    slice_nals,
)
from rfedge.jobs import CellStore, Job, Rows, Tell

if TYPE_CHECKING:
    from rfedge.evaluate.lpips import Lpips
with needs("eval"):
    import cv2

PUBLISHED_PRESETS = ("veryslow", "medium", "veryfast")
PUBLISHED_CRFS = (18.0, 23.0, 28.0)
Size = tuple[int, int]
Making = Literal["downscaled", "native"]
Alone = dict[tuple[Size, str, float], tuple[int, float]]
"""Slice bytes and PSNR in dB, by size, preset and CRF."""


@dataclass(frozen=True)
class PublishedFrame:
    """A camera frame, and how its render is made for a size: uint8 RGB [H, W, 3].

    ``alone``: what the camera frame takes coded by itself, kept for its other fields and controls.
    """

    name: str
    camera: Rgb
    render: Callable[[Size, Making], Rgb]
    alone: Alone = field(default_factory=dict)


@dataclass(frozen=True)
class Setting:
    """One combination of what the published averages run over."""

    size_px: Size
    making: Making
    preset: str
    crf: float


def published_rows(frame: PublishedFrame, settings: Sequence[Setting]) -> Iterator[dict[str, Any]]:
    """Yield a row per setting. Raises ``InvalidInput`` for a size larger than the frame."""
    pairs: dict[tuple[Size, Making], _Pair] = {}
    alone = frame.alone
    for setting in settings:
        made = (setting.size_px, setting.making)
        if made not in pairs:
            pairs[made] = _pair(frame, *made)
        camera, render, quality = pairs[made]
        coding = (setting.size_px, setting.preset, setting.crf)
        if coding not in alone:
            alone[coding] = _alone(camera, setting)
        yield {
            "width": setting.size_px[0],
            "height": setting.size_px[1],
            "render": setting.making,
            "preset": setting.preset,
            "crf": setting.crf,
            "frame": frame.name,
            **_coded(camera, render, setting),
            "camera_i_bytes": alone[coding][0],
            "camera_i_psnr_db": alone[coding][1],
            "rf_psnr_db": quality.psnr_db,
            "rf_ssim": quality.ssim,
            "rf_residual_bands": list(quality.bands),
        }


_Pair = tuple[Rgb, Rgb, RenderQuality]


def _pair(frame: PublishedFrame, size_px: Size, making: Making) -> _Pair:
    camera, render = reduced(frame.camera, size_px), frame.render(size_px, making)
    return camera, render, render_quality(render, camera)


def _alone(camera: Rgb, setting: Setting) -> tuple[int, float]:
    """Return slice bytes and PSNR of the camera frame coded by itself."""
    unit = intra_alone(i420_from_rgb(camera), setting.preset, setting.crf)
    shown = rgb_from_i420(_decoded((unit,), setting)[0])
    return sum(map(len, slice_nals(unit))), psnr(shown, camera)


def reduced(picture: Rgb, size_px: Size) -> Rgb:
    """Return the picture at a smaller size, each pixel the mean of the area it covers."""
    height, width = picture.shape[:2]
    if size_px == (width, height):
        return picture
    if size_px[0] > width or size_px[1] > height:
        raise InvalidInput("size", f"{size_px} px is larger than the frame's {(width, height)} px")
    smaller: Rgb = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return smaller


def _coded(camera: Rgb, render: Rgb, setting: Setting) -> dict[str, Any]:
    frame, reference = i420_from_rgb(camera), i420_from_rgb(render)
    clip = published_clip(frame, reference, setting.preset, setting.crf)
    sizes = savings_of_clip(clip)
    first, second = (rgb_from_i420(picture) for picture in _decoded(clip, setting))
    return {
        "i_bytes": sizes.i_bytes,
        "p_bytes": sizes.p_bytes,
        "second_type": sizes.second_type,
        "header_bytes": sum(map(len, clip)) - sizes.i_bytes - sizes.p_bytes,
        "savings_percent": sizes.percent,
        "i_psnr_db": psnr(first, render),
        "psnr_db": psnr(second, camera),
        "ssim": colour_ssim(second, camera),
    }


def _decoded(clip: Sequence[bytes], setting: Setting) -> list[I420]:
    config = CodecConfig(*setting.size_px, effort_of_preset(setting.preset), setting.crf)
    return [p.cropped(setting.size_px) for p in decode_clip(config.coded_size_px, clip)]


CONTROL_PRESET, CONTROL_CRF = "medium", 23.0
TURNED_ROUND = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
"""Half a turn about the camera's vertical axis."""
QUICK_PICTURES = Runs(2, 1)


@dataclass(frozen=True, eq=False)
class DriveFrame:
    """One frame of one drive, with what its fields and sizes share."""

    scene: str
    picture: PosedPicture
    alone: Alone = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """The digest of pixels and camera."""
        pose = repr(self.picture.camera).encode()
        return hashlib.sha256(_pixels_of(self).tobytes() + pose).hexdigest()


@dataclass(frozen=True, eq=False)
class NamedField:
    """A field by its name in the result."""

    name: str
    field: RadianceField


@dataclass(frozen=True)
class Shot:
    """One frame of one drive, one field and one size, with controls beside it or without."""

    source: DriveFrame
    opened: NamedField
    size_px: Size
    controlled: bool
    lpips: Sequence[Lpips]
    """Networks to compare the render with the camera by, AlexNet first; or none."""


def named_path(text: str) -> tuple[str, Path]:
    """Return name and path of ``NAME=PATH``; raise ``InvalidInput`` for another form."""
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise InvalidInput("name", f"{text!r} is not NAME=PATH, as 3dgs=street.rff")
    return name, Path(path)


def run_paper(job: EvalPaper, console: Console) -> dict[str, Any]:
    """Run what is not there yet, write the result and print the means.

    Raises ``InvalidInput``, ``DatasetError`` or ``FieldFormatError`` before anything is coded if an
    input is wrong.
    """
    require("eval", "flip_evaluator")
    fields = _opened(job)
    shots = list(_shots(job, fields))
    inputs = [path for _, path in map(named_path, (*job.fields, *job.drives))]
    run = Run.begin("paper", job, inputs, console)
    pictures = _by_picture(job, shots)
    _say_cost(pictures, run, job.processes)
    jobs = [
        Job(f"picture-{number + 1}", partial(_code_picture, job, number))
        for number in range(len(pictures))
    ]
    run.parallel(jobs, job.processes)
    rows = [row for shot in shots for row in run.store.rows(_key(shot), _maker(shot))]
    content = {
        "field_ids": {opened.name: opened.field.field_id for opened in fields},
        "lpips": "by AlexNet and VGG16" if job.lpips_weights else "n/a: no weights",
        "bands_cycles_per_px": BANDS,
        "tables": paper_tables([PaperRow.of(row) for row in rows]),
    }
    return run.finish(content, paper_parts)


def _opened(job: EvalPaper) -> list[NamedField]:
    return [NamedField(name, open_field(path)) for name, path in map(named_path, job.fields)]


def _code_picture(job: EvalPaper, number: int, _tell: Tell) -> None:
    """Keep the rows of the job's picture of that number."""
    _keep_rows(_pictures_of_process(job)[number], CellStore(job.cells))


def _keep_rows(shots: Sequence[Shot], store: CellStore) -> None:
    for shot in shots:
        store.rows(_key(shot), _maker(shot))


@lru_cache(maxsize=1)
def _pictures_of_process(job: EvalPaper) -> list[Sequence[Shot]]:
    return _by_picture(job, list(_shots(job, _opened(job))))


def _by_picture(job: EvalPaper, shots: Sequence[Shot]) -> list[Sequence[Shot]]:
    """Return the shots of each picture, which follow one another: every field, every size."""
    each = len(job.fields) * len(job.sizes_px)
    return [shots[first : first + each] for first in range(0, len(shots), each)]


def views_of(job: EvalPaper) -> list[tuple[str, Rgb]]:
    """Return the first frame of each drive as the camera has it and as each field renders it."""
    views = []
    for scene, path in map(named_path, job.drives):
        picture = read_dataset(path).pictures[0]
        views.append((f"{scene}: camera", picture.read()))
        for name, field_path in map(named_path, job.fields):
            views.append((f"{scene}: {name}", _render(open_field(field_path), picture.camera)))
    return views


def _shots(job: EvalPaper, fields: Sequence[NamedField]) -> Iterator[Shot]:
    lpips: list[Lpips] = []
    if job.lpips_weights is not None:
        from rfedge.evaluate.lpips import SHA256, Lpips

        lpips = [Lpips(job.lpips_weights, network) for network in SHA256]
    for scene, path in map(named_path, job.drives):
        pictures: Sequence[PosedPicture] = read_dataset(path).pictures[:: job.every]
        if job.quick:
            pictures = [pictures[k] for k in QUICK_PICTURES.chosen(len(pictures))]
        for picture in pictures:
            frame = DriveFrame(scene, picture)
            for opened in fields:
                for size_px in job.sizes_px:
                    controlled = size_px != max(job.sizes_px) or len(job.sizes_px) == 1
                    yield Shot(frame, opened, size_px, controlled, lpips)


def _key(shot: Shot) -> dict[str, str | float | int | None]:
    return {
        "field": shot.opened.field.field_id,
        "field_name": shot.opened.name,
        "scene": shot.source.scene,
        "frame": shot.source.picture.name,
        "input": shot.source.digest,
        "width": shot.size_px[0],
        "height": shot.size_px[1],
        "controlled": shot.controlled,
        "lpips": "; ".join(each.version for each in shot.lpips),
        "program": program_version("lab/paper"),
    }


def _maker(shot: Shot) -> Any:
    return lambda: list(_rows(shot))


def _rows(shot: Shot) -> Iterator[dict[str, Any]]:
    settings = [
        Setting(shot.size_px, making, preset, crf)
        for making in _makings(shot)
        for preset in PUBLISHED_PRESETS
        for crf in PUBLISHED_CRFS
    ]
    frame = _published_frame(shot, shot.source.picture.camera)
    size_px = shot.size_px
    pair = frame.render(size_px, "downscaled"), reduced(frame.camera, size_px)
    names = ("rf_lpips", "rf_lpips_vgg")
    distances = dict(zip(names, (each.distance(*pair) for each in shot.lpips), strict=False))
    distances["rf_flip"] = flip(*pair)
    for row in _labelled(shot, shot.opened.name, frame, settings):
        yield row if row["render"] == "native" else {**row, **distances}
    if shot.controlled:
        yield from _control_rows(shot)


def _control_rows(shot: Shot) -> Iterator[dict[str, Any]]:
    control = [Setting(shot.size_px, _makings(shot)[-1], CONTROL_PRESET, CONTROL_CRF)]
    camera = shot.source.picture.camera
    behind = Camera(camera.intrinsics, camera.world_from_cam.compose(TURNED_ROUND))
    yield from _labelled(
        shot, f"{shot.opened.name}:behind", _published_frame(shot, behind), control
    )
    grey = np.full((camera.intrinsics.height_px, camera.intrinsics.width_px, 3), 128, np.uint8)
    without_field = PublishedFrame(
        shot.source.picture.name,
        _pixels_of(shot.source),
        lambda size_px, _making: reduced(grey, size_px),
        shot.source.alone,
    )
    yield from _labelled(shot, f"{shot.opened.name}:grey", without_field, control)


def _makings(shot: Shot) -> Sequence[Making]:
    k = shot.source.picture.camera.intrinsics
    full = shot.size_px == (k.width_px, k.height_px)
    return ("downscaled",) if full else ("downscaled", "native")


def _labelled(shot: Shot, label: str, frame: PublishedFrame, settings: Sequence[Setting]) -> Rows:
    return [
        {"field": label, "scene": shot.source.scene, **row}
        for row in published_rows(frame, settings)
    ]


def _published_frame(shot: Shot, camera: Camera) -> PublishedFrame:
    def render(size_px: Size, making: Making) -> Rgb:
        if making == "downscaled":
            return reduced(_at_own_size(shot.opened, camera), size_px)
        return _render(
            shot.opened.field, Camera(camera.intrinsics.resized(*size_px), camera.world_from_cam)
        )

    source = shot.source
    return PublishedFrame(source.picture.name, _pixels_of(source), render, source.alone)


@lru_cache(maxsize=1)
def _pixels_of(source: DriveFrame) -> Rgb:
    """Return the camera's picture, read once for all fields and sizes that follow one another."""
    return source.picture.read()


@lru_cache(maxsize=1)
def _at_own_size(opened: NamedField, camera: Camera) -> Rgb:
    """Return the render that those at a frame's smaller sizes are made of."""
    return _render(opened.field, camera)


def _render(field: RadianceField, camera: Camera) -> Rgb:
    return rgb_from_colour(field.render_colour(camera))


def _say_cost(pictures: Sequence[Sequence[Shot]], run: Run, processes: int) -> None:
    """Do the first picture that is not whole, and say what the others will take.

    A whole picture, for its sizes share what reading it and rendering it at full size take.
    """
    left = [shots for shots in pictures if not all(run.store.has(_key(shot)) for shot in shots)]
    estimate = "nothing left to do"
    if left:
        began_s = monotonic()
        _keep_rows(left[0], run.store)
        total_s = (monotonic() - began_s) * (len(left) - 1)
        estimate = f"{len(left)} left, about {total_s / processes / 60:.1f} minutes"
    run.tell(f"{len(pictures)} pictures, {estimate}")
