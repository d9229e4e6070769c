"""New pictures are placed in a dataset's own world, which stays as it is."""

import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import read_dataset
from rfcore.dataset.read import read_source
from rfcore.dataset.source import SourceCamera, SourcePicture, SourcePoints
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import DatasetError, InvalidInput
from rfcore.field import load_field
from rfcore.image import rgb_from_colour, write_png
from rfcore.lens import BrownLens
from rfedge.cli import parse
from rfedge.datasets import poses
from rfedge.datasets.colmap_features import DATABASE, PoseSettings, add_new, cancellable
from rfedge.datasets.poses import PlacedPictures, pose_dataset
from rfedge.fields.viewpoints import looking_at
from rfedge.video import write_mp4

SAMPLE = Path(__file__).parents[2] / "samples" / "street"
SETTINGS = PoseSettings(max_side_px=640, features=1024, threads=1)


@pytest.fixture
def drive() -> tuple[SourcePicture, ...]:
    """Eight pictures of the sample's empty drive."""
    return read_source(SAMPLE / "transforms_drive_empty.json").pictures[:8]


def half_of(drive: tuple[SourcePicture, ...], folder: Path) -> Path:
    """A dataset of every second picture."""
    (folder / "images").mkdir(parents=True)
    pictures = []
    for i, picture in enumerate(drive[::2]):
        write_png(folder / "images" / f"{i}.png", picture.read())
        pictures.append(WrittenPicture(f"images/{i}.png", picture.camera, picture.world_from_cam))
    write_transforms(folder, pictures, None)
    return folder


def others_of(drive: tuple[SourcePicture, ...], folder: Path) -> Path:
    folder.mkdir()
    for i, picture in enumerate(drive[1::2]):
        write_png(folder / f"{i}.png", picture.read())
    return folder


def turn_deg(a: Pose, b: Pose) -> float:
    cosine = abs(sum(p * q for p, q in zip(a.rotation, b.rotation, strict=True)))
    return math.degrees(2 * math.acos(min(cosine, 1.0)))


@pytest.mark.slow
@pytest.mark.sample
def test_half_of_a_drive_is_placed_among_the_other_half(drive, tmp_path):
    """A pixel is 0.18 degrees here; the true poses are those the street was rendered with."""
    known, new = half_of(drive, tmp_path / "known"), others_of(drive, tmp_path / "new")
    told: list[str] = []
    line = pose_dataset(new, tmp_path / "out", known, SETTINGS, told.append)
    told = [text for text in told if not text.endswith("so far")]
    assert told[:4] == [
        "features of the dataset's 4 pictures",
        "features of 4 new pictures",
        "matching 8 pictures (exhaustive)",
        "points of the dataset's pictures at their given poses",
    ]
    assert told[4:] == [f"placing pictures: {count} of 8" for count in (5, 6, 7, 8)]
    assert line.startswith(f"{tmp_path / 'out'}: 4 pictures placed")
    placed = read_dataset(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "images",
        "points.ply",
        "transforms.json",
    ]
    turns, shifts = [], []
    for found, true in zip(placed.pictures, drive[1::2], strict=True):
        pose = found.camera.world_from_cam
        turns.append(turn_deg(pose, true.world_from_cam))
        shifts.append(math.dist(pose.translation_m, true.world_from_cam.translation_m))
    assert np.median(turns) < 0.05
    assert np.median(shifts) < 0.05
    assert len(placed.points.xyz_m) > 100


@pytest.mark.slow
@pytest.mark.sample
def test_a_drive_alone_finds_how_the_camera_turns(drive, tmp_path):
    """The world is COLMAP's own, so turns between pictures are compared, and shifts by ratio."""
    (tmp_path / "images").mkdir()
    for i, picture in enumerate(drive):
        write_png(tmp_path / "images" / f"{i}.png", picture.read())
    k = drive[0].camera.intrinsics
    known = PoseSettings(
        model="PINHOLE",
        parameters=(k.fx_px, k.fy_px, k.cx_px, k.cy_px),
        max_side_px=640,
        features=2048,
        threads=1,
    )
    pose_dataset(tmp_path / "images", tmp_path / "out", None, known, lambda _: None)
    found = read_source(tmp_path / "out").pictures
    assert len(found) == len(drive)
    assert found[0].camera == drive[0].camera
    steps = [
        (relative(a, b), relative(c, d))
        for (a, b), (c, d) in zip(pairwise(found), pairwise(drive), strict=True)
    ]
    assert np.median([turn_deg(ours, theirs) for ours, theirs in steps]) < 0.05
    ratios = [math.hypot(*o.translation_m) / math.hypot(*t.translation_m) for o, t in steps]
    assert max(ratios) / min(ratios) < 1.05


@pytest.mark.slow
@pytest.mark.sample
def test_the_command_that_a_folder_without_poses_is_given_makes_a_dataset(tmp_path):
    """The pictures are the field's: a walk along the street, the camera turned to the side."""
    pictures = tmp_path / "my pictures"
    pictures.mkdir()
    field = load_field(SAMPLE.parent / "fields" / "street.rff")
    for i in range(8):
        eye = np.array([-20.0 + 0.6 * i, -1.5, 2.0])
        pose = looking_at(eye, eye + np.array([0.2, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
        camera = Camera(Intrinsics(480, 360, 330.0, 330.0, 240.0, 180.0), pose)
        write_png(pictures / f"{i}.png", rgb_from_colour(field.render_colour(camera)))
    with pytest.raises(DatasetError, match="holds 8 pictures and no poses") as refused:
        read_dataset(pictures)
    command = shlex.split(str(refused.value).partition(": rfedge ")[2])
    assert command[-2:] == ["--out", "DATASET"]
    parse([*command[:-1], str(tmp_path / "posed"), "--threads", "1"]).run()
    assert len(read_dataset(tmp_path / "posed", distortion="undistort").pictures) >= 6


def test_a_lens_that_no_camera_has_is_refused_and_leaves_nothing(drive, tmp_path, monkeypatch):
    """COLMAP finds such of eight pictures straight ahead, of which it places two."""

    def solved(_root, names, *_rest):
        camera = SourceCamera(Intrinsics(640, 360, 109.0, 109.0, 320.0, 180.0), BrownLens(k1=456.0))
        points = SourcePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        placed = dict.fromkeys(names[:2], (camera, Pose.identity()))
        return PlacedPictures(placed, tuple(names[2:]), points)

    monkeypatch.setattr(poses, "solve_poses", solved)
    pictures = others_of(drive, tmp_path / "ahead")
    with pytest.raises(DatasetError, match=r"placed 2 of 4 pictures, with a lens.*--parameters"):
        pose_dataset(pictures, tmp_path / "out", None, SETTINGS, lambda _: None)
    assert not (tmp_path / "out").exists()


def two_sizes(folder: Path) -> Path:
    folder.mkdir()
    for i in range(5):
        side = 32 if i in (1, 3) else 64
        write_png(folder / f"{i}.png", np.zeros((side, side, 3), np.uint8))
    return folder


@pytest.mark.parametrize("fails", [False, True])
def test_pictures_of_another_size_than_the_given_camera_are_named(tmp_path, monkeypatch, fails):
    """Whether they leave a gap or not."""

    def solved(_root, names, *_rest):
        assert [Path(name).stem for name in names] == ["0", "2", "4"]
        if fails:
            raise DatasetError("no two pictures share enough to start from")
        camera = SourceCamera(Intrinsics(64, 64, 50.0, 50.0, 32.0, 32.0))
        points = SourcePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        return PlacedPictures(dict.fromkeys(names, (camera, Pose.identity())), (), points)

    monkeypatch.setattr(poses, "solve_poses", solved)
    given = PoseSettings(model="PINHOLE", parameters=(50.0, 50.0, 32.0, 32.0))
    pictures, said = two_sizes(tmp_path / "two"), r"2 sizes \(64x64, 32x32 px\).* 1\.png, 3\.png"
    if fails:
        with pytest.raises(DatasetError, match=f"share enough.*{said}"):
            pose_dataset(pictures, tmp_path / "out", None, given, lambda _: None)
        return
    assert re.search(said, pose_dataset(pictures, tmp_path / "out", None, given, lambda _: None))
    few = tmp_path / "few"
    few.mkdir()
    for i in (0, 1, 2):
        (pictures / f"{i}.png").rename(few / f"{i}.png")
    with pytest.raises(DatasetError, match="2 pictures are left of 3"):
        pose_dataset(few, tmp_path / "other", None, given, lambda _: None)


def test_the_focal_lengths_that_were_found_are_said(tmp_path, monkeypatch):
    def solved(_root, names, *_rest):
        wide, narrow = (
            SourceCamera(Intrinsics(side, side, f_px, f_px, side / 2, side / 2))
            for side, f_px in ((64, 50.2), (32, 25.7))
        )
        points = SourcePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        placed = {n: (narrow if n[4] in "13" else wide, Pose.identity()) for n in names}
        return PlacedPictures(placed, (), points)

    monkeypatch.setattr(poses, "solve_poses", solved)
    pictures = two_sizes(tmp_path / "two")
    line = pose_dataset(pictures, tmp_path / "out", None, SETTINGS, lambda _: None)
    assert line.endswith("focal length found: 50 px (64x64), 26 px (32x32)")


def test_how_long_matching_has_been_going_on_is_told(tmp_path, monkeypatch):
    said_again = threading.Event()

    def tell(text: str) -> None:
        if re.fullmatch(r"matching 2 pictures \(exhaustive\): \d+ s so far", text):
            said_again.set()

    def match(*_) -> None:
        assert said_again.wait(60)
        raise DatasetError("no more of it")

    monkeypatch.setattr(poses, "add_new", lambda *_: None)
    monkeypatch.setattr(poses, "match", match)
    with pytest.raises(DatasetError, match="no more of it"):
        poses.solve_poses(tmp_path, ["new/0.png", "new/1.png"], (), SETTINGS, tell)


def test_each_size_gets_a_camera_of_its_own_where_none_is_given(tmp_path):
    two_sizes(tmp_path / "new")
    names = [f"new/{i}.png" for i in range(5)]
    add_new(tmp_path, names, PoseSettings(features=8, threads=1))
    with pycolmap.Database.open(tmp_path / DATABASE) as database:
        sizes = {camera.camera_id: camera.width for camera in database.read_all_cameras()}
        images = database.read_all_images()
    assert sorted(sizes.values()) == [32, 64]
    assert {image.name: sizes[image.camera_id] for image in images} == {
        name: 32 if name[4] in "13" else 64 for name in names
    }


def relative(a: SourcePicture, b: SourcePicture) -> Pose:
    return a.world_from_cam.inverse().compose(b.world_from_cam)


@pytest.mark.slow
@pytest.mark.sample
def test_sigterm_ends_it_in_one_line_and_leaves_nothing(drive, tmp_path):
    """In the middle of COLMAP's own work, which does not look for signals."""
    known, new = half_of(drive, tmp_path / "known"), others_of(drive, tmp_path / "new")
    command = [sys.executable, "-m", "rfedge", "dataset", "poses", str(new), "--register-to"]
    command += [str(known), "--threads", "1", "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr.readline() == "  features of the dataset's 4 pictures\n"
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()
    assert (process.returncode, said) == (130, "rfedge: interrupted\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["known", "new"]


def test_an_exception_of_the_waiting_thread_cancels_colmaps_work():
    """It is the exception of a signal handler, without a signal."""
    tokens = []

    def work(*, cancellation_token: pycolmap.CancellationToken) -> None:
        tokens.append(cancellation_token)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cancellable(work)
    assert tokens[0].is_cancelled


def test_parameters_belong_to_their_model():
    with pytest.raises(InvalidInput, match="PINHOLE has 4, not 3"):
        PoseSettings(model="PINHOLE", parameters=(1.0, 2.0, 3.0))
    with pytest.raises(DatasetError, match="camera model FOV is none of"):
        PoseSettings(model="FOV")


def test_too_few_pictures_are_refused(tmp_path):
    with pytest.raises(DatasetError, match="holds no pictures"):
        pose_dataset(tmp_path, tmp_path / "out", None, SETTINGS, lambda _: None)


@pytest.mark.parametrize("folder", [False, True])
def test_a_video_is_refused_with_the_commands_that_help(tmp_path, folder):
    video = tmp_path / "phone.MOV"
    write_mp4(video, [np.zeros((16, 16, 3), np.uint8)] * 2, 10.0)
    with pytest.raises(DatasetError, match=r"phone\.MOV: is a video.*rfedge dataset poses"):
        pose_dataset(
            tmp_path if folder else video, tmp_path / "out", None, SETTINGS, lambda _: None
        )
    assert not (tmp_path / "out").exists()


def test_pictures_that_share_nothing_leave_nothing_behind(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for i in range(3):
        rgb = np.random.default_rng(i).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        write_png(images / f"{i}.png", rgb)
    with pytest.raises(DatasetError, match="no two pictures share enough"):
        pose_dataset(images, tmp_path / "out", None, SETTINGS, lambda _: None)
    shutil.rmtree(images)
    assert list(tmp_path.iterdir()) == []
