"""``rfedge field update`` and ``disagree``: learn from recorded passes what has changed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from rfedge.arguments import FIELD, RFF, open_drive, open_field

if TYPE_CHECKING:
    from rich.console import Console

    from rfcore.field import RadianceField
    from rfcore.update.passes import Pass
    from rfcore.update.run import Update, UpdateSettings
    from rfcore.update.splats import Progress
    from rfedge.jobs import Job, Tell

PNG = arg(metavar="FILE.png")
JOB_BYTES = 2_500_000_000


@dataclass(frozen=True)
class FieldUpdate:
    """Learn another light, or what has changed, from recorded passes; written only if bits fall."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name; splats."""
    recordings: Annotated[tuple[Path, ...], arg(name="from", metavar="DATASET...")]
    """Passes under one light, a dataset each (docs/how-to/data.md)."""
    out: Annotated[Path, RFF]
    """The archive to write; keep a layer or a delta in the folder of its base."""
    learn_as: Annotated[Literal["all", "delta", "colours"], arg(name="as")] = "all"
    """all: a new field with every parameter fine-tuned. delta: the same, stored as the difference
    to this field in a third of the bytes. colours: a layer of colours on this field, in a fiftieth
    of the bytes, for the same street under another light."""
    frames: int = 48
    """Most frames to take of all passes; a quarter of them is held back for the trial."""
    iterations: int = 600
    """Iterations of fine-tuning (with --as all or delta)."""
    min_identities: int = 2
    """Refuse to learn from fewer passes: what a single one shows may be passing traffic."""
    threads: int = 1
    """Threads of the renderer."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Learn on the Ray cluster at this address, as a job of --threads cores; `local` starts one
    here (docs/how-to/servers.md). The archive has the same bytes. Needs rfedge[ray]."""

    def run(self) -> None:
        """Learn, try, write, here or as a job."""
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfcore.extras import require
        from rfedge.jobs import run_jobs

        if self.out.suffix != ".rff":
            raise InvalidInput("out", f"{self.out} must end in .rff")
        if self.ray is None:
            self.learn(Console())
            return
        require("ray", "ray")
        run_jobs([self._job()], partial(print, flush=True), self.ray)

    def _job(self) -> Job:
        from rfedge.arguments import field_path
        from rfedge.jobs import Job

        settled = replace(
            self,
            field=field_path(self.field).resolve(),
            recordings=tuple(path.resolve() for path in self.recordings),
            out=self.out.resolve(),
            ray=None,
        )  # workers run in folders of their own
        work = partial(_learn_as_job, settled)
        return Job(
            f"update-{self.out.stem}",
            work,
            (settled.out,),
            None,
            cores=self.threads,
            memory_bytes=JOB_BYTES,
        )

    def learn(self, console: Console) -> None:
        """Learn, try, and write what takes fewer bits; raise ``InvalidInput`` if nothing does."""
        from rfcore.errors import InvalidInput
        from rfcore.field import save_field
        from rfedge.fields.describe import size_mb

        base = open_field(self.field, threads=self.threads)
        update = _learnt(base, _passes(self.recordings, base), self._settings(), console)
        for name, count in update.dropped.items():
            console.print(
                f"{name}: {count} frames left out: their edges lie neither where the field's do "
                "nor where another pass has some",
                soft_wrap=True,
            )
        for name, percent in update.saved_percent.items():
            console.print(f"pass {name}: {_change(percent)} on the frames held back")
        if update.refused:
            raise InvalidInput("from", f"nothing is written: {update.refused}")
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(update.learnt, self.out)
        console.print(
            f"{self.out}: field {field_id}, {size_mb(update.learnt):.2f} MB, learnt from "
            f"{update.frames} frames: {_change(update.mean_saved_percent)}",
            soft_wrap=True,
        )

    def _settings(self) -> UpdateSettings:
        from rfcore.update.colours import ColourFit
        from rfcore.update.run import LearnAs, UpdateSettings
        from rfcore.update.splats import FineTuning

        return UpdateSettings(
            LearnAs(self.learn_as),
            self.frames,
            self.min_identities,
            fine_tuning=FineTuning(self.iterations, threads=self.threads),
            colours=ColourFit(threads=self.threads),
        )


def _learn_as_job(update: FieldUpdate, tell: Tell) -> None:
    from rfedge.jobs import console_of

    update.learn(console_of(tell))


@dataclass(frozen=True)
class FieldDisagree:
    """Show where a field and recorded pictures of the street disagree."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name."""
    recordings: Annotated[tuple[Path, ...], arg(name="from", metavar="DATASET...")]
    """Passes, one dataset each."""
    out: Annotated[Path, PNG] = Path("out/field-disagree.png")
    """Four frames: camera, render, and in red where they differ under the render's own light."""
    threads: int = 1
    """Threads of the renderer."""

    def run(self) -> None:
        """Compare and draw."""
        from rfcore.image import write_png
        from rfedge.fields.describe import disagreement_picture

        field = open_field(self.field, threads=self.threads)
        passes = _passes(self.recordings, field)
        picture, lines = disagreement_picture(
            field, [p for drive in passes for p in drive.pictures]
        )
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_png(self.out, picture)
        for line in lines:
            print(line)
        print(f"{self.out}: camera | render | where they differ, {len(lines)} frames")


def _passes(recordings: tuple[Path, ...], base: RadianceField) -> list[Pass]:
    from rfcore.update.passes import Pass

    return [Pass(str(path), open_drive(path, base).pictures) for path in recordings]


def _learnt(
    base: RadianceField, passes: list[Pass], settings: UpdateSettings, console: Console
) -> Update:
    from rfcore.update.run import learn

    if not console.is_terminal:
        return learn(base, passes, settings, _in_lines(console))
    with console.status("learning") as status:

        def told(doing: str, done: int, total: int) -> None:
            status.update(f"{doing}: {done} of {total}")

        return learn(base, passes, settings, told)


def _in_lines(console: Console) -> Progress:
    """Return what prints a line at the first step of what is being done, and at every tenth."""
    printed: dict[str, int] = {}

    def told(doing: str, done: int, total: int) -> None:
        tenths = 10 * done // total
        if tenths != printed.get(doing):
            printed[doing] = tenths
            console.print(f"{doing}: {done} of {total}")

    return told


def _change(saved_percent: float) -> str:
    if saved_percent >= 0:
        return f"{saved_percent:.1f} % fewer bits"
    return f"{-saved_percent:.1f} % more bits"
