"""``make sample``: pack two built scenes, the street empty and with vehicles, as the sample.

The training views become JPEG files, whose loss a trainer does not notice; the drives stay lossless
(WebP), because a lossily coded "camera" would flatter every coding figure. The manifest says which
commands and revision rendered the pictures.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
from tyro.conf import Positional

from rfcore.dataset import write_manifest
from rfcore.dataset.read import read_source
from rfcore.dataset.source import Source
from rfcore.dataset.write import POINTS_NAME, WrittenPicture, transforms_of, write_points
from rfcore.errors import DatasetError
from rfcore.files import write_whole
from rfcore.image import Rgb
from rfcore.program import parse_options, run_program
from rfedge.samples import sample_path

COMMAND = "make sample"


@dataclass(frozen=True)
class Coding:
    """The storage of pictures: OpenCV's file type and settings."""

    suffix: str
    settings: tuple[int, ...]

    def coded(self, rgb: Rgb) -> bytes:
        """Return uint8 [H, W, 3] as a file."""
        _, data = cv2.imencode(self.suffix, rgb[..., ::-1], self.settings)
        return data.tobytes()


JPEG = Coding(
    ".jpg",
    (
        cv2.IMWRITE_JPEG_QUALITY,
        86,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    ),
)
LOSSLESS = Coding(".webp", (cv2.IMWRITE_WEBP_QUALITY, 101))


@dataclass(frozen=True)
class Part:
    """A folder of the sample: the built scene and the split its pictures come from."""

    name: str
    scene: str
    split: str
    coding: Coding


PARTS = (
    Part("train", "empty", "train", JPEG),
    Part("drive_empty", "empty", "drive", LOSSLESS),
    Part("drive_vehicles", "vehicles", "drive", LOSSLESS),
)


@dataclass(frozen=True)
class Packed:
    """A part's coded pictures by their path in the sample, and its transforms file."""

    part: Part
    pictures: Mapping[str, bytes]
    transforms: str

    @staticmethod
    def of(part: Part, source: Source) -> Packed:
        """Read and code the part's pictures; raise ``DatasetError`` for one that is damaged."""
        paths = [f"{part.name}/{i:03d}{part.coding.suffix}" for i in range(len(source.pictures))]
        written = [
            WrittenPicture(path, picture.camera, picture.world_from_cam, picture.time_ns)
            for path, picture in zip(paths, source.pictures, strict=True)
        ]
        points_name = POINTS_NAME if part.split == "train" else None
        content = json.dumps(transforms_of(written, points_name), indent=1) + "\n"
        coded = [part.coding.coded(picture.read()) for picture in source.pictures]
        return Packed(part, dict(zip(paths, coded, strict=True)), content)

    def write(self, sample: Path) -> None:
        """Replace the part's files."""
        folder = sample / self.part.name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for path, data in self.pictures.items():
            write_whole(sample / path, data)
        write_whole(sample / _transforms(self.part.name), self.transforms)


def pack_sample(built: Path, sample: Path) -> None:
    """Write pictures, transforms, points and manifest of ``sample`` from the scenes in ``built``.

    ``built`` has a folder for each scene, ``empty`` and ``vehicles``, as ``streetgen build``
    leaves it. Other files of the sample stay. Raises ``DatasetError``
    for a scene that is missing or incomplete, or has a picture that cannot be read; the sample is
    then untouched.
    """
    made_by = {scene: _made_by(built / scene) for scene in ("empty", "vehicles")}
    found = {part: read_source(built / part.scene / _transforms(part.split)) for part in PARTS}
    empty, vehicles = (len(found[part].pictures) for part in PARTS[1:])
    if empty != vehicles:
        raise DatasetError(f"{built}: drives of {empty} and {vehicles} pictures; build the rest")
    points = found[PARTS[0]].points
    if points is None:
        raise DatasetError(f"{built}: the training views have no points")
    packed = [Packed.of(part, source) for part, source in found.items()]
    for part in packed:
        part.write(sample)
    write_points(sample / POINTS_NAME, points)
    write_manifest(sample, {"command": COMMAND, "scenes": made_by})


def _made_by(folder: Path) -> Mapping[str, Any]:
    """The build's own manifest, but for its list of files."""
    try:
        about = json.loads((folder / "manifest.json").read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{folder}: no built scene ({error}); run {COMMAND}") from error
    return {name: value for name, value in about.items() if name != "sha256"}


def _transforms(name: str) -> str:
    return f"transforms_{name}.json"


@dataclass(frozen=True)
class MakeSample:
    """Pack the scenes built in a folder as the sample."""

    built: Annotated[Path, Positional] = Path("out/sample")
    """Folder with the built scenes `empty` and `vehicles`."""
    sample: Annotated[Path, Positional] = sample_path("street")
    """The sample's folder."""

    def run(self) -> None:
        """Pack it and say how large it is; raise ``DatasetError``."""
        pack_sample(self.built, self.sample)
        files = [path for path in self.sample.rglob("*") if path.is_file()]
        size_bytes = sum(path.stat().st_size for path in files)
        print(f"{self.sample}: {len(files)} files, {size_bytes / 1e6:.1f} MB")


def main() -> int:
    """Parse the command line and pack; return the exit status."""
    return run_program("sample", lambda: parse_options(MakeSample, "sample").run())


if __name__ == "__main__":
    sys.exit(main())
