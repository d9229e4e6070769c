"""``rfedge localise``: find a drive's poses in a field, starting from wrong ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import DATASET, FIELD, RATE, drive_rate_hz, field_path, open_drive, open_field

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from rfcore.field import RadianceField
    from rfcore.localise.estimate import PosePrior
    from rfcore.views import PosedPicture
    from rfedge.localisation.searches import RecordedFeed


@dataclass(frozen=True)
class Localise:
    """Find the poses of a drive's pictures in a field, each from a start that is wrong."""

    drive: Annotated[Path, Positional, DATASET]
    """Posed pictures, a dataset of any format (docs/how-to/data.md)."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), a name, or MODULE:CLASS (docs/how-to/python.md)."""
    start_error: Annotated[str, arg(metavar="METRESm:DEGREESdeg")] = "2m:3deg"
    """Distance and angle from the dataset's pose at which each search starts."""
    tries: int | None = None
    """Number of searches, over the pictures in turn; default: one for each picture."""
    seed: int = 1
    """Seed of the starts."""
    out: Annotated[Path | None, arg(metavar="FILE.tum")] = None
    """Write the pose found of each picture as a TUM line; a lost picture is a comment."""
    pose_feed: Annotated[Path | None, arg(metavar="FILE")] = None
    """Start from a recorded feed of NMEA or JSON lines (docs/how-to/localise.md) instead, one
    search a picture; its times are the drive's. Deviations are those the feed states."""
    feed_offset_s: float = 0.0
    """Seconds to add to the feed's times to get the drive's."""
    camera_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The camera seen from the feed's antenna: metres forward, left, up."""
    rate: Annotated[float | None, RATE] = None
    """Pictures a second, for --pose-feed, where the dataset has no times; default: 10."""
    report: Annotated[Path | None, arg(metavar="FILE.html")] = None
    """Write a page: errors over time, matches drawn, what was lost and why."""
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Search from every start and print how many poses were found, and how well."""
        import numpy as np
        from rich.console import Console
        from rich.progress import track

        from rfedge.localisation.report import write_localise_report
        from rfedge.localisation.searches import (
            SearchSummary,
            parse_start_error,
            searches_from,
            searches_from_displaced,
            typical_start,
            write_poses,
        )
        from rfedge.results import make_result, provenance, write_result

        error = parse_start_error(self.start_error)
        field = open_field(self.field, threads=self.threads)
        drive = open_drive(self.drive, field, str(self.field))
        pictures = drive.pictures
        count = len(pictures) if self.tries is None else self.tries
        shown, feed = Console(stderr=True), None
        if self.pose_feed is None:
            rng = np.random.default_rng(self.seed)
            searches = searches_from_displaced(field, pictures, error, count, rng)
        else:
            feed = self._feed()
            rate_hz = drive_rate_hz(self.rate, drive.rate_hz, self.drive)
            priors = self._priors(feed, field, pictures, rate_hz, shown)
            count = sum(prior is not None for prior in priors)
            searches = searches_from(field, pictures, priors)
            error = typical_start(pictures, priors)
        done = list(track(searches, "Localising", total=count, console=shown))
        if feed is not None:
            told = feed.time_offset(pictures, done)
            shown.print(f"{self.pose_feed}: {told}", highlight=False)
        row = SearchSummary.of(str(self.drive), error, done)
        if self.report is not None:
            write_localise_report(self.report, field, row, done)
            shown.print(f"{self.report}: errors over time and matches", highlight=False)
        if self.out is not None:
            found = write_poses(self.out, done)
            shown.print(f"{self.out}: {found} poses", highlight=False)
        if self.json is not None:
            made = provenance([field_path(self.field), self.drive])
            write_result(self.json, make_result("localise", made, {"rows": [row]}))
        if self.json != "-":
            print(row)

    def _feed(self) -> RecordedFeed:
        from rfcore.errors import InvalidInput
        from rfedge.localisation.searches import RecordedFeed

        assert self.pose_feed is not None
        if self.tries is not None:
            raise InvalidInput("pose_feed", "goes without --tries")
        return RecordedFeed.read(self.pose_feed, self.feed_offset_s)

    def _priors(
        self,
        feed: RecordedFeed,
        field: RadianceField,
        pictures: Sequence[PosedPicture],
        rate_hz: float,
        console: Console,
    ) -> list[PosePrior | None]:
        """Return what the feed knows of each picture's pose; say what is wrong with the feed."""
        from cav_agent.pose_feed import CameraMount, FieldPlacement
        from rfcore.errors import InvalidInput

        placement = FieldPlacement(
            field.metadata.anchor, field.metadata.tile_origin, CameraMount(self.camera_at)
        )
        priors = feed.priors(pictures, placement, field.bounds, rate_hz)
        for problem, times in feed.problems.items():
            console.print(f"{self.pose_feed}: {problem}, {times} times", highlight=False)
        if not any(priors):
            raise InvalidInput(
                "pose_feed",
                f"{self.pose_feed}: none of {feed.fixes} fixes is before a picture of the drive; "
                "its times are to be the drive's: see --feed-offset-s",
            )
        return priors
