"""The ``streetgen`` command line.

``build`` renders a scene file into pictures, depth, classes and poses. ``plan`` says what a scene
declares and what its effects cost. ``sheet`` puts pictures of built scenes on one page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from rfcore.program import parse_options, run_program
from rfedge.arguments import FOLDER, JSON, SIZE, parse_size

SCENE = arg(metavar="SCENE")


@dataclass(frozen=True)
class Build:
    """Render a scene with Mitsuba 3 into a dataset.

    The same command goes on where a build was stopped. The same scene, size, samples and seed
    give the same pictures, whatever the number of workers.
    """

    scene: Annotated[str, Positional, SCENE]
    """A ready-made scene by name (such as street-empty), or a scene file (.toml)."""
    out: Annotated[Path, FOLDER]
    """The folder to make, or to go on with."""
    size: Annotated[str | None, SIZE] = None
    """WIDTHxHEIGHT px of all pictures; default: what the scene says for each split."""
    spp: int = 16
    """Samples a pixel, a square number."""
    renderer: Literal["auto", "cuda", "llvm", "scalar"] = "auto"
    """The variant of Mitsuba that renders. `auto` takes the first that works here of CUDA on an
    NVIDIA GPU, LLVM and scalar. Their pictures differ by rounding, so a folder is built by one."""
    workers: int = 1
    """Number of processes. One uses all cores; several share them and take 1 to 2.5 GB each."""
    frames: Annotated[str | None, arg(metavar="A:B")] = None
    """Only frames a:b of the chosen splits, counted through drive, train, eval in that order."""
    split: Annotated[str, arg(metavar="SPLIT")] = "default"
    """drive, train, eval, a list of them with commas, or all. The default is all, but without train
    where the scene's field was trained on another scene. rig takes the drive by several cameras and
    writes rig.toml for `cav-agent --rig`."""
    rig: Annotated[str | None, arg(metavar="CAMERAS")] = None
    """For --split rig: a list, with commas, of the car's 18 cameras (low, mid or high with _front,
    _front_left, _front_right, _left, _right, _back), or all. The default is the mid row's front,
    left, right and back."""

    def run(self) -> None:
        """Build the dataset, or go on with it."""
        from rich.console import Console

        from streetgen import load_scene
        from streetgen.build.run import Settings, build_scene
        from streetgen.shots import Selection

        size_px = parse_size(self.size) if self.size is not None else None
        scene = load_scene(self.scene)
        if self.rig is not None:
            scene = replace(scene, drive=replace(scene.drive, rig=self.rig))
        selection = Selection(scene, self.split, self.frames, size_px)
        settings = Settings(self.out, self.spp, self.workers, self.renderer)
        build_scene(selection, settings, Console(soft_wrap=True))


@dataclass(frozen=True)
class Plan:
    """Check scene files; print their pictures and effects, with --render also what these cost."""

    scenes: Annotated[tuple[str, ...], Positional, arg(metavar="SCENE ...")]
    """Ready-made scenes by name, or scene files (.toml)."""

    render: bool = False
    """Render the street small, with and without each effect, and say what share of a frame each
    takes; up to a minute for each effect."""
    json: Annotated[Path | None, JSON] = None
    """With --render: also write what was measured into this file."""

    def run(self) -> None:
        """Print the plans."""
        from time import process_time

        from rfcore.errors import InvalidInput
        from streetgen import load_scene
        from streetgen.plan import Planner, small_render_ms, write_rows

        if not self.scenes:
            raise InvalidInput("scenes", "none is named; street-empty is one")
        if self.json and not self.render:
            raise InvalidInput("json", "takes what was rendered; add --render")
        scenes = [load_scene(name) for name in self.scenes]
        render = partial(small_render_ms, cpu_s=process_time) if self.render else None
        planner = Planner(process_time, render)
        rows = []
        for scene in scenes:
            plan = planner.plan(scene)
            print(*plan.lines(), sep="\n", flush=True)
            rows += plan.rows() if self.render else []
        if self.json is not None:
            write_rows(self.json, rows)


@dataclass(frozen=True)
class Sheet:
    """Write a contact sheet of built scenes."""

    scenes: Annotated[tuple[Path, ...], Positional, arg(metavar="FOLDER ...")]
    """Folders that `streetgen build` made."""
    out: Annotated[Path, arg(metavar="FILE.jpg")]
    """The picture to write."""
    columns: int = 4
    """Pictures of each scene, evenly chosen among those that there are."""
    width_px: int = 1280
    """Width of the sheet, px."""
    max_bytes: int = 600_000
    """Largest size of the JPEG; its quality is lowered until it fits."""

    def run(self) -> None:
        """Write the sheet; say how large it became."""
        from streetgen.contact_sheet import write_contact_sheet

        size = write_contact_sheet(
            self.scenes, self.out, self.columns, self.width_px, self.max_bytes
        )
        print(f"{self.out}: {len(self.scenes)} scenes, {size / 1000:.0f} kB")


Verb = (
    Annotated[Build, subcommand("build")]
    | Annotated[Plan, subcommand("plan")]
    | Annotated[Sheet, subcommand("sheet")]
)


DESCRIPTION = "Declared streets, rendered with Mitsuba 3 into datasets for rfedge."


def parse(arguments: Sequence[str] | None = None) -> Verb:
    """Return the verb that ``arguments`` ask for, by default those of the process."""
    verb: Verb = parse_options(Verb, "streetgen", arguments, DESCRIPTION)
    return verb


def main() -> int:
    """Run one verb and return its exit status."""
    return run_program("streetgen", lambda: parse().run())
