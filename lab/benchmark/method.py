"""Programs run for a benchmark: a codec that makes a submission, a decoder that checks one.

A codec is any command. It gets a folder of frames and an operating point and writes a packet and a
picture for each frame; we time it, look at what it left, and withhold frames from it to see that
none was coded with later ones. A decoder gets packets alone, all or the first half.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lab.benchmark import BenchmarkRun
from lab.benchmark.definition import Benchmark
from lab.benchmark.submission import (
    PACKET,
    PNG,
    PRIOR,
    RAW,
    SUBMISSION,
    CodedPoint,
    Tell,
    read_picture,
)
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import CodecError, InvalidInput
from rfcore.files import whole_folder, write_whole
from rfcore.image import I420, write_png
from rfedge.evaluate.clips import Drive
from rfedge.results import host

CODER_NEEDS, DECODER_NEEDS = ("frames", "point", "out"), ("packets", "out")
MAY_NAME = ("hz", "point", "prior")
SHOWN_BYTES = 600


@dataclass(frozen=True)
class Command:
    """A program with placeholders in braces for what it is to read and write; no shell runs it.

    Raises ``InvalidInput`` unless the text has all placeholders that it ``needs``.
    """

    text: str
    needs: tuple[str, ...] = CODER_NEEDS
    timeout_s: float = 3600.0

    def __post_init__(self) -> None:
        named = set(re.findall(r"\{(\w*)\}", self.text))
        wrong = named - {*self.needs, *MAY_NAME}
        missing = [name for name in self.needs if name not in named]
        if missing or wrong:
            what = f"lacks {{{missing[0]}}}" if missing else f"has {{{min(wrong)}}}"
            known = " ".join(f"{{{name}}}" for name in sorted({*self.needs, *MAY_NAME}))
            raise InvalidInput("command", f"{self.text!r} {what}; placeholders are {known}")

    def run(self, **values: object) -> float:
        """Run it and return the processor time in ms of the program and what it started.

        Raises ``InvalidInput`` if it cannot be started, ``CodecError`` with the end of its output
        if it fails or takes longer than ``timeout_s``.
        """
        filled = [_filled(word, values) for word in shlex.split(self.text)]
        before_ms = _children_cpu_ms()
        try:
            started = subprocess.Popen(
                filled, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
            )
        except OSError as error:
            raise InvalidInput("command", f"{filled[0]!r} cannot be started: {error}") from error
        try:
            output, _ = started.communicate(timeout=self.timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
            started.communicate()
            raise CodecError(
                f"{shlex.join(filled)}: not done after {self.timeout_s:g} s; raise --timeout-s"
            ) from None
        if started.returncode:
            end = output.decode("utf-8", "replace")[-SHOWN_BYTES:].strip()
            raise CodecError(f"{shlex.join(filled)}: ended with {started.returncode}: {end}")
        return _children_cpu_ms() - before_ms


def _filled(word: str, values: Mapping[str, object]) -> str:
    for name, value in values.items():
        word = word.replace(f"{{{name}}}", str(value))
    return word


def _children_cpu_ms() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1e3 * (used.ru_utime + used.ru_stime)


def run_method(job: BenchmarkRun, benchmark: Benchmark, tell: Tell) -> None:
    """Code drives with a command at every point and write the submission to ``job.out``.

    At the first point of each drive the command also gets the first half of the frames alone: it
    has to make the same packets, so that none was made of later frames. Raises ``InvalidInput``
    for drives that are not there, too few points or an ``out`` that exists, and ``CodecError`` or
    ``InvalidData`` for a command that fails, leaves a file out, or looked ahead.
    """
    least = benchmark.scoring.least_points
    if len(set(job.points)) < least:
        raise InvalidInput("points", f"{len(set(job.points))} given, at least {least} are needed")
    command = Command(job.method, timeout_s=job.timeout_s)
    required = (drive.name for drive in benchmark.drives if drive.required)
    names = job.only or tuple(dict.fromkeys((*required, *job.datasets)))
    drives = [benchmark.drive(name).read(job.datasets.get(name)) for name in names]
    with whole_folder(job.out) as folder:
        prior = _with_prior(folder, job.prior)
        coding = _Coding(command, job.points, (folder / PRIOR).resolve(), tell)
        content = {
            "benchmark": benchmark.version,
            "method": job.name,
            "version": job.version,
            "command": command.text,
            "cpu": host()["cpu"],
            "later_frames_withheld": True,
            "prior": prior,
            "drives": [coding.drive(drive, folder.resolve()) for drive in drives],
        }
        write_whole(folder / SUBMISSION, json.dumps(content, indent=1) + "\n")


def _with_prior(folder: Path, files: Sequence[Path]) -> list[str]:
    if not files:
        return []
    (folder / PRIOR).mkdir()
    for path in files:
        if not path.is_file():
            raise InvalidInput("prior", f"{path} is no file")
        if (folder / PRIOR / path.name).exists():
            raise InvalidInput("prior", f"{path}: another one is called {path.name}; rename it")
        shutil.copyfile(path, folder / PRIOR / path.name)
    return [f"{PRIOR}/{path.name}" for path in files]


@dataclass(frozen=True)
class _Coding:
    """A command at work: on one drive after another, at all points."""

    command: Command
    points: tuple[float, ...]
    prior: Path
    tell: Tell

    def drive(self, drive: Drive, folder: Path) -> dict[str, Any]:
        """Code a drive into a folder of its name; return what the submission says of it."""
        name = drive.name.scene
        before = drive.first(max(1, len(drive.frames) // 2))
        with TemporaryDirectory() as made:
            whole, half = Path(made, "frames"), Path(made, "half")
            _write_frames(whole, drive)
            _write_frames(half, before)
            coded = [
                self.point(drive, whole, folder / name / f"{point:g}", point)
                for point in self.points
            ]
            alone = self.point(before, half, Path(made, "alone"), self.points[0])
            _check_no_lookahead(coded[0], alone)
        stated = [
            {
                "point": point.point,
                "folder": f"{name}/{point.point:g}",
                "frame_bytes": list(point.frame_bytes),
                "cpu_ms": point.cpu_ms,
            }
            for point in coded
        ]
        return {"name": name, "points": stated}

    def point(self, drive: Drive, frames: Path, out: Path, point: float) -> CodedPoint:
        """Code the frames that lie in a folder and look at what came of it."""
        self.tell(f"{drive.name.scene}: {len(drive.frames)} frames at {point:g}")
        out.mkdir(parents=True)
        values = {"point": f"{point:g}", "hz": f"{drive.name.rate_hz:g}", "prior": self.prior}
        cpu_ms = self.command.run(frames=frames, out=out, **values)
        sizes = {path.name: path.stat().st_size for path in out.glob(f"*{PACKET}")}
        stated = tuple(sizes.get(f"{k:04d}{PACKET}", 0) for k in range(len(drive.frames)))
        coded = CodedPoint(point, out, stated, cpu_ms)
        coded.pictures(drive.frames[0].size_px)
        return coded


def _check_no_lookahead(whole: CodedPoint, alone: CodedPoint) -> None:
    for index, (one, other) in enumerate(zip(whole.packets(), alone.packets(), strict=False)):
        if one != other:
            count = len(alone.frame_bytes)
            raise CodecError(
                f"the packet of frame {index} is another one when frames from {count} on are "
                "withheld: it depends on later frames, on the number of frames, or on chance"
            )


def _write_frames(folder: Path, drive: Drive) -> None:
    """Write what a command gets: pictures as PNG and as I420, and ``transforms.json``."""
    folder.mkdir()
    for index, (picture, frame) in enumerate(zip(drive.pictures, drive.frames, strict=True)):
        write_png(folder / f"{index:04d}{PNG}", picture.read())
        (folder / f"{index:04d}{RAW}").write_bytes(frame.packed())
    written = [
        WrittenPicture(
            f"{index:04d}{PNG}",
            SourceCamera(picture.camera.intrinsics),
            picture.camera.world_from_cam,
            round(1e9 * index / drive.name.rate_hz),
        )
        for index, picture in enumerate(drive.pictures)
    ]
    write_transforms(folder, written, None)


def check_decoder(decoder: Command, point: CodedPoint, drive: Drive, prior: Path) -> None:
    """Run the decoder on all packets and on the first half; compare with what was handed in.

    Raises ``CodecError`` if it fails or shows something else.
    """
    packets, pictures = point.packets(), point.pictures(drive.frames[0].size_px)
    for count in (len(packets), max(1, len(packets) // 2)):
        with TemporaryDirectory() as made:
            given, shown = Path(made, "packets"), Path(made, "shown")
            given.mkdir()
            shown.mkdir()
            for index, packet in enumerate(packets[:count]):
                (given / f"{index:04d}{PACKET}").write_bytes(packet)
            decoder.run(packets=given, out=shown, point=f"{point.point:g}", prior=prior)
            _check_shown(shown, pictures[:count], point)


def _check_shown(shown: Path, pictures: Sequence[I420], point: CodedPoint) -> None:
    for index, picture in enumerate(pictures):
        found = [shown / f"{index:04d}{suffix}" for suffix in (RAW, PNG)]
        there = next((path for path in found if path.is_file()), None)
        if there is None:
            raise CodecError(f"the decoder made no picture of frame {index} of {point.folder}")
        if read_picture(there, picture.size_px).digest() != picture.digest():
            raise CodecError(
                f"from the first {len(pictures)} packets of {point.folder} the decoder makes "
                f"another picture of frame {index} than was handed in"
            )
