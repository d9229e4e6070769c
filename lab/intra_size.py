"""``rfedge-lab intra-size``: the sizes of a scene's pictures as I pictures, beside real ones.

Each picture is a stream of its own, coded by x264 as its preset says, as the first picture of a
10 Hz stream: that is the rate of the published drives, and x264 spends more on pictures that are
shown for longer (four times as much at 1 Hz as at 30). Slices are counted, parameter sets are not.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from rfcore.codec.h264.ffmpeg import EncoderOptions, PictureKind, encode_pictures
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import Rgb, read_rgb
from rfcore.native.yuv import i420_from_rgb
from rfedge.arguments import JSON
from rfedge.evaluate.savings import slice_nals
from rfedge.results import make_result, provenance, write_result

PRESET = "medium"


@dataclass(frozen=True)
class SceneSizes:
    """Bytes of each picture of a built scene, and what it was built with."""

    folder: Path
    scene: str
    samples: int
    size_px: tuple[int, int]
    picture_bytes: tuple[int, ...]

    def line(self) -> str:
        """Say it in a line, in kB of 1000 bytes."""
        kb = np.array(self.picture_bytes) / 1000
        width, height = self.size_px
        return (
            f"{self.scene}: {len(kb)} I pictures of {width}x{height} px at {self.samples} samples "
            f"a pixel, {kb.mean():.0f} kB on average ({kb.min():.0f} to {kb.max():.0f})"
        )


def intra_bytes(rgb: Rgb, crf: float, rate_hz: int) -> int:
    """Return the bytes of a picture's slices, start codes left out, coded alone.

    Raises ``CodecError`` if x264 fails.
    """
    picture = i420_from_rgb(rgb)
    width, height = (side + side % 2 for side in picture.size_px)
    options = EncoderOptions(
        (width, height), PRESET, crf, params={"threads": "1"}, tune=None, rate_hz=rate_hz
    )
    (unit,) = encode_pictures(options, [(picture, PictureKind.CHOSEN)])
    return sum(map(len, slice_nals(unit)))


def sizes_of(job: EvalIntraSize) -> Iterator[SceneSizes]:
    """Code every picture of the scenes.

    Raises ``DatasetError`` for a folder that is none, or whose pictures differ in size.
    """
    for folder in job.scenes:
        name, samples = _build(folder)
        pictures = [read_rgb(path) for path in sorted(folder.glob("*/images/*.png"))]
        shapes = {picture.shape[:2] for picture in pictures}
        if len(shapes) != 1:
            raise DatasetError(f"{folder}: pictures of {len(shapes)} sizes where one is needed")
        ((height, width),) = shapes
        sizes = tuple(intra_bytes(picture, job.crf, job.rate_hz) for picture in pictures)
        yield SceneSizes(folder, name, samples, (width, height), sizes)


def write_sizes(path: Path, scenes: Sequence[SceneSizes], job: EvalIntraSize) -> None:
    """Write what was measured, with the command, the revision and the host."""
    content = {
        "coding": {"preset": PRESET, "crf": job.crf, "rate_hz": job.rate_hz},
        "rows": [
            {
                "scene": scene.scene,
                "samples": scene.samples,
                "size_px": list(scene.size_px),
                "mean_bytes": round(float(np.mean(scene.picture_bytes))),
                "picture_bytes": list(scene.picture_bytes),
            }
            for scene in scenes
        ],
    }
    write_result(path, make_result("intra-size", provenance(), content))


def _build(folder: Path) -> tuple[str, int]:
    try:
        build = json.loads((folder / "build.json").read_text(encoding="utf-8"))
        return str(build["scene"]["name"]), int(build["samples"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{folder}/build.json: does not say what was built") from error


@dataclass(frozen=True)
class EvalIntraSize:
    """Code each picture of built scenes alone by x264; real driving video has 120 to 250 kB."""

    scenes: Annotated[tuple[Path, ...], Positional, arg(metavar="FOLDER ...")]
    """Folders that `streetgen build` made."""
    crf: float = 23.0
    """x264's constant rate factor."""
    rate_hz: int = 10
    """Pictures a second that x264 is told: it spends more on a picture that is shown for longer."""
    json: Annotated[Path | None, JSON] = None
    """Also write the figures into this file."""

    def __post_init__(self) -> None:
        if not self.scenes:
            raise InvalidInput("scenes", "no folder is named")
        if not 0 <= self.crf <= 51:
            raise InvalidInput("crf", f"{self.crf} is outside 0..51")
        if not 1 <= self.rate_hz <= 120:
            raise InvalidInput("rate_hz", f"{self.rate_hz} is outside 1..120")

    def run(self) -> None:
        """Print a line for each scene."""
        measured = []
        for sizes in sizes_of(self):
            print(sizes.line(), flush=True)
            measured.append(sizes)
        if self.json is not None:
            write_sizes(self.json, measured, self)
