"""A sample is packed from built scenes: what is read back is what was rendered."""

import json
from pathlib import Path

import numpy as np
import pytest

from lab.make_street import main, pack_sample
from rfcore.camera import Intrinsics, Pose
from rfcore.dataset import read_dataset, verify_manifest, write_manifest
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.dataset.write import WrittenPicture, transforms_of, write_points
from rfcore.errors import DatasetError
from rfcore.image import Rgb, write_png
from streetgen.scene_file import load_scene

SAMPLE = Path(__file__).parents[2] / "samples" / "street"
CAMERA = SourceCamera(Intrinsics(48, 32, 24.0, 24.0, 24.0, 16.0))
POINTS = SourcePoints(np.array([[5.0, 1.0, 2.0]]), np.array([[9, 8, 7]], np.uint8))


def picture(seed: int) -> Rgb:
    """Smooth, so that JPEG is near to it."""
    steps = np.linspace(40 + seed, 200, 32 * 48, dtype=np.float32).reshape(32, 48, 1)
    return np.repeat(steps, 3, axis=2).astype(np.uint8)


def build_split(folder: Path, split: str, count: int, rate_hz: float | None) -> None:
    (folder / split).mkdir(parents=True)
    written = []
    for i in range(count):
        path = f"{split}/{i:06d}.png"
        write_png(folder / path, picture(i))
        time_ns = None if rate_hz is None else round(i / rate_hz * 1e9)
        pose = Pose((float(i), -2.0, 1.6), (1.0, 0.0, 0.0, 0.0))
        written.append(WrittenPicture(path, CAMERA, pose, time_ns))
    write_points(folder / "points.ply", POINTS)
    content = json.dumps(transforms_of(written, "points.ply"))
    (folder / f"transforms_{split}.json").write_text(content)


@pytest.fixture
def built(tmp_path: Path) -> Path:
    folder = tmp_path / "built"
    build_split(folder / "empty", "train", 3, None)
    build_split(folder / "empty", "drive", 2, 10.0)
    build_split(folder / "vehicles", "drive", 2, 10.0)
    for scene in ("empty", "vehicles"):
        write_manifest(folder / scene, {"command": f"streetgen build {scene}"})
    return folder


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    folder = tmp_path / "street"
    folder.mkdir()
    (folder / "README.md").write_text("a street\n")
    return folder


def test_drives_are_lossless_and_training_views_nearly(built, sample):
    pack_sample(built, sample)
    for name in ("empty", "vehicles"):
        drive = read_dataset(sample / f"transforms_drive_{name}.json")
        assert drive.rate_hz == pytest.approx(10.0)
        for i, taken in enumerate(drive.pictures):
            np.testing.assert_array_equal(taken.read(), picture(i))
            assert taken.camera.world_from_cam.translation_m == pytest.approx((i, -2.0, 1.6))
    train = read_dataset(sample / "transforms_train.json")
    assert train.points is not None
    assert len(train.pictures) == 3
    np.testing.assert_allclose(train.pictures[1].read(), picture(1), atol=3)


def test_the_manifest_lists_everything_and_says_what_rendered_it(built, sample):
    pack_sample(built, sample)
    verify_manifest(sample)
    manifest = json.loads((sample / "manifest.json").read_bytes())
    assert manifest["scenes"]["vehicles"] == {"command": "streetgen build vehicles"}
    assert {"points.ply", "train/002.jpg", "drive_empty/001.webp"} <= manifest["sha256"].keys()


def test_pictures_of_an_earlier_packing_do_not_stay(built, sample):
    (sample / "train").mkdir()
    (sample / "train" / "900.jpg").write_bytes(b"old")
    pack_sample(built, sample)
    assert not (sample / "train" / "900.jpg").exists()


def test_an_unfinished_build_leaves_the_sample_as_it_was(built, sample, capsys, monkeypatch):
    content = json.loads((built / "vehicles" / "transforms_drive.json").read_text())
    content["frames"].pop()
    (built / "vehicles" / "transforms_drive.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError, match="drives of 2 and 1 pictures"):
        pack_sample(built, sample)
    monkeypatch.setattr("sys.argv", ["sample", str(built / "none"), str(sample)])
    assert main() == 2
    assert "no built scene" in capsys.readouterr().err
    assert [path.name for path in sample.iterdir()] == ["README.md"]


def test_a_picture_that_cannot_be_read_leaves_the_sample_as_it_was(built, sample):
    pack_sample(built, sample)
    before = {path: path.read_bytes() for path in sample.rglob("*") if path.is_file()}
    (built / "vehicles" / "drive" / "000001.png").write_bytes(b"no picture")
    with pytest.raises(DatasetError, match="not a readable picture"):
        pack_sample(built, sample)
    assert {path: path.read_bytes() for path in sample.rglob("*") if path.is_file()} == before


def test_both_scenes_of_the_sample_are_one_street_and_one_drive():
    empty, vehicles = (load_scene(str(SAMPLE / f"{name}.toml")) for name in ("empty", "vehicles"))
    assert (vehicles.geometry, vehicles.rig, vehicles.drive) == (
        empty.geometry,
        empty.rig,
        empty.drive,
    )
    assert vehicles.field == empty.name
    assert not empty.effects
    assert load_scene(str(SAMPLE / "drive_2hz.toml")).geometry == empty.geometry
