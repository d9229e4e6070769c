"""The sharpest frame of each stretch of a video; a stopped run goes on where it was."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import read_rgb
from rfedge.cli import parse
from rfedge.datasets.video_frames import sharpest_frames, sharpness
from rfedge.samples import sample_path
from rfedge.video import write_mp4

SHARP = (1, 5, 7, 9)
"""Sharp ones of twelve frames at 6 Hz, one in each half second."""


def picture(number: int, *, sharp: bool) -> np.ndarray:
    """Bars of a level of its own: one pixel wide, or smeared over eight."""
    bars = np.repeat(np.array([0, 100], np.uint8), 1 if sharp else 8)
    row = np.resize(bars, 64) + np.uint8(10 * number)
    return np.broadcast_to(row[None, :, None], (48, 64, 3)).copy()


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "phone.mp4"
    write_mp4(path, (picture(n, sharp=n in SHARP) for n in range(12)), 6.0)
    return path


def kept(folder: Path) -> list[int]:
    """Return which frames were kept, by their level."""
    levels = [read_rgb(path).mean() - 50 for path in sorted(folder.glob("*.png"))]
    return [round(level / 10) for level in levels]


def quiet(_: str) -> None:
    pass


def test_the_sharpest_frame_of_each_half_second_is_kept(video, tmp_path):
    told: list[str] = []
    assert sharpest_frames(video, tmp_path / "frames", 2.0, told.append) == 4
    assert kept(tmp_path / "frames") == list(SHARP)
    assert len(told) == 4


def test_a_stopped_run_goes_on_and_decodes_nothing_twice(video, tmp_path):
    class Stopped(Exception):
        pass

    def stop(text: str) -> None:
        if "1 of" in text:
            raise Stopped

    with pytest.raises(Stopped):
        sharpest_frames(video, tmp_path / "frames", 2.0, stop)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "frames").glob("*.png")}
    assert 0 < len(before) < 4
    assert sharpest_frames(video, tmp_path / "frames", 2.0, quiet) == 4
    assert kept(tmp_path / "frames") == list(SHARP)
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_frames_of_another_rate_are_not_mixed(video, tmp_path):
    sharpest_frames(video, tmp_path / "frames", 2.0, quiet)
    with pytest.raises(InvalidInput, match="another video or rate"):
        sharpest_frames(video, tmp_path / "frames", 1.0, quiet)


def test_what_is_no_video_is_named(tmp_path):
    (tmp_path / "phone.mp4").write_text("not a video")
    with pytest.raises(DatasetError, match=r"phone\.mp4: not a readable video"):
        sharpest_frames(tmp_path / "phone.mp4", tmp_path / "frames", 2.0, quiet)


def test_a_video_of_times_that_do_not_begin_at_zero_is_counted_from_its_start(tmp_path):
    path = tmp_path / "cut.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=6, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.time_base = Fraction(1, 6)
        for number in range(12):
            frame = av.VideoFrame.from_ndarray(picture(number, sharp=number in SHARP), "rgb24")
            frame.pts = 600 + number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert sharpest_frames(path, tmp_path / "frames", 2.0, quiet) == 4
    assert kept(tmp_path / "frames") == list(SHARP)


def test_blur_lowers_sharpness():
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 255, (40, 40), np.uint8)
    blurred = ((noise[:-1, :-1].astype(int) + noise[1:, 1:]) // 2).astype(np.uint8)
    assert sharpness(blurred) < sharpness(noise)
    assert sharpness(np.full((8, 8), 7, np.uint8)) == 0


@pytest.mark.slow
@pytest.mark.sample
def test_a_video_alone_becomes_a_dataset_with_poses(tmp_path):
    drive = read_dataset(sample_path("street/transforms_drive_empty.json"))
    write_mp4(tmp_path / "drive.mp4", (p.read() for p in drive.pictures[:8]), 10.0)
    k = drive.pictures[0].camera.intrinsics
    known = (str(value) for value in (k.fx_px, k.fy_px, k.cx_px, k.cy_px))
    options = ("--max-side-px", "640", "--features", "2048", "--threads", "1")
    camera = ("--camera-model", "PINHOLE", "--parameters", *known)
    arguments = ("dataset", "poses", str(tmp_path / "drive.mp4"), "--per-second", "10")
    parse([*arguments, "--out", str(tmp_path / "out"), *options, *camera]).run()
    assert len(read_dataset(tmp_path / "out").pictures) >= 6
    assert not (tmp_path / "out.frames").exists()
