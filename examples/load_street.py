"""Read the dataset of the sample's street: ``python load_street.py ARCHIVE.zip [SPLIT]``.

Checks every digest, then prints the splits, or what each frame of a split has. Needs NumPy and
OpenCV. Poses are OpenGL's (x right, y up, z backwards), world axes z up, metres.
"""

from __future__ import annotations

import hashlib
import json
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

CLASSES = (
    *("sky", "road", "marking", "pavement", "building", "window", "vegetation"),
    *("vehicle", "sign", "pole", "wire", "object", "person", "bicycle"),
)
"""Names of the numbers in ``classes``."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture with its camera and, where it was rendered, the truth of its pixels."""

    rgb: NDArray[np.uint8]
    """[H, W, 3]."""
    world_from_camera: NDArray[np.float64]
    """[4, 4]."""
    intrinsics_px: tuple[float, float, float, float]
    """fl_x, fl_y, cx, cy."""
    depth_m: NDArray[np.float64] | None
    """[H, W], along the camera's axis; 0 is none, or beyond 65.535 m."""
    classes: NDArray[np.uint8] | None
    """[H, W], indices of ``CLASSES``."""


def check(archive: zipfile.ZipFile) -> dict[str, Any]:
    """Return the manifest; raise ``ValueError`` for a file that is missing or damaged."""
    manifest: dict[str, Any] = json.loads(archive.read("manifest.json"))
    for name, digest in manifest["sha256"].items():
        if name not in archive.NameToInfo:
            raise ValueError(f"{name} is missing: fetch the archive again")
        if hashlib.sha256(archive.read(name)).hexdigest() != digest:
            raise ValueError(f"{name} is damaged: fetch the archive again")
    return manifest


def frames(archive: zipfile.ZipFile, split: dict[str, str]) -> Iterator[Frame]:
    """Yield the frames of a split of the manifest, in the order of time."""
    cameras = json.loads(archive.read(split["pictures"]))
    truth: list[str] = []
    if "truth" in split:
        made = json.loads(archive.read(split["truth"]))
        truth = [_beside(split["truth"], frame) for frame in made["frames"]]
    for number, frame in enumerate(cameras["frames"]):
        pixels = _picture(archive, _beside(split["pictures"], frame), cv2.IMREAD_COLOR)
        depth, classes = (
            _picture(archive, truth[number].replace("/images/", f"/{kind}/"), cv2.IMREAD_UNCHANGED)
            if truth
            else None
            for kind in ("depth", "classes")
        )
        yield Frame(
            np.ascontiguousarray(pixels[..., ::-1]),
            np.array(frame["transform_matrix"], np.float64),
            (cameras["fl_x"], cameras["fl_y"], cameras["cx"], cameras["cy"]),
            None if depth is None else depth / 1e3,
            classes,
        )


def _beside(transforms: str, frame: dict[str, Any]) -> str:
    return str(PurePosixPath(transforms).parent / frame["file_path"])


def _picture(archive: zipfile.ZipFile, name: str, how: int) -> NDArray[Any]:
    picture = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), how)
    if picture is None:
        raise ValueError(f"{name} is no picture that OpenCV reads")
    return picture


def main() -> None:
    """Print the splits of an archive, or the frames of one."""
    with zipfile.ZipFile(sys.argv[1]) as archive:
        splits = check(archive)["splits"]
        if len(sys.argv) < 3:
            print(*splits, sep="\n")
            return
        for number, frame in enumerate(frames(archive, splits[sys.argv[2]])):
            x, y, z = frame.world_from_camera[:3, 3]
            told = (
                f"{number}: {frame.rgb.shape[1]}x{frame.rgb.shape[0]} at {x:.2f} {y:.2f} {z:.2f} m"
            )
            if frame.depth_m is not None and frame.classes is not None:
                known = frame.depth_m[frame.depth_m > 0]
                seen = ", ".join(CLASSES[k] for k in np.unique(frame.classes))
                told += f", nearest {known.min():.1f} m, {seen}" if known.size else f", {seen}"
            print(told)


if __name__ == "__main__":
    main()
