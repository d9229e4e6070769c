"""Run the robustness experiment: loss, pose noise and light.

Loss: every method at some CRFs over the same link, with each of the seeds the same losses for all;
what is compared is SSIM at one total rate, interpolated between CRFs, as the mean over the seeds
and the 95 % interval of that mean (bootstrap over seeds). The rest: bits at equal quality, against
nothing disturbed and against x264, which no pose disturbs.

Pose noise is independent from frame to frame, normal in each axis of translation and rotation, in
the camera's own axes. Both ends render at the noisy pose, since it is the one that is sent; or the
sender first finds the frame in the field, with the noisy pose as what is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import groupby, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.robust import EvalRobust
from lab.robust.lossy_link import (
    Bursts,
    Crossing,
    FrameCoder,
    Policy,
    delta_crossing,
    x264_crossing,
)
from lab.robust.report import CrossingRow, DisturbanceRow, LossRow, robust_parts
from rfcore.camera import Camera, Pose
from rfcore.codec.photometric import Photometric
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.image import I420
from rfcore.localise.estimate import PosePrior
from rfcore.localise.localiser import Localised, Localiser
from rfcore.motion import quaternion_from_vector
from rfedge.evaluate.clips import ONE_RUN, Clip, ClipCoder, CodedClip, Drive, Runs, read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.performance import perform
from rfedge.evaluate.rivals import x264_lowdelay
from rfedge.evaluate.runner import Run, program_version
from rfedge.jobs import CellStore, Job, Tell
from rfedge.results import rows_of


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations, per axis."""

    position_m: float = 0.0
    rotation_deg: float = 0.0

    def __str__(self) -> str:
        return f"{100 * self.position_m:g} cm, {self.rotation_deg:g} deg"


NOISES = (
    PoseNoise(),
    PoseNoise(0.02, 0.02),
    PoseNoise(0.05, 0.05),
    PoseNoise(0.1, 0.1),
    PoseNoise(0.2, 0.5),
)
"""Errors from none to those of a receiver of satellites alone."""


def noisy_cameras(cameras: Sequence[Camera], noise: PoseNoise, seed: int) -> list[Camera]:
    """Return ``cameras`` with their poses disturbed, the same way for every size of noise."""
    rng = np.random.default_rng(seed)
    disturbed = []
    for camera in cameras:
        shift, turn = rng.normal(size=3), rng.normal(size=3)
        x, y, z = (float(v) for v in noise.position_m * shift)
        a, b, c = (float(v) for v in np.deg2rad(noise.rotation_deg) * turn)
        step = Pose((x, y, z), quaternion_from_vector((a, b, c)))
        disturbed.append(Camera(camera.intrinsics, camera.world_from_cam.compose(step)))
    return disturbed


def refined_cameras(
    field: RadianceField, frames: Sequence[I420], measured: Sequence[Camera], noise: PoseNoise
) -> tuple[list[Camera], int]:
    """Return where each frame's camera is found in the field, and of how many frames it is.

    Each frame by itself, without those before it; one that is lost stays where it was measured.
    """
    localiser = Localiser(field, measured[0].intrinsics)
    cameras, found = [], 0
    for frame, camera in zip(frames, measured, strict=True):
        prior = PosePrior(camera.world_from_cam, noise.position_m, noise.rotation_deg)
        answer = localiser.localise_luma(frame.y, prior)
        if isinstance(answer, Localised):
            camera, found = Camera(camera.intrinsics, answer.world_from_cam), found + 1
        cameras.append(camera)
    return cameras, found


def kbit_at(clips: Sequence[CodedClip], quality_db: float) -> float:
    """Return kilobits a frame at a luma PSNR, the first frame left out; raises as
    ``kbit_between``."""
    points = ((clip.psnr_db(), clip.bytes_per_frame()) for clip in clips)
    return kbit_between(points, quality_db, "quality_db")


def kbit_between(points: Iterable[tuple[float, float]], quality_db: float, name: str) -> float:
    """Return kilobits a frame at a luma PSNR, log(bits) linear in dB between ``points`` (dB, bytes
    a frame). Raises ``InvalidInput``, naming ``name``, when they do not span the quality."""
    qualities, sizes = zip(*sorted(points), strict=True)
    if not qualities[0] <= quality_db <= qualities[-1]:
        raise InvalidInput(
            name,
            f"{quality_db:g} dB is outside the {qualities[0]:.2f}..{qualities[-1]:.2f} dB reached",
        )
    log_kbit = [math.log(8e-3 * size) for size in sizes]
    return math.exp(float(np.interp(quality_db, qualities, log_kbit)))


LOSSES = (0.0, 0.01, 0.05)
DELTA_CRFS, X264_CRFS = (20.0, 27.0), (22.0, 27.0, 33.0, 39.0, 45.0)
DISTURBED_CRFS, RIVAL_CRFS = (23.0, 28.0, 33.0), (20.0, 25.0, 30.0, 35.0)
SEED = 5
"""The first of the seeds; without loss there is one."""
RESAMPLED = 2000


def run_robust(job: EvalRobust, console: Console) -> dict[str, Any]:
    """Do what is not done yet, write the result and print its rows."""
    run = Run.begin("robust", job, [job.field], console)
    bench = _bench(job, run.store, console)
    drive, field, count = bench.drive, bench.field, len(bench.drive.frames)
    scenarios = bench.scenarios()
    disturbances = 2 * len(bench.noises()) + 2
    run.tell(f"{len(scenarios)} crossings and {disturbances} disturbances of {count} frames")
    jobs = [
        Job(f"crossings-{number}", partial(_cross, job, same))
        for number, same in enumerate(_of_a_seed(scenarios), 1)
    ]
    run.parallel(jobs, job.processes)
    crossed = [bench.crossed(*scenario) for scenario in scenarios]
    disturbed = [*bench.pose_rows(), bench.lane_row(), *bench.light_rows()]
    content = {
        "seed": SEED,
        "field_id": field.field_id,
        "frames": {"drive": job.drive, "count": count, "sha256": drive.digest},
        "quality_db": job.quality_db,
        "crossings": crossed,
        **_at_equal_rate(crossed, intervals=not job.quick),
        "disturbances": disturbed,
    }
    return run.finish(content, robust_parts)


Scenario = tuple[str, float, float, float, int]
"""Method, round trip in ms, loss, CRF and seed of a crossing."""


def _of_a_seed(scenarios: Sequence[Scenario]) -> list[list[Scenario]]:
    """Return scenarios by coder and seed, which one job crosses."""
    return [
        list(same)
        for _, same in groupby(scenarios, lambda each: (each[0].startswith("x264"), *each[3:]))
    ]


def _cross(job: EvalRobust, scenarios: Sequence[Scenario], _tell: Tell) -> None:
    """Keep the rows of the crossings."""
    bench = _bench_of_process(job)
    for scenario in scenarios:
        bench.crossed(*scenario)


@lru_cache(maxsize=1)
def _bench_of_process(job: EvalRobust) -> Bench:
    return _bench(job, CellStore(job.cells), Console())


def _bench(job: EvalRobust, store: CellStore, console: Console) -> Bench:
    drive = read_drive(job.drive, _limit(job))
    return Bench(job, load_field(job.field), drive, store, console)


def _limit(job: EvalRobust) -> int | Runs:
    """Return the frames to read of a drive; time goes on over all, so a quick run has one run."""
    return ONE_RUN if job.quick else job.frames


@dataclass(frozen=True)
class Bench:
    """A drive, a field and where finished pieces are kept, for every part of the experiment."""

    job: EvalRobust
    field: RadianceField
    drive: Drive
    store: CellStore
    console: Console

    # --- loss

    def scenarios(self) -> list[Scenario]:
        """Return every crossing.

        Those of one seed and one coder follow one another, for what they have in common.
        """
        every = self.job.rtts_ms
        rtts = dict.fromkeys((every[0], every[-1])) if self.job.quick else every
        losses = (LOSSES[0], LOSSES[-1]) if self.job.quick else LOSSES
        own = [str(policy) for policy in Policy]
        rivals = ["x264-intra-refresh", "x264-idr-on-nack"]
        ours = product(DELTA_CRFS, own, rtts, losses)
        theirs = product(X264_CRFS, rivals, rtts, losses)
        seeds = range(SEED, SEED + self.job.seeds)
        made = [
            (method, rtt_ms, loss, crf, seed)
            for crf, method, rtt_ms, loss in (*ours, *theirs)
            for seed in (seeds if loss else seeds[:1])
        ]
        return sorted(made, key=lambda scenario: (scenario[0].startswith("x264"), *scenario[3:]))

    def crossed(
        self, method: str, rtt_ms: float, loss: float, crf: float, seed: int
    ) -> CrossingRow:
        """Return the row of one crossing."""
        drive, rate_hz = self.drive, self.drive.name.rate_hz
        facts: dict[str, Any] = {
            "method": method,
            "rtt_ms": rtt_ms,
            "loss_percent": 100 * loss,
            "crf": crf,
            "seed": seed,
        }
        crossing = Crossing(
            drive.frames, rate_hz, self.job.preset, crf, Bursts(loss), rtt_ms / 1e3, seed
        )
        key: dict[str, str | float | int | None] = {
            **facts,
            "verb": "robust",
            "field": self.field.field_id,
            "frames": drive.digest,
            "hz": rate_hz,
            "effort": self.job.effort,
            "preset": self.job.preset,
            "program": program_version("lab/robust"),
        }
        (row,) = self.store.rows(key, lambda: [self._outcome(method, crossing)])
        (crossed,) = rows_of(CrossingRow, [{**facts, **row}])
        return crossed

    def _outcome(self, method: str, crossing: Crossing) -> dict[str, Any]:
        if method.startswith("x264"):
            made = x264_crossing(crossing, idr_on_nack=method.endswith("nack"))
        else:
            made = delta_crossing(crossing, self._coder(crossing.crf), Policy(method))
        row = made.row(crossing.rate_hz)
        self.console.print(
            f"  {method} {1e3 * crossing.rtt_s:.0f} ms {100 * crossing.bursts.share:g} %: "
            f"{row['kbps']:.0f} kbit/s, SSIM {row['ssim']:.4f}"
        )
        return row

    @cached_property
    def _coders(self) -> dict[float, FrameCoder]:
        return {}

    def _coder(self, crf: float) -> FrameCoder:
        """Return the coder of all crossings at ``crf``; the last one asked for is kept."""
        if crf not in self._coders:
            self._coders.clear()
            rendered = render_clip(self.field, self.drive.cameras)
            self._coders[crf] = FrameCoder(self.drive.frames, rendered, self.job.effort, crf)
        return self._coders[crf]

    # --- pose and light

    def noises(self) -> Sequence[PoseNoise]:
        """Return the sizes of pose noise."""
        return (NOISES[0], NOISES[-2]) if self.job.quick else NOISES

    def pose_rows(self) -> list[DisturbanceRow]:
        """Return what noise of each size costs, and what is left of it after refinement."""
        drive, rival = self.drive, self._rival(self.drive)
        still, *noises = self.noises()
        kbit = self._own(drive, f"pose noise {still}", drive.cameras)
        rows = [self._row("pose noise", str(still), kbit, None, rival)]
        for noise in noises:
            measured = noisy_cameras(drive.cameras, noise, SEED)
            refined, found = refined_cameras(self.field, drive.frames, measured, noise)
            for condition, cameras, frames_found in (
                ("pose noise", measured, None),
                ("refined pose noise", refined, found),
            ):
                kbit = self._own(drive, f"{condition} {noise}", cameras)
                rows.append(self._row(condition, str(noise), kbit, rows[0], rival, frames_found))
        return rows

    def lane_row(self) -> DisturbanceRow:
        """Return what driving in another lane than the training views costs."""
        if self.job.lane is None:
            why = "no drive with a lane offset was given (--lane NAME@HZ=DATASET)"
            return DisturbanceRow("lane offset", "n/a", why)
        drive = read_drive(self.job.lane, _limit(self.job))
        kbit = self._own(drive, "lane", drive.cameras)
        return self._row("lane offset", drive.name.scene, kbit, None, self._rival(drive))

    def light_rows(self) -> list[DisturbanceRow]:
        """Return what a drive at dusk costs with a field of noon, its light changed or not."""
        if self.job.dusk is None:
            why = "no drive in another light was given (--dusk NAME@HZ=DATASET)"
            return [DisturbanceRow("light", "n/a", why)]
        drive = read_drive(self.job.dusk, _limit(self.job))
        rival, rows = self._rival(drive), list[DisturbanceRow]()
        for level, choice in (("uncorrected", ()), ("adapted", None)):
            kbit = self._own(drive, level, drive.cameras, photometric=choice)
            rows.append(self._row("light", level, kbit, rows[0] if rows else None, rival))
        return rows

    def _own(
        self,
        drive: Drive,
        condition: str,
        cameras: Sequence[Camera],
        photometric: Photometric | None = None,
    ) -> float:
        """Return kilobits a frame at the quality asked for, rendered from ``cameras``."""
        coder = FieldCoder(
            render_clip(self.field, cameras),
            f"rfedge-{self.job.effort}-{self.field.field_id}",
            program_version("lab/robust"),
            effort=self.job.effort,
            photometric=photometric,
            points=DISTURBED_CRFS,
        )
        return self._kbit(drive.clip(condition), coder)

    def _rival(self, drive: Drive) -> float:
        coder = replace(x264_lowdelay(self.job.preset), points=RIVAL_CRFS)
        return self._kbit(drive.clip(""), coder)

    def _kbit(self, clip: Clip, coder: ClipCoder) -> float:
        at_db = self.job.quality_db
        coded = perform(clip, coder, self.store, window_db=(at_db, at_db))
        return kbit_at(coded.clips, at_db)

    def _row(
        self,
        condition: str,
        level: str,
        kbit: float,
        base: DisturbanceRow | None,
        rival_kbit: float,
        frames_found: int | None = None,
    ) -> DisturbanceRow:
        undisturbed = kbit if base is None or base.kbit is None else base.kbit
        return DisturbanceRow(
            condition=condition,
            level=level,
            kbit=kbit,
            more_percent=100 * (kbit / undisturbed - 1),
            x264_kbit=rival_kbit,
            against_x264_percent=100 * (kbit / rival_kbit - 1),
            frames_found=frames_found,
        )


def _at_equal_rate(crossed: Sequence[CrossingRow], *, intervals: bool) -> dict[str, Any]:
    """Return SSIM of every scenario at one rate, near the middle of what all can be interpolated
    at."""
    curves: dict[tuple[str, float, float], dict[int, list[CrossingRow]]] = {}
    for row in crossed:
        seeds = curves.setdefault((row.method, row.rtt_ms, row.loss_percent), {})
        seeds.setdefault(row.seed, []).append(row)
    every = [curve for seeds in curves.values() for curve in seeds.values()]
    low = max(min(row.kbps for row in curve) for curve in every)
    high = min(max(row.kbps for row in curve) for curve in every)
    if low > high:
        raise InvalidInput("crf", f"no rate is reached by all: {low:.0f} > {high:.0f} kbit/s")
    rate_kbps = float(np.sqrt(low * high))
    rows = []
    for scenario, seeds in curves.items():
        at_rate = np.array([_at_rate(curve, rate_kbps) for curve in seeds.values()])
        ssim, ssim_p5 = at_rate.mean(axis=0).tolist()
        interval = _interval(at_rate[:, 0]) if intervals and len(seeds) > 1 else None
        rows.append(LossRow(*scenario, ssim, ssim_p5, len(seeds), interval))
    return {"equal_rate_kbps": rate_kbps, "rows": rows}


def _at_rate(curve: Sequence[CrossingRow], rate_kbps: float) -> tuple[float, float]:
    """Return SSIM, mean and 5th percentile of the frames, linear in log(rate) between CRFs."""
    points = sorted(curve, key=lambda row: row.kbps)
    log_rates = np.log([row.kbps for row in points])
    at = np.log(rate_kbps)
    mean = np.interp(at, log_rates, [row.ssim for row in points])
    return float(mean), float(np.interp(at, log_rates, [row.ssim_p5 for row in points]))


def _interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the 95 % interval of the mean: percentiles of the means of resampled values."""
    chosen = np.random.default_rng(SEED).integers(len(values), size=(RESAMPLED, len(values)))
    low, high = np.quantile(values[chosen].mean(axis=1), (0.025, 0.975)).tolist()
    return low, high
