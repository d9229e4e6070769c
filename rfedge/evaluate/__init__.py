"""Experiments that people run on their own data: compare, never-worse,
lossy-link and ladder.

Each is a package with its command, its measuring and its rows. What they share are the modules
here: drives and clips of them (``clips``), our codec and its rivals as coders of a clip
(``field_coder``, ``rivals``), a coder's performance at the points that span a window of quality
(``performance``), what lies between two curves (``rate_curve``), and how an experiment runs
(``runner``). ``lab`` builds its own experiments of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rfedge.results import check_result_path

__all__ = ["Experiment", "Preset"]

Preset = Literal["ultrafast", "superfast", "veryfast", "faster", "fast", "medium"]
"""Presets of x264 that keep up with a camera."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """The options that experiments share.

    An experiment's command line is a subclass, which is the declaration of the whole job: what
    measures it takes the subclass. Its values are checked when it is made, so a mistake ends
    before any work; ``InvalidInput`` says which.
    """

    out: Path
    """The result file to write."""
    cells: Path
    """Folder of finished pieces."""
    quick: bool = False
    """Code only a few frames: shows that it works and about where figures lie, not for a report."""

    def __post_init__(self) -> None:
        check_result_path(self.out)
