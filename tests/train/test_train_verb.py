"""``rfedge train`` writes a field, a result, a page; interrupted, it ends with the same bytes."""

import io
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from rfcore.dataset import read_dataset
from rfcore.dataset.source import SourcePoints
from rfcore.dataset.write import write_points
from rfcore.errors import DatasetError, InvalidInput, RfedgeError
from rfcore.field import load_field, save_field
from rfcore.train.ngp import NgpModel, NgpTrainingConfig
from rfedge.cli.dataset import DatasetConvert
from rfedge.training import Train, run
from rfedge.training.finish import finishing_s
from rfedge.training.loop import LoopLimits
from rfedge.training.run import TrainingJob, train, training_result
from rfedge.training.views import (
    read_depth_m,
    read_views,
    share_of_views,
    split_every,
)
from rfedge.video import write_mp4
from tests.train.conftest import write_drive

VIEWS = 8


@pytest.fixture(scope="session")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A transforms.json of eight pictures of a painted wall, without points."""
    xs_m = [-0.7 + 0.2 * i for i in range(VIEWS)]
    return write_drive(tmp_path_factory.mktemp("wall"), xs_m)


def verb(wall: Path, out: Path, **changes: object) -> Train:
    settings = {"iterations": 200, "gaussians": 300, "holdout": 4, "threads": 1, "plain": True}
    return Train(dataset=wall, out=out, **{**settings, **changes})


def test_a_preset_sets_what_is_not_given_and_says_so(wall, tmp_path, capsys):
    given = {"sh_degree": 2, "iterations": 20, "gaussians": 50, "limit": 60}
    given["out"] = tmp_path / "a.rff"
    preset, plain = (
        Train(dataset=wall, plain=True, **given, **more)
        for more in ({"preset": "street"}, {"antialiased": True})
    )
    preset.run()
    chosen, given_words = capsys.readouterr().err.strip().split("; given: ")
    assert chosen == "preset street: --antialiased"
    assert given_words == "--limit 60 --sh-degree 2 --iterations 20"
    written = preset.out.read_bytes()
    plain.run()
    assert plain.out.read_bytes() == written


def test_it_writes_a_field_a_result_and_a_page(wall, tmp_path):
    out, result, page = (tmp_path / name for name in ("a.rff", "a.json", "a.html"))
    verb(wall, out, json=str(result), report=page, limit=400).run()
    field, said = load_field(out), json.loads(result.read_text())
    assert said["field"] == f"splats {field.field_id}"
    assert (said["views"], said["held_out"]["views"]) == (6, 2)
    assert said["held_out"]["psnr_db"] == field.metadata.held_out_psnr_db > 15
    assert said["bytes"] == out.stat().st_size
    assert said["iterations"] == 200
    assert said["primitives"] == 315, "one round of 5 % in 200 iterations"
    assert len(said["curve"]) == 12
    assert said["curve"][-1][1] == pytest.approx(said["as_trained"]["psnr_db"], abs=1e-6)
    text = page.read_text()
    assert text.count("data:image/jpeg;base64,") == 9
    assert "<svg" in text
    assert "dB on pictures never seen" in text


def test_without_held_out_pictures_there_is_no_quality(wall, tmp_path):
    out, result = (tmp_path / name for name in ("a.rff", "a.json"))
    verb(wall, out, json=str(result), holdout=None, iterations=5).run()
    assert json.loads(result.read_text())["held_out"] == {"psnr_db": None, "ssim": None, "views": 0}


def test_a_page_without_held_out_pictures_is_refused_before_training(wall, tmp_path):
    with pytest.raises(InvalidInput, match="none are held out: add --holdout 8"):
        verb(wall, tmp_path / "a.rff", report=tmp_path / "a.html", holdout=None).run()
    assert list(tmp_path.iterdir()) == []


def test_a_field_too_alike_to_compress_is_written_uncompressed(wall, tmp_path, capsys):
    """After one iteration all Gaussians still have one opacity."""
    verb(wall, tmp_path / "a.rff", iterations=1, gaussians=40_000, plain=False).run()
    assert "kept uncompressed" in " ".join(capsys.readouterr().out.split())
    assert load_field(tmp_path / "a.rff").primitives == 40_000


def test_a_video_is_no_dataset_and_the_error_says_how_to_make_one(tmp_path):
    video = tmp_path / "phone.mp4"
    write_mp4(video, [np.zeros((16, 16, 3), np.uint8)] * 2, 10.0)
    helps = r"phone\.mp4: is a video.*rfedge dataset poses .*phone\.mp4.*camera\.toml"
    with pytest.raises(DatasetError, match=helps):
        verb(video, tmp_path / "a.rff").run()
    with pytest.raises(DatasetError, match=helps):
        DatasetConvert(video, tmp_path / "out").run()


def test_the_command_for_a_video_can_be_pasted_whatever_its_name(tmp_path):
    video = tmp_path / "my phone.mp4"
    write_mp4(video, [np.zeros((16, 16, 3), np.uint8)] * 2, 10.0)
    with pytest.raises(DatasetError, match=r"dataset poses '.*/my phone\.mp4' --out"):
        DatasetConvert(video, tmp_path / "out").run()


def test_a_picture_is_no_dataset_and_the_error_says_what_is(wall, tmp_path):
    with pytest.raises(DatasetError, match=r"0\.png: is no file that describes.*transforms\.json"):
        verb(wall / "0.png", tmp_path / "a.rff").run()


def test_an_interrupted_run_ends_with_the_same_bytes(wall, tmp_path):
    whole, broken = tmp_path / "whole.rff", tmp_path / "broken.rff"
    settings = {"iterations": 40, "limit": 350, "checkpoint_every": 15}
    verb(wall, whole, **settings).run()
    (tmp_path / "broken.ckpt").write_bytes((tmp_path / "whole.ckpt").read_bytes())
    verb(wall, broken, **settings, resume=True).run()
    assert broken.read_bytes() == whole.read_bytes()


def test_a_run_may_be_limited_by_time(wall, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "mean_colour_db", lambda *_: 0.0)  # a second is too short
    verb(wall, tmp_path / "a.rff", minutes=0.02).run()
    assert load_field(tmp_path / "a.rff").metadata.held_out_psnr_db is not None


@pytest.mark.parametrize("finishing_s", [5.0, 20.0, 1000.0])
def test_finishing_is_left_the_time_that_it_takes_here_and_now(
    wall, tmp_path, monkeypatch, finishing_s
):
    """Of one minute, half at most; and it is said that the run will end late."""
    monkeypatch.setattr(run, "finishing_s", lambda *_: finishing_s)
    monkeypatch.setattr(run, "monotonic", lambda: 104.0)
    job = verb(wall, tmp_path / "a.rff", minutes=1.0, plain=False).training_job()
    console = Console(record=True, file=io.StringIO(), width=200)
    limits = run._leaving_time_to_finish(job, run._trainer(job), 100.0, console)
    assert limits.kept_s == {5.0: 15.0, 20.0: 23.0, 1000.0: 28.0}[finishing_s]
    assert ("will end about 16 min late" in console.export_text()) == (finishing_s == 1000.0)


def test_finishing_is_timed_by_parts_of_it(wall, tmp_path):
    job = verb(wall, tmp_path / "a.rff").training_job()
    field, seen = run._trainer(job).field(), job.held_out.pictures
    assert 0 < finishing_s(field, job.dataset.pictures, seen, threads=1) < 60


@pytest.fixture
def nowhere(tmp_path):
    """Black points that no camera sees."""
    points = SourcePoints(np.full((50, 3), 900.0), np.zeros((50, 3), np.uint8))
    write_points(tmp_path / "nowhere.ply", points)
    return tmp_path / "nowhere.ply"


@pytest.mark.parametrize("holdout", [4, None])
def test_a_field_of_no_use_is_written_and_the_run_fails(wall, tmp_path, nowhere, holdout):
    out = tmp_path / "a.rff"
    with pytest.raises(RfedgeError, match=r"dB .* after 80 iterations, no better .*field check"):
        verb(wall, out, iterations=80, points=nowhere, holdout=holdout).run()
    assert load_field(out).primitives


def test_a_few_iterations_that_were_asked_for_are_no_failure(wall, tmp_path, nowhere, capsys):
    verb(wall, tmp_path / "a.rff", iterations=3, points=nowhere).run()
    assert re.search(
        r"after 3 iterations, no\s+better[^ß]*these\s+are\s+few[^ß]*--iterations",
        capsys.readouterr().out,
    )


def test_a_run_that_was_short_says_that_more_would_help(wall, tmp_path, capsys):
    verb(wall, tmp_path / "a.rff", iterations=80).run()
    shown = " ".join(capsys.readouterr().out.split())
    assert re.search(r"dB held out after 80 iterations; these are few .* --iterations", shown)
    assert "check its poses" not in shown


def test_a_run_ends_with_its_quality_and_iterations(wall, tmp_path, capsys):
    verb(wall, tmp_path / "a.rff").run()
    held_out_db = load_field(tmp_path / "a.rff").metadata.held_out_psnr_db
    *_, last = capsys.readouterr().out.strip().splitlines()
    assert last.strip() == f"{held_out_db:.2f} dB held out after 200 iterations"


@pytest.mark.parametrize(
    ("minutes", "changes", "kept_s"),
    [
        (2.0, {}, 30.0),
        (60.0, {}, 120.0),
        (2.0, {"plain": True}, 0.0),
        (2.0, {"max_mb": 3.0}, 0.0),
        (None, {}, 0.0),
    ],
)
def test_a_part_of_the_minutes_is_kept_for_levels_of_detail(
    wall, tmp_path, minutes, changes, kept_s
):
    settings = {"minutes": minutes, "plain": False, **changes}
    assert verb(wall, tmp_path / "a.rff", **settings).training_job().limits.kept_s == kept_s


@pytest.mark.parametrize(
    ("minutes", "size_px", "halved_until"),
    [
        (1.0, (640, 360), (0.25,)),
        (None, (640, 360), ()),
        (1.0, (1280, 720), (0.6, 0.25)),
        (None, (1280, 720), (0.6, 0.25)),
    ],
)
def test_a_run_short_of_time_or_with_large_pictures_begins_with_smaller_ones(
    tmp_path, minutes, size_px, halved_until
):
    width, height = size_px
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((height, width, 3), np.uint8))
    k = {"fl_x": width, "fl_y": width, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({**k, "frames": frames}))
    job = verb(tmp_path, tmp_path / "a.rff", minutes=minutes, holdout=None).training_job()
    assert job.config.halved_until == halved_until


@pytest.fixture
def still(wall: Path, tmp_path: Path) -> Path:
    """One picture from eight places: all of it is at infinity."""
    still = tmp_path / "still"
    shutil.copytree(wall, still)
    for i in range(VIEWS):
        shutil.copy(wall / "0.png", still / f"{i}.png")
    return still


def test_the_sky_of_still_pictures_is_found_and_written(still, tmp_path):
    for directions in (0, 2000):
        verb(still, tmp_path / f"{directions}.rff", iterations=1, sky=directions).run()
    without, with_sky = (load_field(tmp_path / f"{n}.rff") for n in (0, 2000))
    solid_angle = 4 * np.arcsin(24 * 16 / np.hypot(40, 24) / np.hypot(40, 16))
    in_view = 2000 * solid_angle / (4 * np.pi)
    assert len(with_sky.gaussians) - len(without.gaussians) == pytest.approx(in_view, rel=0.05)
    assert np.abs(with_sky.bounds.high_m).max() < 100


def test_a_start_larger_than_the_limit_is_refused(still, tmp_path):
    """The start includes the sky, which comes beside the points and is found in the pictures."""
    too_few = r"density\.limit: 310 Gaussians are fewer than the \d+ to start with, \d+ of them sky"
    with pytest.raises(InvalidInput, match=too_few):
        verb(still, tmp_path / "a.rff", iterations=1, gaussians=300, limit=310, sky=2000).run()
    with pytest.raises(InvalidInput, match=r"299 Gaussians are fewer than the 300 to start with:"):
        verb(still, tmp_path / "a.rff", iterations=1, gaussians=300, limit=299).run()
    verb(still, tmp_path / "a.rff", iterations=1, gaussians=300, limit=300).run()


def test_a_hash_grid_is_trained_by_the_same_loop(wall, tmp_path):
    dataset, held_out = split_every(read_dataset(wall), 4)
    model = NgpModel(L=4, log2_T=10, N_max=64, occupancy=4000)
    config = NgpTrainingConfig(iterations=4, batch_samples=4096, model=model)
    job = TrainingJob("wall", dataset, held_out, config, 1, LoopLimits(measurements=4))
    trained = train(job, Console(quiet=True))
    archive = tmp_path / "a.rff"
    save_field(trained.field, archive)
    said = training_result(job, trained, load_field(archive), archive)
    assert said["field"] == f"ngp {trained.field.field_id}"
    assert len(said["curve"]) == 4
    assert said["held_out"]["psnr_db"] == pytest.approx(said["curve"][-1][1], abs=1e-6)


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_points_may_come_from_depth_maps(wall, tmp_path, suffix):
    for i in range(3):  # not every picture needs one
        if suffix == ".npy":
            np.save(tmp_path / f"{i}.npy", np.full((32, 48), 4.0, np.float32))
        else:
            cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((32, 48), 4000, np.uint16))
    dataset, _ = read_views(Train(wall, tmp_path / "f.rff", depths=tmp_path))
    assert len(dataset.points.xyz_m) == 3 * 32 * 48
    # OpenCV axes of a camera that looks along -z of the world
    np.testing.assert_allclose(dataset.points.xyz_m[:, 2], -4.0, rtol=1e-6)


def test_bad_depth_maps_are_refused_by_name(wall, tmp_path):
    with pytest.raises(DatasetError, match="holds no depth map"):
        read_views(Train(wall, tmp_path / "f.rff", depths=tmp_path))
    for content in (np.zeros((5, 5), np.float32), np.zeros((32, 48, 3), np.float32)):
        np.save(tmp_path / "0.npy", content)
        with pytest.raises(DatasetError, match=r"0\.npy"):
            read_views(Train(wall, tmp_path / "f.rff", depths=tmp_path))
    (tmp_path / "0.npy").write_bytes(b"nonsense")
    with pytest.raises(DatasetError, match=r"0\.npy"):
        read_views(Train(wall, tmp_path / "f.rff", depths=tmp_path))


@pytest.mark.parametrize(
    ("pixels", "problem"),
    [
        (np.full((32, 48), 40, np.uint8), r"0\.png: uint8 pixels, a depth map has 16 bits"),
        (np.full((32, 48, 3), 4000, np.uint16), r"0\.png: not a readable depth map of one"),
        (None, r"0\.png: not a readable depth map"),
    ],
)
def test_a_picture_that_holds_no_depths_is_refused(wall, tmp_path, pixels, problem):
    data = b"nonsense" if pixels is None else cv2.imencode(".png", pixels)[1].tobytes()
    (tmp_path / "0.png").write_bytes(data)
    with pytest.raises(DatasetError, match=problem):
        read_views(Train(wall, tmp_path / "f.rff", depths=tmp_path))


def test_a_depth_map_is_read_in_millimetres(tmp_path):
    stored = np.random.default_rng(3).integers(0, 65536, (7, 9), dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "0.png"), stored)
    np.testing.assert_array_equal(
        read_depth_m(tmp_path / "0.png"), (stored / 1000).astype(np.float32)
    )


def test_declared_exposure_is_learned_and_nothing_else_is(wall, tmp_path):
    content = json.loads((wall / "transforms.json").read_text())
    results = {}
    for exposure in ("auto", "fixed"):
        file = wall / f"{exposure}.json"
        file.write_text(json.dumps({**content, "exposure": exposure}))
        result = tmp_path / f"{exposure}.json"
        verb(file, tmp_path / f"{exposure}.rff", iterations=5, json=str(result)).run()
        results[exposure] = json.loads(result.read_text())["settings"]["exposure"]
    assert results == {"auto": True, "fixed": False}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"out": Path("a.ply")}, "out"),
        ({"holdout": 1}, "holdout"),
        ({"holdout": 4, "held_out": Path("x")}, "holdout"),
        ({"views_percent": 0.0}, "views_percent"),
        ({"points": Path("x"), "depths": Path("x")}, "depths"),
        ({"sky": 100, "kind": "ngp"}, "sky: is of splats"),
        ({"size": "24"}, "size"),
        ({"size": "24x0"}, "size"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(wall, tmp_path, change, named):
    with pytest.raises(InvalidInput, match=named):
        verb(wall, **{"out": tmp_path / "a.rff", **change}).run()


def test_a_share_of_the_views_is_spread_evenly():
    views = tuple(range(120))
    assert share_of_views(views, 25) == tuple(range(0, 120, 4))
    assert share_of_views(views, 50) == tuple(range(0, 120, 2))
    assert share_of_views(views, 100) == views
    assert share_of_views(views, 0.1) == (0,)
