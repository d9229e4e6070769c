"""The commands of docs/how-to/data.md do what the page says, on two small recordings of the
sample."""

import re
import tomllib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from docs.pages import Page
from rfcore.camera import Pose
from rfcore.dataset import read_dataset
from rfcore.dataset.recording import SECTIONS
from rfcore.dataset.source import SourcePoints
from rfcore.dataset.write import write_points
from rfcore.views import PosedPicture
from rfedge.cli import parse

ROOT = Path(__file__).parents[2]
PAGE = Page("how-to/data.md")
SAMPLE = ROOT / "samples" / "street"
SIZE_PX = (96, 54)
OFFSET_S = 12.5
BODY_FROM_CAM = Pose.from_matrix([[0, 0, 1, 1.2], [-1, 0, 0, 0], [0, -1, 0, 1.4]])


def test_the_toml_of_the_page_has_only_keys_that_are_read():
    content = tomllib.loads("\n".join(PAGE.blocks("toml")))
    assert set(content) == set(SECTIONS)
    for section, keys in content.items():
        assert set(keys) <= set(SECTIONS[section].split())


@pytest.mark.slow
@pytest.mark.sample
def test_the_commands_lead_from_recordings_to_a_decoded_drive(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_recording(Path("my-street"), "transforms_drive_empty.json", with_points=True)
    make_recording(Path("my-drive"), "transforms_drive_vehicles.json", with_points=False)
    for _, *command in PAGE.commands("sh"):
        small = ["96x54" if word == "640x360" else word for word in command]
        if small[0] == "train":
            small += ["--iterations", "40", "--gaussians", "2000", "--threads", "1"]
        parse(small).run()
    assert len(list(Path("out/renders").glob("*.png"))) == 8
    with av.open("out/decoded.mp4") as container:
        decoded = list(container.decode(video=0))
    drive = read_dataset(Path("out/drive")).pictures
    assert len(decoded) == len(drive) == 8
    given = read_dataset(SAMPLE / "transforms_drive_vehicles.json").pictures
    for found, true in zip(drive, given, strict=False):
        assert found.camera.world_from_cam.translation_m == pytest.approx(
            true.camera.world_from_cam.translation_m, abs=1e-6
        )


def make_recording(folder: Path, transforms: str, *, with_points: bool) -> None:
    """A recording as the page describes it, with the page's own camera.toml at a small size."""
    folder.mkdir()
    pictures = read_dataset(SAMPLE / transforms, size_px=SIZE_PX).pictures[:8]
    write_video(folder / "drive.mp4", pictures)
    lines = [tum_line(picture) for picture in pictures]
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")
    k = pictures[0].camera.intrinsics
    values = {
        "width_px": k.width_px,
        "height_px": k.height_px,
        "fx_px": k.fx_px,
        "fy_px": k.fy_px,
        "cx_px": k.cx_px,
        "cy_px": k.cy_px,
        "k1": 0.0,
        "k2": 0.0,
    }
    text = next(iter(PAGE.blocks("toml")))
    for key, value in values.items():
        text = re.sub(rf"^{key} = \S+", f"{key} = {value}", text, flags=re.MULTILINE)
    if not with_points:
        text = text[: text.index("[points]")]
    (folder / "camera.toml").write_text(text)
    if with_points:
        points = read_dataset(SAMPLE / "transforms_train.json").points
        few = slice(None, None, 50)
        write_points(
            folder / "lidar.ply",
            SourcePoints(points.xyz_m[few].astype(np.float64), points.rgb[few]),
        )


def write_video(file: Path, pictures: tuple[PosedPicture, ...]) -> None:
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "12"})
        stream.width, stream.height = SIZE_PX
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, 10)
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture.read(), "rgb24")))
        container.mux(stream.encode(None))


def tum_line(picture: PosedPicture) -> str:
    """The vehicle's pose at a picture's time: world_from_body = world_from_cam cam_from_body."""
    pose = picture.camera.world_from_cam.compose(BODY_FROM_CAM.inverse())
    w, x, y, z = pose.rotation
    time_s = picture.time_ns / 1e9 + OFFSET_S
    return " ".join(repr(value) for value in (time_s, *pose.translation_m, x, y, z, w))
