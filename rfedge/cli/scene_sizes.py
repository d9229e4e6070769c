"""``rfedge scene sizes``: how many bytes built scenes' pictures take as I pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["SceneSizes"]


@dataclass(frozen=True)
class SceneSizes:
    """Code each picture of built scenes alone by x264; real driving video has 120 to 250 kB."""

    scenes: Annotated[tuple[Path, ...], Positional]
    """Folders that `rfedge scene build` made."""
    crf: float = 23.0
    """x264's constant rate factor."""
    rate_hz: int = 10
    """Pictures a second that x264 is told: it spends more on a picture that is shown for longer."""
    json: Path | None = None
    """Also write the figures into this file."""

    def run(self) -> None:
        """Print a line for each scene."""
        from rfcore.errors import InvalidInput
        from rfedge.street.intra_size import IntraCoding, sizes_of, write_sizes

        if not self.scenes:
            raise InvalidInput("scenes", "no folder is named")
        coding = IntraCoding(self.crf, self.rate_hz)
        measured = []
        for sizes in sizes_of(self.scenes, coding):
            print(sizes.line(), flush=True)
            measured.append(sizes)
        if self.json is not None:
            write_sizes(self.json, measured, coding)
