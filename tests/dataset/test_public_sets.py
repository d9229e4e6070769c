"""Public sets: a point lands where the set's own code projects it, and faults are one clear error.

``devkits/projections.json`` holds what the sets' own code says (``devkits/make_projections.py``).
"""

import json
import shlex
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import ipc

from rfcore.camera import Camera
from rfcore.dataset import nuscenes, read_dataset
from rfcore.dataset.read import read_source
from rfcore.errors import DatasetError
from rfcore.lens import LensCamera
from rfcore.motion import interpolated
from rfedge.cli import parse
from rfedge.video import write_mp4
from tests.dataset.conftest import GoldenScene
from tests.dataset.public_sets import (
    ecef_from_world,
    save,
    table,
    times_ns,
    write_argoverse,
    write_boreas,
    write_comma,
    write_nuscenes,
)

DEVKITS = Path(__file__).parent / "devkits"
PROJECTED = json.loads((DEVKITS / "projections.json").read_text())
LOG_123D = DEVKITS / "log_123d" / "nuscenes-mini_train" / "scene-0061"
GOLDEN = GoldenScene()
POINT_ECEF = (ecef_from_world() @ [*GOLDEN.POINT, 1.0])[:3].tolist()
Make = Callable[[Path], Path]
Fault = Callable[[Path], object]


def argoverse(root: Path) -> Path:
    return Path(f"{write_argoverse(GOLDEN, root)}#ring_front_center")


def scene(root: Path) -> Path:
    return Path(f"{write_nuscenes(GOLDEN, root)}#scene-0061/CAM_FRONT")


def comma(root: Path) -> Path:
    return write_comma(GOLDEN, root)


def boreas(root: Path) -> Path:
    return write_boreas(GOLDEN, root)


def log_123d(root: Path) -> Path:
    """A copy of the log that py123d wrote."""
    return Path(shutil.copytree(LOG_123D, root / "log")).with_name("log#pcam_f0")


@pytest.mark.parametrize(
    ("make", "point", "expected", "within_px"),
    [
        (argoverse, GOLDEN.POINT, PROJECTED["argoverse"], 1e-6),
        (scene, GOLDEN.POINT, PROJECTED["nuscenes"], 1e-6),
        (boreas, GOLDEN.POINT, PROJECTED["boreas"], 1e-6),
        (log_123d, GOLDEN.POINT, PROJECTED["123d"]["CAM_FRONT"], 1e-6),
        (
            lambda root: log_123d(root).with_name("log#pcam_b0"),
            GOLDEN.POINT,
            PROJECTED["123d"]["CAM_BACK"],
            1e-6,
        ),
        # ECEF's float64 resolves 1e-9 m, 1e-7 px here.
        (comma, POINT_ECEF, PROJECTED["comma2k19"], 1e-5),
    ],
    ids=["argoverse", "nuscenes", "boreas", "123d", "123d-lens-and-vehicle-poses", "comma2k19"],
)
def test_a_point_lands_where_the_sets_own_code_projects_it(
    make, point, expected, within_px, tmp_path
):
    source = read_source(make(tmp_path))
    assert len(source.pictures) == 3
    for picture, pixel in zip(source.pictures, expected, strict=True):
        k, lens = picture.camera.intrinsics, picture.camera.lens
        camera = (
            LensCamera(k, lens, picture.world_from_cam)
            if lens is not None
            else Camera(k, picture.world_from_cam)
        )
        assert camera.project(point)[:2] == pytest.approx(pixel, abs=within_px)
        assert picture.read().shape == (k.height_px, k.width_px, 3)


@pytest.mark.parametrize("make", [argoverse, scene, boreas, log_123d])
def test_times_are_those_of_capture(make, tmp_path):
    assert [p.time_ns for p in read_source(make(tmp_path)).pictures] == times_ns(GOLDEN)


def test_a_segment_of_comma2k19_knows_where_it_is_and_has_its_fixes(tmp_path):
    source = read_source(comma(tmp_path))
    assert [round(p.read().mean()) for p in source.pictures] == pytest.approx([40, 80, 120], abs=3)
    assert [p.time_ns for p in source.pictures] == [100_000_000_000 + i * 10**8 for i in range(3)]
    assert source.anchor.latitude_deg == pytest.approx(37.721, abs=1e-4)
    assert source.anchor.longitude_deg == pytest.approx(-122.4723, abs=1e-4)
    up = source.anchor.world_from_geodetic(*source.anchor.geodetic_from_world(POINT_ECEF))
    assert up == pytest.approx(POINT_ECEF, abs=1e-6)
    _, fix = map(json.loads, source.feeds["live_gnss_ublox"])
    assert fix == {
        "time_s": 100.15, "latitude_deg": 37.721, "longitude_deg": -122.4723, "height_m": 31.6,
    }  # fmt: skip


def test_several_cameras_are_listed_and_the_next_commands_work(tmp_path, capsys):
    log = write_argoverse(GOLDEN, tmp_path)
    with pytest.raises(DatasetError, match=r"several cameras \(ring_front_center, ring_rear"):
        read_dataset(log)
    words = ["doctor", str(log)]
    said = ""
    for begin in ("rfedge doctor ", "rfedge train "):
        parse(words).run()
        said = capsys.readouterr().out
        assert f"next: {begin}" in said
        words = shlex.split(said.splitlines()[-1].removeprefix("next: rfedge "))
    assert "world: Argoverse's city" in said
    assert "k1 to k3 are left out" in said
    parse(["dataset", "convert", words[1], "--out", str(tmp_path / "out")]).run()
    assert "3 pictures" in capsys.readouterr().out
    assert len(read_dataset(tmp_path / "out").pictures) == 3


def test_scenes_are_listed_with_their_cameras(tmp_path, capsys):
    parse(["doctor", str(write_nuscenes(GOLDEN, tmp_path))]).run()
    said = capsys.readouterr().out
    assert "4 cameras" in said
    assert "scene-0062: CAM_BACK CAM_FRONT" in said


def keep_poses(log: Path, rows: list[int]) -> None:
    file = log / "city_SE3_egovehicle.feather"
    with ipc.open_file(file.read_bytes()) as content:
        kept = content.read_all().take(pa.array(rows, pa.int64())).to_pydict()
    table(file, **kept)


def test_between_two_poses_they_are_interpolated_and_outside_pictures_are_left_out(tmp_path):
    log = write_argoverse(GOLDEN, tmp_path)
    path = Path(f"{log}#ring_front_center")
    first, middle, last = (p.world_from_cam for p in read_source(path).pictures)
    keep_poses(log, [0, 2])
    source = read_source(path)
    found = source.pictures[1].world_from_cam
    assert "poses of 1 of 3 pictures are interpolated in time" in source.notes
    # The camera is off the vehicle's axis: halfway differs from the camera's own by centimetres.
    halfway = interpolated(first, last, 0.5)
    assert np.allclose(found.rotation, halfway.rotation, atol=1e-9)
    assert np.allclose(found.translation_m, halfway.translation_m, atol=0.05)
    assert found.translation_m != middle.translation_m
    keep_poses(log, [0])
    source = read_source(path)
    assert len(source.pictures) == 1
    assert "2 of 3 pictures, from " in source.notes[-1]
    assert source.notes[-1].endswith(": left out")


def test_pictures_that_were_not_loaded_are_left_out(tmp_path):
    path = scene(tmp_path)
    next((tmp_path / "samples" / "CAM_FRONT").glob("*")).unlink()
    source = read_source(path)
    assert len(source.pictures) == 2
    assert "1 of 3 pictures of CAM_FRONT are listed but not there: left out" in source.notes
    drive = boreas(tmp_path)
    next((drive / "camera").glob("*")).unlink()
    assert "1 lines of camera_poses.csv have no picture: left out" in read_source(drive).notes


def test_two_drives_of_boreas_share_a_world(tmp_path):
    names = ("boreas-2020-11-26-13-58", "boreas-2021-01-26-11-22")
    first, second = (read_source(write_boreas(GOLDEN, tmp_path, name)) for name in names)
    for one, other in zip(first.pictures, second.pictures, strict=True):
        assert one.world_from_cam == other.world_from_cam


@pytest.mark.parametrize("chunk", [1, 7, 64, 1 << 20])
def test_rows_are_the_same_wherever_a_chunk_ends(chunk, tmp_path, monkeypatch):
    rows = [{"token": "a", "rotation": [1.5, -2e-3, 0, 0]}, {"token": "}],ü"}, {}]
    monkeypatch.setattr(nuscenes, "CHUNK", chunk)
    for text in (json.dumps(rows, indent=0, ensure_ascii=False), json.dumps(rows)):
        (tmp_path / "a.json").write_text(text)
        assert list(nuscenes.json_rows(tmp_path / "a.json")) == rows


def replaced(log: Path, values: pa.Array) -> None:
    """Put other data into the pictures of 123D's first camera."""
    file = log / "camera.pcam_f0.arrow"
    with ipc.open_file(file.read_bytes()) as content:
        old = content.read_all()
    at = old.schema.get_field_index("camera.pcam_f0.data")
    new = old.set_column(at, old.schema.names[at], values)
    with ipc.new_file(str(file), new.schema) as out:
        out.write_table(new)


def test_pictures_of_123d_may_be_frames_or_paths(tmp_path):
    path = log_123d(tmp_path)
    log = tmp_path / "log"
    stills = [picture.read() for picture in read_source(path).pictures]
    write_mp4(log / "camera.pcam_f0.mp4", iter(stills), 10.0)
    replaced(log, pa.array([2, 0, 1], pa.int32()))
    frames = [picture.read().astype(float) for picture in read_source(path).pictures]
    for number, frame in zip((2, 0, 1), frames, strict=True):
        errors = [np.abs(frame - still).mean() for still in stills]
        assert int(np.argmin(errors)) == number
    names = GOLDEN._pictures(tmp_path / "samples")
    replaced(log, pa.array([f"samples/{name}" for name in names]))
    for picture, still in zip(read_source(path).pictures, stills, strict=True):
        assert np.array_equal(picture.read(), still)
    replaced(log, pa.array(["samples/none.png"] * 3))
    with pytest.raises(DatasetError, match="neither beside the log nor above it"):
        read_source(path)


def edit(name: str, before: str, after: str) -> Fault:
    def fault(folder: Path) -> None:
        file = folder / name
        assert before in file.read_text()
        file.write_text(file.read_text().replace(before, after))

    return fault


def emptied(name: str) -> Fault:
    return lambda folder: (folder / name).write_bytes(b"")


def gone(name: str) -> Fault:
    return lambda folder: (folder / name).unlink()


V = "v1.0-mini"
A = "applanix/camera_poses.csv"
FRONT = "sensors/cameras/ring_front_center"
FAULTS: list[tuple[Make, str, Fault, str]] = [
    (argoverse, "no", lambda _: None, r"has no 'no'; its cameras: ring_front_center, ring_rear"),
    (argoverse, "", lambda f: shutil.rmtree(f / "sensors"), "has no camera; its cameras: none"),
    (argoverse, "ring_front_center", gone("calibration/intrinsics.feather"), "does not exist"),
    (
        argoverse,
        "ring_front_center",
        lambda f: table(f / "calibration" / "intrinsics.feather", sensor_name=["a"]),
        r"has no column fx_px, .*; it has sensor_name",
    ),
    (
        argoverse,
        "stereo",
        lambda f: (f / "sensors" / "cameras" / "stereo").mkdir(),
        "has no sensor 'stereo'; it has ring_front_center, ring_rear_left",
    ),
    (
        argoverse,
        "ring_front_center",
        lambda f: [p.unlink() for p in (f / FRONT).glob("*")],
        "holds no pictures",
    ),
    (
        argoverse,
        "ring_front_center",
        lambda f: next((f / FRONT).glob("*")).rename(f / FRONT / "a.jpg"),
        "is not named by its time",
    ),
    (argoverse, "ring_front_center", lambda f: keep_poses(f, []), "poses at no time; take"),
    (argoverse, "ring_front_center", emptied("city_SE3_egovehicle.feather"), "no whole Arrow"),
    (scene, "scene-0099", lambda _: None, r"no 'scene-0099'; its cameras: scene-0061/CAM_BACK,"),
    (scene, "scene-0061", lambda _: None, r"several cameras \(scene-0061/CAM_BACK, scene-0061/"),
    (scene, "scene-0061/CAM_BACK", lambda _: None, "no pictures of CAM_BACK; it has CAM_FRONT"),
    (scene, "scene-0061/CAM_FRONT", gone(f"{V}/ego_pose.json"), "ego_pose.json: cannot be read"),
    (scene, "scene-0061/CAM_FRONT", edit(f"{V}/ego_pose.json", "]\n}\n]", "]\n}"), "is cut"),
    (scene, "scene-0061/CAM_FRONT", emptied(f"{V}/sample.json"), "sample.json: is no list"),
    (
        scene,
        "scene-0061/CAM_FRONT",
        edit(f"{V}/calibrated_sensor.json", '"front-on-car"', '"x"'),
        "sample_data.json: row 0: key 'calibrated_sensor_token' is in no row",
    ),
    (
        scene,
        "scene-0061/CAM_FRONT",
        edit(f"{V}/sample_data.json", '"timestamp": 1532', '"timestamp": 2532'),
        r"3 of 3 pictures.*no pose of the vehicle within 1 s; ego_pose.json has poses from 1532",
    ),
    (scene, "scene-0061/CAM_FRONT", lambda f: shutil.rmtree(f / "samples"), "none of the 3 pict"),
    (comma, "video", gone("video.hevc"), r"video\.hevc: not a readable video"),
    (comma, "", gone("global_pose/frame_times"), "frame_times: cannot be read"),
    (comma, "", emptied("global_pose/frame_times"), "is no array of numpy"),
    (
        comma,
        "",
        lambda f: save(f / "global_pose" / "frame_orientations", np.ones((2, 4))),
        "has 2 rows, the positions have 3",
    ),
    (
        comma,
        "",
        lambda f: save(f / "global_pose" / "frame_positions", np.full((3, 3), np.nan)),
        "row 0 is not finite",
    ),
    (boreas, "", edit(A, "heading", "yaw"), "line 1: has no column heading"),
    (boreas, "", edit(A, "1532403027", "2532403027"), "none of its 3 poses is of one of the 3 pi"),
    (boreas, "", edit("calib/P_camera.txt", "50.0 0 32.0", "50.0 1 32.0"), "not the matrix of a p"),
    (boreas, "", gone("calib/P_camera.txt"), "P_camera.txt: cannot be read"),
    (log_123d, "pcam_l0", lambda _: None, "has no 'pcam_l0'; its cameras: pcam_b0, pcam_f0"),
    (log_123d, "pcam_b0", gone("ego_state_se3.arrow"), "ego_state_se3.arrow: cannot be read"),
    (
        log_123d,
        "pcam_f0",
        lambda f: table(f / "camera.pcam_f0.arrow", a=[1]),
        "was not written by 123D",
    ),
]


@pytest.mark.parametrize(("make", "choice", "fault", "problem"), FAULTS)
def test_a_fault_is_one_clear_error(make, choice, fault, problem, tmp_path):
    folder = Path(str(make(tmp_path)).partition("#")[0])
    fault(folder)
    with pytest.raises(DatasetError, match=problem) as refused:
        read_dataset(Path(f"{folder}#{choice}") if choice else folder, distortion="undistort")
    assert "\n" not in str(refused.value)


def test_a_name_is_refused_where_there_is_nothing_to_choose(golden, tmp_path):
    folder = golden.write("kitti", tmp_path)
    with pytest.raises(DatasetError, match="is read as a whole; leave out #image_2"):
        read_dataset(Path(f"{folder}#image_2"))


def test_a_folder_with_several_sets_is_ambiguous(tmp_path):
    path = write_nuscenes(GOLDEN, tmp_path)
    shutil.copytree(path / V, path / "v1.0-trainval")
    with pytest.raises(DatasetError, match=r"several datasets, name one of them: .*v1\.0-mini"):
        read_dataset(path)
    one = Path(f"{path / V / 'sample_data.json'}#scene-0061/CAM_FRONT")
    times = [picture.time_ns for picture in read_dataset(one).pictures]
    assert all(before < after for before, after in pairwise(times))
