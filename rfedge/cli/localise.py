"""``rfedge localise``: find a drive's poses in a field, from wrong ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import DATASET, FIELD, field_path, open_field

__all__ = ["Localise"]


@dataclass(frozen=True)
class Localise:
    """Find the poses of a drive's pictures in a field, each from a start that is wrong."""

    drive: Annotated[Path, Positional, DATASET]
    """Posed pictures, a dataset of any format (docs/data.md)."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), or a name."""
    start_error: Annotated[str, arg(metavar="METRESm:DEGREESdeg")] = "2m:3deg"
    """How far from the dataset's pose each search starts."""
    tries: int | None = None
    """Searches, over the pictures in turn; default: one a picture."""
    false_starts: int = 0
    """Searches with pictures the field cannot have (mirrored, turned round, noise), to be lost."""
    seed: int = 1
    """Seed of the starts."""
    out: Annotated[Path | None, arg(metavar="FILE.tum")] = None
    """Write the pose found of each picture, a TUM line each; what was lost is a comment."""
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Search from every start and print how many poses were found, and how well."""
        from rich.console import Console
        from rich.progress import track

        from rfcore.dataset import read_dataset
        from rfedge.experiments.localisation import (
            attempts,
            parse_start_error,
            result_of,
            row_text,
            summary,
            write_poses,
        )
        from rfedge.results import write_result

        error = parse_start_error(self.start_error)
        field = open_field(self.field, threads=self.threads)
        pictures = read_dataset(self.drive, tile_origin=field.metadata.tile_origin).pictures
        counts = (len(pictures) if self.tries is None else self.tries, self.false_starts)
        searches = attempts(field, pictures, error, counts, self.seed)
        shown = Console(stderr=True)
        done = list(track(searches, "Localising", total=sum(counts), console=shown))
        row = summary(str(self.drive), error, done)
        if self.out is not None:
            found = write_poses(self.out, done)
            shown.print(f"{self.out}: {found} poses", highlight=False)
        if self.json is not None:
            write_result(self.json, result_of([row], [field_path(self.field), self.drive]))
        if self.json != "-":
            print(row_text(row))
