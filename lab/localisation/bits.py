"""Measures the bits that errors of poses cost: the second kind of rows of ``rfedge-lab localise``.

A drive is coded at poses that the tracker found, from a sensor with errors, and at the dataset's
own poses; compared at equal luma PSNR: the mean difference of log(bits) over the qualities both
reach, points joined by straight lines.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.localisation.given import GivenDrive
from lab.localisation.pose_errors import PoseErrorModel, observed, parse_error_model
from lab.localisation.rows import BitsRow
from rfcore.camera import Pose
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, render_field_view
from rfcore.localise.estimate import LocalisationState
from rfcore.metrics import psnr_of_mse
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView, PosedPicture
from rfedge.evaluate.clips import luma_mse
from rfedge.located import LocatedDrive, Observation, TimedFix, times_of
from rfedge.offline import FrameInput, encode_frames

OFFICIAL = "official"
"""The pose error of a drive's ``feed``."""
OFFICIAL_SD_M, OFFICIAL_SD_DEG = 0.75, 1.0
"""Standard deviation assumed of the poses of a feed of ``map`` and ``feed_map``."""
TRACKED = 13
"""Pictures whose tracking is timed for rows of starts."""


def sensors_of(given: GivenDrive, errors: Sequence[str]) -> tuple[str, ...]:
    """Return the sensors that a drive is coded with: the models asked for, and its own feed."""
    return (*errors, *([OFFICIAL] if given.feed else []))


def bits_row(
    given: GivenDrive, sensor: str, crfs: Sequence[float], asked: tuple[int | None, int, int]
) -> BitsRow:
    """Return what a sensor costs on one drive; ``asked``: frames, threads and seed."""
    frames, threads, seed = asked
    field, pictures = given.read(threads)
    clip = pictures[: given.frames or frames]
    own, render_cpu_ms = _own_inputs(field, clip)
    official = given.feed_poses(field.metadata.tile_origin) if sensor == OFFICIAL else None
    if official is None:
        feed = _simulated(clip, sensor, given.units, seed)
    else:
        feed = _stated(clip, official, given.units)
    located = LocatedDrive(field, clip, feed)
    points = _points(_found_inputs(located, clip), crfs), _points(own, crfs)
    return _row(given.name, sensor, points, located.fixes, render_cpu_ms)


def tracking_times(given: GivenDrive, threads: int, seed: int) -> tuple[float, float]:
    """Return median processor times of tracking a picture and of a render alone, ms, over a drive's
    beginning."""
    field, pictures = given.read(threads)
    clip = pictures[:TRACKED]
    _, render_cpu_ms = _own_inputs(field, clip)
    located = LocatedDrive(field, clip, _simulated(clip, "white-small", given.units, seed))
    _found_inputs(located, clip)
    return _track_cpu_ms(located.fixes), render_cpu_ms


@dataclass(frozen=True)
class _Points:
    """A drive at several qualities: luma PSNR and log(bits), ascending."""

    psnr_db: tuple[float, ...]
    log_bits: tuple[float, ...]

    def percent_more(self, other: _Points) -> float:
        """Return how many more bits this takes than ``other``, over the qualities both reach."""
        low, high = max(self.psnr_db[0], other.psnr_db[0]), min(self.psnr_db[-1], other.psnr_db[-1])
        at = np.linspace(low, high, 101)
        mine, its = (np.interp(at, c.psnr_db, c.log_bits) for c in (self, other))
        return 100 * (math.exp(float(np.mean(mine - its))) - 1)


def _row(
    name: str,
    text: str,
    points: tuple[_Points, _Points],
    fixes: Sequence[TimedFix],
    render_cpu_ms: float,
) -> BitsRow:
    found, own = points
    searches = [fix.search_cpu_ms for fix in fixes if fix.search_cpu_ms]
    return BitsRow(
        name,
        text,
        found.percent_more(own),
        float(np.mean(found.psnr_db)),
        100 * float(np.mean([fix.fix.state is LocalisationState.TRACKING for fix in fixes])),
        float(np.median(searches)) if searches else None,
        _track_cpu_ms(fixes),
        render_cpu_ms,
    )


def _track_cpu_ms(fixes: Sequence[TimedFix]) -> float:
    """Return the median processor time of the pictures in which no search was run."""
    followed = [fix.track_cpu_ms for fix in fixes if not fix.search_cpu_ms]
    return float(np.median(followed)) if followed else math.nan


def _scaled(model: PoseErrorModel, units: float) -> PoseErrorModel:
    """Return a model of metres in the units of a field."""
    metres = {name: getattr(model, name) * units for name in ("noise_m", "offset_m", "walk_m")}
    return replace(model, **metres)


def _simulated(
    clip: Sequence[PosedPicture], sensor: str, units: float, seed: int
) -> list[Observation]:
    """Return what a sensor of that error model observes of a clip."""
    model = _scaled(parse_error_model(sensor), units)
    poses = [picture.camera.world_from_cam for picture in clip]
    return observed(times_of(clip), poses, model, np.random.default_rng(seed))


def _stated(clip: Sequence[PosedPicture], poses: Sequence[Pose], units: float) -> list[Observation]:
    """Return a feed that states these poses, one at each picture's time."""
    if len(poses) < len(clip):
        raise InvalidInput("feed", f"{len(poses)} poses for {len(clip)} pictures")
    spread_m = OFFICIAL_SD_M * units
    return [
        Observation(time_s, time_s, pose, spread_m, OFFICIAL_SD_DEG)
        for time_s, pose in zip(times_of(clip), poses, strict=False)
    ]


def _own_inputs(
    field: RadianceField, clip: Sequence[PosedPicture]
) -> tuple[list[FrameInput], float]:
    """Return what is coded at the dataset's poses, and the median CPU time of a render, ms."""
    inputs, render_cpu_ms = [], []
    for picture in clip:
        frame = i420_from_rgb(picture.read())
        begun_s = time.process_time()
        view = render_field_view(field, picture.camera.rounded())
        render_cpu_ms.append(1e3 * (time.process_time() - begun_s))
        inputs.append(FrameInput(frame, view))
    return inputs, float(np.median(render_cpu_ms))


def _found_inputs(located: LocatedDrive, clip: Sequence[PosedPicture]) -> list[FrameInput]:
    """Return what is coded at the poses that are found; lost pictures without the field."""
    inputs = []
    for picture in clip:
        frame = i420_from_rgb(picture.read())
        view = located.locate(picture, frame)
        shown = view or FieldView.nothing(picture.camera.intrinsics)
        inputs.append(FrameInput(frame, shown, lost=view is None))
    return inputs


def _points(inputs: Sequence[FrameInput], crfs: Sequence[float]) -> _Points:
    psnr_db, log_bits = zip(*sorted(_point(inputs, crf) for crf in crfs), strict=True)
    return _Points(psnr_db, log_bits)


def _point(inputs: Sequence[FrameInput], crf: float) -> tuple[float, float]:
    """Return luma PSNR of the mean squared error and log(bits) of a drive at one CRF."""
    width_px, height_px = inputs[0].frame.size_px
    encoder = DeltaEncoder(CodecConfig(width_px, height_px, crf=crf))
    coded = list(encode_frames(encoder, inputs))
    mse = float(np.mean([luma_mse(c.encoded.reconstruction, c.given.frame) for c in coded]))
    bits = 8 * sum(len(c.encoded.packet.payload) for c in coded)
    return psnr_of_mse(mse), math.log(bits)
