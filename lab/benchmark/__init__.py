"""``rfedge-lab benchmark``: rfedge-bench v1, which anybody's codec can be handed in to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg, subcommand

from rfcore.errors import InvalidInput
from rfedge.arguments import FOLDER

__all__ = [
    "BenchmarkAnchors",
    "BenchmarkCheck",
    "BenchmarkRun",
    "BenchmarkShow",
    "EvalBenchmark",
]

COMMAND = arg(metavar="COMMAND")


@dataclass(frozen=True)
class BenchmarkRun:
    """Run anybody's codec on the benchmark's drives and write its submission.

    The command gets a folder of frames and a quality, and writes a packet and a decoded picture for
    each frame (docs/explanation/evaluation.md).
    """

    out: Annotated[Path, Positional, FOLDER]
    """Folder of the submission; it must not exist."""
    method: Annotated[str, COMMAND]
    """The codec: a program with {frames}, {point} and {out}, and where it wants them {hz} and
    {prior}. No shell runs it."""
    name: str
    """Name of the method in results."""
    points: tuple[float, ...]
    """Operating points, what {point} stands for: at least six, from 32 to 35 dB and beyond."""
    version: str = "unknown"
    """Version of the method."""
    only: tuple[str, ...] = ()
    """Drives to code, by name; those that the benchmark requires if none is given. With fewer it
    cannot be checked."""
    drive: Annotated[tuple[str, ...], arg(metavar="NAME=DATASET")] = ()
    """Datasets of drives that are not among the samples; they are coded, too."""
    prior: tuple[Path, ...] = ()
    """Files that both ends hold beforehand, such as a field; they become part of the submission."""
    timeout_s: float = 3600.0
    """Longest time of one drive at one point."""

    def run(self) -> None:
        """Code all drives at all points."""
        from functools import partial

        from lab.benchmark.definition import read_benchmark
        from lab.benchmark.method import run_method

        run_method(self, read_benchmark(), partial(print, flush=True))
        print(f"{self.out}: check it with `rfedge-lab benchmark check {self.out}`")

    @property
    def datasets(self) -> dict[str, Path]:
        """Datasets of the drives that are not among the samples, by the drive's name."""
        return _datasets(self.drive)


@dataclass(frozen=True)
class BenchmarkCheck:
    """Check a submission against the drives, and print and write what it scores.

    Quality is measured anew from the decoded pictures, bytes are those of the packets. What cannot
    be checked is said.
    """

    submission: Annotated[Path, Positional, FOLDER]
    """Folder of the submission."""
    decoder: Annotated[str | None, COMMAND] = None
    """A program that makes the pictures from the packets alone: {packets} and {out}, and where it
    wants them {point} and {prior}. Name one that you trust: it runs with your rights."""
    drive: Annotated[tuple[str, ...], arg(metavar="NAME=DATASET")] = ()
    """Datasets of drives that are not among the samples."""
    timeout_s: float = 3600.0
    """Longest time of the decoder on one drive at one point."""
    lpips_weights: Path | None = None
    """Folder of LPIPS's weights (`make lpips-weights` makes `out/lpips`): a BD-rate by LPIPS, too,
    against the first anchor, which is coded here for that."""
    out: Path = Path("out/eval/benchmark.json")
    """The result file to write."""

    def run(self) -> None:
        """Check everything, then score."""
        from functools import partial

        from rich.console import Console

        from lab.benchmark.definition import print_scores, read_benchmark
        from lab.benchmark.method import DECODER_NEEDS, Command, check_decoder
        from lab.benchmark.submission import SUBMISSION, check_submission
        from rfedge.results import check_result_path, make_result, provenance, write_result

        check_result_path(self.out)
        decoder = lpips = None
        if self.lpips_weights is not None:
            from rfedge.evaluate.lpips import Lpips

            lpips = Lpips(self.lpips_weights)
        if self.decoder is not None:
            command = Command(self.decoder, DECODER_NEEDS, self.timeout_s)
            decoder = partial(check_decoder, command)
        content = check_submission(
            self.submission,
            read_benchmark(),
            _datasets(self.drive),
            tell=partial(print, flush=True),
            check_decoder=decoder,
            lpips=lpips,
        )
        made = provenance([self.submission / SUBMISSION])
        write_result(self.out, make_result("benchmark", made, content))
        print_scores(Console(), content)
        print(f"{self.out}")


@dataclass(frozen=True)
class BenchmarkShow:
    """Print the definition: rules, drives and where they are, anchors, windows."""

    text: bool = False
    """Print the file itself instead."""

    def run(self) -> None:
        """Print it."""
        from lab.benchmark.definition import V1, described, read_benchmark

        print(V1.read_text() if self.text else described(read_benchmark()))


@dataclass(frozen=True)
class BenchmarkAnchors:
    """Code the anchors anew, to see that they come out as they are recorded.

    Minutes for each drive. The same versions of the encoders make the same file.
    """

    drive: Annotated[tuple[str, ...], arg(metavar="NAME=DATASET")] = ()
    """Datasets of drives that are not among the samples; drives that are not here are left out."""
    out: Path = Path("out/eval/benchmark-anchors.json")
    """The file to write."""

    def run(self) -> None:
        """Code every anchor at every point of every drive that is here."""
        from functools import partial

        from lab.benchmark.definition import read_benchmark, record_anchors

        benchmark, datasets = read_benchmark(), _datasets(self.drive)
        here = [d for d in benchmark.drives if d.name in datasets or d.dataset is not None]
        drives = [drive.read(datasets.get(drive.name)) for drive in here]
        self.out.parent.mkdir(parents=True, exist_ok=True)
        record_anchors(benchmark, drives, self.out, partial(print, flush=True))
        print(f"{self.out}: compare it with {benchmark.recorded}")


def _datasets(texts: tuple[str, ...]) -> dict[str, Path]:
    """Return where drives lie, by name; raise ``InvalidInput`` for text of another form."""
    found = {}
    for text in texts:
        name, equals, dataset = text.partition("=")
        if not (name and equals and dataset):
            raise InvalidInput("drive", f"{text!r} is not NAME=DATASET, as kitti-loop=drive.json")
        found[name] = Path(dataset)
    return found


@dataclass(frozen=True)
class EvalBenchmark:
    """rfedge-bench v1: run anybody's codec on frozen drives, check what was handed in."""

    verb: Annotated[
        Annotated[BenchmarkRun, subcommand("run")]
        | Annotated[BenchmarkCheck, subcommand("check")]
        | Annotated[BenchmarkShow, subcommand("show")]
        | Annotated[BenchmarkAnchors, subcommand("anchors")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
