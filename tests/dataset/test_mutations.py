"""A damaged description is read or refused as ``DatasetError``: nothing else comes out."""

from pathlib import Path

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError

DESCRIPTIONS = {
    "transforms": "transforms.json",
    "colmap_text": "sparse/0/images.txt",
    "colmap_binary": "sparse/0/images.bin",
    "kitti": "calib.txt",
    "inria": "cameras.json",
    "folder": "camera.toml",
    "video": "trajectory.txt",
}
OTHERS = {
    "colmap_text": "sparse/0/cameras.txt",
    "colmap_binary": "sparse/0/cameras.bin",
    "kitti": "poses.txt",
    "folder": "trajectory.csv",
    "video": "drive.mp4",
}
MUTATIONS = 60


@pytest.mark.parametrize(("format_name", "name"), [*DESCRIPTIONS.items(), *OTHERS.items()])
def test_a_mutated_description_is_read_or_refused(golden, format_name, name, tmp_path):
    folder = golden.write(format_name, tmp_path / "d")
    whole = (folder / name).read_bytes()
    rng = np.random.default_rng(len(whole))
    for _ in range(MUTATIONS):
        (folder / name).write_bytes(mutated(whole, rng))
        assert "\n" not in outcome(folder)


def outcome(folder: Path) -> str:
    try:
        return f"{len(read_dataset(folder, distortion='undistort').pictures)} pictures"
    except DatasetError as error:
        return str(error)


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Flip a bit, cut, double a piece, or put a long number."""
    at = int(rng.integers(len(content)))
    kind = int(rng.integers(4))
    if kind == 0:
        flipped = bytearray(content)
        flipped[at] ^= 1 << int(rng.integers(8))
        return bytes(flipped)
    if kind == 1:
        return content[:at]
    if kind == 2:
        return content[:at] + content[max(at - 20, 0) :]
    return content[:at] + b"9" * 400 + content[at:]


def test_a_video_of_an_unknown_codec_is_refused(golden, tmp_path):
    folder = golden.write("video", tmp_path / "d")
    content = (folder / "drive.mp4").read_bytes()
    (folder / "drive.mp4").write_bytes(content.replace(b"avc1\0\0", b"zzz9\0\0"))
    with pytest.raises(DatasetError, match=r"drive\.mp4: (is of a codec|not a readable video)"):
        read_dataset(folder)


def test_a_whole_number_beyond_every_float_is_refused(golden, tmp_path):
    folder = golden.write("transforms", tmp_path / "d")
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace('"w": 64', '"w": 1' + "0" * 400))
    with pytest.raises(DatasetError, match=r"'w' is 1000\d+\.\.\., must be finite"):
        read_dataset(folder)
