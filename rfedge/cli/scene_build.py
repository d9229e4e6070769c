"""``rfedge scene build``: a declared street into pictures, depth, classes and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["SceneBuild"]


@dataclass(frozen=True)
class SceneBuild:
    """Render a scene with Mitsuba 3 (pip install 'rfedge[scene]') into a dataset.

    The same command goes on where it was stopped. The same scene, size, samples and seed give the
    same pictures, whatever the number of workers.
    """

    scene: Annotated[str, Positional]
    """A ready-made scene by name (samples/scenes), or a scene file (.toml)."""
    out: Path
    """The folder to make, or to go on with."""
    size: str | None = None
    """WIDTHxHEIGHT px of all pictures; default: what the scene says for each split."""
    spp: int = 16
    """Samples a pixel, a square number."""
    workers: int = 1
    """Processes. One uses all cores; more share them and take 1 to 2.5 GB each."""
    frames: str | None = None
    """Only frames a:b of the chosen splits, counted through drive, train, eval in that order."""
    split: str = "default"
    """drive, train, eval, a list of them with commas, or all; default: all, but without train where
    the scene's field was trained on another scene."""

    def run(self) -> None:
        """Build."""
        from rich.console import Console

        from rfedge.sizes import parse_size
        from rfedge.street import load_scene
        from rfedge.street.build.selection import Selection
        from rfedge.street.render.backend import require_renderer

        require_renderer()
        from rfedge.street.build.run import Settings, build_scene

        size_px = parse_size(self.size) if self.size is not None else None
        selection = Selection(load_scene(self.scene), self.split, self.frames, size_px)
        settings = Settings(self.out, self.spp, self.workers)
        build_scene(selection, settings, Console(soft_wrap=True))
