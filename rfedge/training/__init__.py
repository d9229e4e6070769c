"""``rfedge train``: train a radiance field from posed pictures."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from rfcore.errors import InvalidInput, RfedgeError
from rfedge.arguments import DATASET, FOLDER, PLY, SIZE, parse_size

if TYPE_CHECKING:
    from rich.console import Console

    from rfcore.dataset import Dataset
    from rfcore.field import RadianceField
    from rfcore.train.ngp import NgpTrainingConfig
    from rfcore.train.splats import SplatTrainingConfig
    from rfedge.datasets.convert import SplitTile
    from rfedge.jobs import Job, Tell
    from rfedge.training.run import Trained, TrainingJob
    from rfedge.training.view import Snapshots

SH_RISE = 0.1
"""Share of the run after which the next degree joins; it saves time at the same quality."""
TILE_CHECKPOINT_EVERY = 500
"""Iterations between checkpoints of a tile: the most that a killed worker loses."""
DEFAULT_LIMIT = 250_000
"""Largest set of a run limited by time: about what two cores train in five minutes."""
KEPT_SHARE, MOST_KEPT_S = 0.25, 120.0
"""Share of --minutes that is kept for levels of detail, and the most: all their iterations take
about 90 s on two cores."""
HALVED_UNTIL, LARGE_HALVED_UNTIL = (0.25,), (0.6, 0.25)
"""Shares of a run with smaller pictures (docs/how-to/training.md): of one limited by time, and of
every one with pictures larger than ``LARGE_PX`` pixels."""
LARGE_PX = 500_000


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "phone-video": {"undistort": True, "minutes": 5.0},
    "street": {"minutes": 12.0, "limit": 400_000, "antialiased": True, "sh_degree": 1},
    "object": {"minutes": 5.0, "limit": 150_000},
}
"""Options that suit kinds of pictures (docs/how-to/training.md has the measurements)."""


@dataclass(frozen=True)
class Train:
    """Train a radiance field from posed pictures.

    Gaussians start at the dataset's points, at those of --points or --depths, or at random points
    in the volume that the cameras see. A run limited by iterations gives the same bytes every time,
    even if it was interrupted; a run limited by --minutes depends on the machine.
    """

    dataset: Annotated[Path, Positional, DATASET]
    """A dataset's folder, or the file that describes it (transforms.json, COLMAP, KITTI, ...). Of a
    folder that `rfedge dataset split` made, every tile is trained."""
    out: Annotated[Path, arg(metavar="FILE.rff|FOLDER")]
    """The field archive to write; for tiles, a folder, in which finished tiles are kept."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Train tiles in parallel on the Ray cluster at this address; local starts one here. Each tile
    takes --threads cores. The fields have the same bytes. Needs the extra ray."""
    preset: Literal["phone-video", "street", "object"] | None = None
    """Set options that suit a phone's video (--undistort, 5 minutes), a street's map (12 minutes,
    --limit 400000, --antialiased, --sh-degree 1) or views around an object (5 minutes, --limit
    150000); what is given besides stays."""
    held_out: Annotated[Path | None, DATASET] = None
    """Another dataset of the same place, for measuring only."""
    holdout: Annotated[int | None, arg(metavar="N")] = None
    """Measure on every Nth picture of the dataset, and train on the others."""
    views_percent: float = 100.0
    """Share of the pictures to train on, evenly spread."""
    points: Annotated[Path | None, PLY] = None
    """A .ply file of coloured surface points, instead of the dataset's own."""
    depths: Annotated[Path | None, FOLDER] = None
    """A folder of depth maps to take points from: NAME.npy in metres or 16-bit NAME.png in mm."""
    size: Annotated[str | None, SIZE] = None
    """Reduce pictures to WIDTHxHEIGHT, in pixels."""
    undistort: bool = False
    """Remove lens distortion from the pictures; otherwise distorted pictures are refused."""
    minutes: float | None = None
    """Length of the run in minutes, instead of a number of iterations. A quarter of it, at most two
    minutes, is kept for levels of detail and compression, or more where the machine needs it;
    choosing a size (--max-mb, --passes) comes after it."""
    iterations: int | None = None
    """Training iterations, one picture each; default: the trainer's own."""
    gaussians: int | None = None
    """Largest number of Gaussians to start with, drawn from the points at random."""
    sky: Annotated[int, arg(metavar="DIRECTIONS")] = 0
    """Also start Gaussians of the sky, 100 km away: try this number of directions, and take those
    in which all pictures show the same colour. 60000 suits a street under clouds; 0: none. They are
    added to --gaussians and count for --limit."""
    limit: int | None = None
    """Density control: let the set grow to this number of Gaussians, and replace those that show
    nothing. Default: 250000 with --minutes, otherwise the set does not grow."""
    sh_degree: int = 3
    """Degree of the spherical harmonics of colours, 0..3."""
    antialiased: bool = False
    """Draw splats smaller than a pixel fainter; for pictures of several sizes."""
    seed: int = 1
    """Seed of every random choice."""
    threads: int = 2
    """Threads of the rasterizer."""
    name: Annotated[str, arg(metavar="NAME")] = "field"
    """Name in the archive's header."""
    plain: bool = False
    """Write the parameters as trained, without lower levels of detail and compression."""
    max_mb: float | None = None
    """Largest size of the field, MB (10^6 bytes)."""
    passes: int | None = None
    """Choose the size with the fewest bytes of field and stream over this number of passes through
    the held-out pictures; --max-mb limits the choice."""
    checkpoint_every: int = 0
    """Iterations between two writes of OUT.ckpt; 0: never."""
    resume: bool = False
    """Go on from OUT.ckpt."""
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write the result as JSON to this file; `-` is standard output."""
    report: Annotated[Path | None, arg(metavar="FILE.html")] = None
    """Write a page with held-out pictures and quality over time; needs --holdout or --held-out."""
    view: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """Show the splats in a browser while they are trained, beside the pictures of --held-out:
    127.0.0.1:8080. Other addresses need RFEDGE_TWIN_TOKEN (docs/how-to/twin.md)."""
    refine_poses: bool = False
    """Refine the pictures' poses with the field, and write them to OUT.tum; for poses of GNSS or
    odometry. Held-out pictures are measured at aligned poses, too."""
    align_held_out: bool = False
    """Measure held-out pictures also at poses aligned with the field, to compare a run with one of
    --refine-poses."""
    kind: Literal["splats", "ngp"] = "splats"
    """3D Gaussians, or the hash grid of Instant-NGP; options of Gaussians do not apply to it."""

    @property
    def size_px(self) -> tuple[int, int] | None:
        """The size that pictures are reduced to; raises ``InvalidInput`` for other text."""
        return parse_size(self.size) if self.size is not None else None

    def run(self) -> None:
        """Train the dataset, or every tile of a split, and write the files that were asked for."""
        from rich.console import Console

        from rfedge.datasets.convert import read_tiles

        if self.preset is not None:
            self._with_preset().run()
            return
        tiles = read_tiles(self.dataset)
        if tiles is not None:
            self._train_tiles(tiles)
            return
        if self.ray is not None:
            raise InvalidInput("ray", f"trains tiles, and {self.dataset} has no tiles.json")
        self.train_one(Console(stderr=self.json == "-"))

    def _with_preset(self) -> Train:
        """Return these options with those of the preset where they are left at their defaults."""
        assert self.preset is not None
        default = {each.name: each.default for each in fields(self)}
        preset = dict(PRESETS[self.preset])
        if self.iterations is not None:
            preset.pop("minutes")
        chosen = {k: v for k, v in preset.items() if getattr(self, k) == default[k]}
        given = {k: getattr(self, k) for k in preset if k not in chosen}
        given |= {"iterations": self.iterations} if self.iterations is not None else {}
        words = f"preset {self.preset}: {_words(chosen)}"
        words += f"; given: {_words(given)}" if given else ""
        print(words, file=sys.stderr)
        return replace(self, preset=None, **chosen)

    def train_one(self, console: Console) -> None:
        """Train the field of one dataset, and write it."""
        from rfcore.field import save_field
        from rfedge.results import write_result
        from rfedge.training.run import outcome_of, train, training_result

        if self.out.suffix != ".rff":
            raise InvalidInput("out", f"{self.out} must end in .rff")
        if self.report is not None and self.holdout is None and self.held_out is None:
            raise InvalidInput(
                "report",
                "shows pictures that were not trained on, and none are held out: add --holdout 8 "
                "(every 8th picture) or --held-out DATASET",
            )
        if (self.plain or self.kind == "ngp") and (self.max_mb, self.passes) != (None, None):
            raise InvalidInput("max_mb", "and --passes go with --kind splats, and not with --plain")
        if self.refine_poses and self.kind == "ngp":
            raise InvalidInput("refine_poses", "goes with --kind splats alone")
        job = self.training_job()
        with self._shown(console) as show:
            trained = train(job, console, show)
        field = self._finished(job, trained, console)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(field, self.out)
        console.print(f"{self.out}: field {field_id}, {trained.primitives:,} primitives")
        self._write_poses(job, trained, console)
        result = training_result(job, trained, field, self.out)
        if self.json is not None:
            write_result(self.json, result)
        if self.report is not None:
            from rfedge.training.report import write_training_report

            write_training_report(self.report, result, field, job.held_out)
            console.print(f"{self.report}: held-out pictures and the curve over time")
        outcome = outcome_of(job, trained, field)
        if outcome.is_failure:
            raise RfedgeError(f"{self.out}: {outcome.text}")
        console.print(f"  {outcome.text}", highlight=False)

    def _train_tiles(self, tiles: tuple[SplitTile, ...]) -> None:
        """Train every tile into ``out``, a folder that `rfedge field publish` takes."""
        import shutil

        from rfcore.extras import require
        from rfedge.datasets.convert import LIST_NAME
        from rfedge.jobs import run_jobs

        self._require_tile_options()
        if self.ray is not None:
            require("ray", "ray")
        jobs = [self._tile_job(tile.name) for tile in tiles]
        self.out.mkdir(parents=True, exist_ok=True)
        done_before = run_jobs(jobs, partial(print, flush=True), self.ray)
        shutil.copyfile(self.dataset / LIST_NAME, self.out / LIST_NAME)
        print(f"{self.out}: {len(jobs)} tiles, {done_before} of them trained before")

    def _require_tile_options(self) -> None:

        refused = ["held_out", "points", "depths", "minutes", "json", "report", "view", "resume"]
        default = {each.name: each.default for each in fields(self)}
        for name in refused:
            if getattr(self, name) != default[name]:
                raise InvalidInput(name, "goes with one dataset, not with a folder of tiles")
        if self.out.suffix == ".rff":
            raise InvalidInput("out", f"{self.out} must be a folder: every tile has a field")

    def _tile_job(self, name: str) -> Job:
        """Return the job that trains a tile, with all that the bytes of its field depend on."""
        from hashlib import sha256

        from rfedge.jobs import Job
        from rfedge.training.run import needed_bytes

        tile = replace(
            self,
            dataset=(self.dataset / name).resolve(),
            out=self.out.resolve() / f"{name}.rff",
            ray=None,
            name=name,
            checkpoint_every=self.checkpoint_every or TILE_CHECKPOINT_EVERY,
        )
        described = (tile.dataset / "transforms.json").read_bytes()
        settings = replace(tile, dataset=Path(name), out=Path(name))
        return Job(
            name=name,
            work=partial(train_tile, tile),
            outputs=(tile.out,),
            made_from=f"{settings} of pictures described in {sha256(described).hexdigest()}",
            cores=self.threads,
            memory_bytes=needed_bytes(tile.training_job()),
        )

    @contextmanager
    def _shown(self, console: Console) -> Iterator[Snapshots | None]:
        """Serve the page of --view, if it is asked for; yield the writer of its snapshots."""
        if self.view is None:
            yield None
            return
        from rfcore.wire.address import Address
        from rfedge.training.view import shown_in_browser
        from rfedge.twin.web import WebSettings

        if self.kind == "ngp":
            raise InvalidInput("view", "a hash grid has no splats to draw; --kind splats has")
        token = os.environ.get("RFEDGE_TWIN_TOKEN")
        settings = WebSettings(Address.parse("view", self.view), token)
        drive = self.held_out if self.size is None and not self.undistort else None
        with shown_in_browser(settings, drive, lambda url: console.print(f"open {url}")) as made:
            yield made

    def _write_poses(self, job: TrainingJob, trained: Trained, console: Console) -> None:
        from rfedge.training.run import write_refined_poses

        if trained.aligned is not None:
            aligned_db = trained.aligned.psnr_db
            console.print(f"  {aligned_db:.2f} dB held out at poses aligned with the field")
        refinement = trained.refinement
        if refinement is None:
            return
        out, dataset = self.out.with_suffix(".tum"), job.dataset
        write_refined_poses(out, dataset.pictures, refinement.cameras, dataset.tile_origin)
        console.print(
            f"{out}: {len(dataset.pictures)} poses, moved by {refinement.median_m:.3f} m and "
            f"{refinement.median_deg:.3f} degrees (median)"
        )

    def training_job(self) -> TrainingJob:
        """Return the pictures, the settings and the limits of the training."""
        from rfedge.training.loop import LoopLimits
        from rfedge.training.run import TrainingJob
        from rfedge.training.views import read_views

        dataset, held_out = read_views(self)
        writes_checkpoints = self.resume or self.checkpoint_every > 0
        limits = LoopLimits(
            minutes=self.minutes,
            kept_s=self._kept_s,
            checkpoint=self.out.with_suffix(".ckpt") if writes_checkpoints else None,
            checkpoint_every=self.checkpoint_every or 1000,
            measurements=12 if self.kind == "splats" else 4,  # rendering a hash grid takes seconds
        )
        config = self._config(dataset)
        return TrainingJob(
            name=self.name,
            dataset=dataset,
            held_out=held_out,
            config=config,
            seed=self.seed,
            limits=limits,
            resume=self.resume,
            align_held_out=self.refine_poses or self.align_held_out,
        )

    @property
    def _kept_s(self) -> float:
        """The part of --minutes that levels of detail have."""
        chooses_size = (self.max_mb, self.passes) != (None, None)
        if self.minutes is None or self.plain or self.kind == "ngp" or chooses_size:
            return 0.0
        return min(KEPT_SHARE * 60 * self.minutes, MOST_KEPT_S)

    def _config(self, dataset: Dataset) -> SplatTrainingConfig | NgpTrainingConfig:
        from rfcore.train.ngp import NgpTrainingConfig
        from rfcore.train.schedule import Bands, DensityControl
        from rfedge.training.run import UNLIMITED_ITERATIONS, training_config

        iterations = UNLIMITED_ITERATIONS if self.minutes is not None else self.iterations
        if self.kind == "ngp":
            if self.sky:
                raise InvalidInput("sky", "is of splats; a hash grid reaches to the horizon itself")
            ngp = NgpTrainingConfig(threads=self.threads)
            return ngp if iterations is None else replace(ngp, iterations=iterations)
        config = replace(training_config(self.gaussians, iterations, self.threads), sky=self.sky)
        limit = self.limit
        if self.minutes is not None:
            limit = DEFAULT_LIMIT if limit is None else limit
            config = replace(config, halved_until=HALVED_UNTIL)
        cameras = [picture.camera.intrinsics for picture in dataset.pictures]
        if min(k.width_px * k.height_px for k in cameras) > LARGE_PX:
            config = replace(config, halved_until=LARGE_HALVED_UNTIL)
        if limit is not None:
            config = replace(config, density=DensityControl(limit=limit))
        bands = Bands(self.sh_degree, SH_RISE if self.sh_degree else 0.0)
        config = replace(config, bands=bands, antialiased=self.antialiased)
        return replace(config, exposure=dataset.exposure_varies, refine_poses=self.refine_poses)

    def _finished(self, job: TrainingJob, trained: Trained, console: Console) -> RadianceField:
        from rfcore.field import SplatField
        from rfcore.field.integers import TooAlike
        from rfcore.train.levels import LevelFitConfig
        from rfedge.training.finish import finish_field, size_goal

        field = trained.field
        if self.plain or not isinstance(field, SplatField):
            return field
        goal = size_goal(self.max_mb, self.passes)
        held_out = job.held_out.pictures if job.held_out is not None else ()
        levels = LevelFitConfig(threads=self.threads)
        left_s = trained.left_s if self._kept_s else None
        pictures = job.dataset.pictures
        try:
            return finish_field(field, pictures, held_out, levels, console, goal, left_s)
        except TooAlike:  # after a handful of iterations
            console.print("  its splats are still alike: kept uncompressed, as --plain does")
            return field


def _words(options: Mapping[str, Any]) -> str:
    """Return options as they are typed."""
    words = [
        f"--{name.replace('_', '-')}" + ("" if value is True else f" {value:.10g}")
        for name, value in options.items()
    ]
    return " ".join(words) or "nothing"


def train_tile(tile: Train, tell: Tell) -> None:
    """Train one tile, going on after the checkpoint of a run that was stopped."""
    from rfedge.jobs import console_of

    checkpoint = tile.out.with_suffix(".ckpt")
    replace(tile, resume=checkpoint.exists()).train_one(console_of(tell))
    checkpoint.unlink(missing_ok=True)
