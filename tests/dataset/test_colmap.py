"""COLMAP's camera models, and agreement of both encodings with COLMAP itself."""

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from rfcore.dataset import read_dataset
from rfcore.dataset.colmap import (
    camera_of,
    camera_parameters,
    parameter_count,
    read_binary_model,
    read_text_model,
)
from rfcore.dataset.keys import LENS_MODELS
from rfcore.dataset.source import SourceCamera
from rfcore.errors import DatasetError
from rfcore.image import write_png

SIZE_PX = (640, 360)
PARAMETERS = {
    "SIMPLE_PINHOLE": [400.0, 322.0, 178.0],
    "PINHOLE": [400.0, 410.0, 322.0, 178.0],
    "SIMPLE_RADIAL": [400.0, 322.0, 178.0, -0.05],
    "RADIAL": [400.0, 322.0, 178.0, -0.05, 0.01],
    "OPENCV": [400.0, 410.0, 322.0, 178.0, -0.05, 0.01, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [400.0, 410.0, 322.0, 178.0, -0.02, 0.01, 1e-3, -2e-3],
    "FULL_OPENCV": [400.0, 410.0, 322.0, 178.0, -0.05, 0.01, 1e-3, -2e-3, 3e-3, 0.2, -0.03, 5e-3],
    "SIMPLE_RADIAL_FISHEYE": [400.0, 322.0, 178.0, -0.02],
    "RADIAL_FISHEYE": [400.0, 322.0, 178.0, -0.02, 0.01],
    "SIMPLE_FISHEYE": [400.0, 322.0, 178.0],
    "FISHEYE": [400.0, 410.0, 322.0, 178.0],
    "THIN_PRISM_FISHEYE": [400.0, 410.0, 322.0, 178.0, -0.02, 0.01, 0, 0, 1e-3, -2e-3, 0, 0],
    "RAD_TAN_THIN_PRISM_FISHEYE": [400.0, 410.0, 322.0, 178.0, *[0.0] * 12],
    "FOV": [400.0, 410.0, 322.0, 178.0, 0.0],
    "SIMPLE_DIVISION": [400.0, 322.0, 178.0, 0.0],
    "DIVISION": [400.0, 410.0, 322.0, 178.0, 0.0],
}


@pytest.mark.parametrize("model", PARAMETERS)
def test_a_camera_projects_as_colmaps_does(model):
    ours = camera_of("x", model, SIZE_PX, PARAMETERS[model])
    theirs = pycolmap.Camera(
        model=model, width=SIZE_PX[0], height=SIZE_PX[1], params=PARAMETERS[model]
    )
    rays = np.random.default_rng(4).uniform(-0.6, 0.6, (40, 2))
    points = np.concatenate([rays, np.ones((40, 1))], axis=1)
    np.testing.assert_allclose(projected(ours, rays), theirs.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize("model", PARAMETERS)
def test_what_is_handed_back_to_colmap_is_the_same_camera(model):
    camera = camera_of("x", model, SIZE_PX, PARAMETERS[model])
    name, parameters = camera_parameters(camera)
    assert camera_of("x", name, SIZE_PX, parameters) == camera


def test_the_table_of_models_is_colmaps():
    theirs = {
        int(number): (name, len(pycolmap.Camera.create_from_model_id(1, number, 9.0, 9, 9).params))
        for name, number in pycolmap.CameraModelId.__members__.items()
        if int(number) >= 0
    }
    ours = {model.number: (name, parameter_count("x", name)) for name, model in LENS_MODELS.items()}
    assert ours == theirs


@pytest.mark.parametrize(
    ("model", "lens", "named"),
    [
        ("THIN_PRISM_FISHEYE", [0, 0, 0.1, 0, 0, 0, 0, 0.2], "p1 = 0.1, sy1 = 0.2"),
        ("FOV", [0.9], "omega = 0.9"),
        ("EUCM", [0.5, 1.0], "alpha = 0.5, beta = 1"),
        ("DIVISION", [-0.1], "k = -0.1"),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [0.1] + [0] * 11, "k0 = 0.1"),
    ],
)
def test_a_lens_that_is_not_read_is_named(model, lens, named):
    with pytest.raises(DatasetError, match=rf"{named}.* is not read"):
        camera_of("x", model, SIZE_PX, [400.0, 410.0, 322.0, 178.0, *lens])
    with pytest.raises(DatasetError, match="EQUIRECTANGULAR is not read"):
        camera_of("x", "EQUIRECTANGULAR", SIZE_PX, [640, 360])


def test_the_command_for_a_lens_that_is_not_read_leads_to_a_dataset(tmp_path):
    """``pycolmap.undistort_images`` is what ``colmap image_undistorter`` runs."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.camera_width, options.camera_height = 20, 64, 48
    options.camera_model_id = pycolmap.CameraModelId.THIN_PRISM_FISHEYE
    options.camera_params = [50.0, 50, 32, 24, 0.01, 0, 0, 0, 0, 0, 0.001, 0]
    pycolmap.set_random_seed(3)
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path / "a b"
    for path in (folder / "images", folder / "sparse" / "0"):
        path.mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    for image in model.images.values():
        write_png(folder / "images" / image.name, np.full((48, 64, 3), 90, np.uint8))
    with pytest.raises(DatasetError, match=r"camera 0: lens .*THIN_PRISM_FISHEYE") as refused:
        read_dataset(folder)
    words = shlex.split(str(refused.value).partition("undistort them: ")[2])
    assert words[:2] == ["colmap", "image_undistorter"]
    given = dict(zip(words[2::2], words[3::2], strict=True))
    assert given.keys() == {"--image_path", "--input_path", "--output_path"}
    out = tmp_path / given["--output_path"]
    pycolmap.undistort_images(out, given["--input_path"], given["--image_path"])
    assert len(read_dataset(out).pictures) == len(model.images)


@pytest.mark.parametrize("form", ["colmap_text", "colmap_binary"])
def test_the_model_with_most_pictures_is_read_and_the_others_are_said(golden, tmp_path, form):
    folder = golden.write(form, tmp_path)
    sparse = folder / "sparse"
    shutil.copytree(sparse / "0", sparse / "1")
    name = "images.txt" if form == "colmap_text" else "images.bin"
    content = (sparse / "0" / name).read_bytes()
    if form == "colmap_text":
        lines = content.decode().splitlines()
        first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        few = "\n".join(lines[: first + 2]).encode()
    else:
        few = (1).to_bytes(8, "little") + content[8:]
    (sparse / "0" / name).write_bytes(few)
    dataset = read_dataset(folder)
    assert len(dataset.pictures) == 3
    (said,) = dataset.changes
    assert re.search(r"sparse/1 is read, of 3 pictures; not read: \S*sparse/0 of 1", said)
    named = read_dataset(sparse / "0" / name)
    assert (len(named.pictures), named.changes) == (1, ())


@pytest.mark.parametrize("folder", ["images", "input", "images_2"])
@pytest.mark.parametrize("is_named", [False, True])
def test_pictures_are_found_in_the_folders_that_people_have(golden, tmp_path, folder, is_named):
    root = golden.write("colmap_text", tmp_path)
    (root / "images").rename(root / folder)
    if is_named:
        file = root / "sparse" / "0" / "images.txt"
        file.write_text(re.sub(r" 7 ", f" 7 {folder}/", file.read_text()))
    dataset = read_dataset(root)
    assert (dataset.pictures[0].read() == 90).any()
    said = [] if folder == "images" and not is_named else [f"pictures are taken from {root}"]
    assert [change[: len(said[0])] for change in dataset.changes] == said


def test_the_model_of_distorted_pictures_takes_those_of_input(golden, tmp_path):
    """INRIA's convert.py leaves ``input``, ``distorted/sparse/0`` and, undistorted, ``images``."""
    root = golden.write("colmap_text", tmp_path)
    (root / "images").rename(root / "input")
    (root / "images").mkdir()
    shutil.copytree(root / "sparse", root / "distorted" / "sparse")
    assert (read_dataset(root / "distorted").pictures[0].read() == 90).any()


def projected(camera: SourceCamera, rays: np.ndarray) -> np.ndarray:
    k = camera.intrinsics
    sensor = rays if camera.lens is None else camera.lens.distort(rays)
    return sensor * (k.fx_px, k.fy_px) + (k.cx_px, k.cy_px)


def test_both_encodings_say_the_same_of_a_model_colmap_wrote(tmp_path):
    model = synthetic(tmp_path)
    binary, text = read_binary_model(tmp_path / "bin"), read_text_model(tmp_path / "txt")
    assert binary.cameras == text.cameras
    assert len(binary.images) == len(model.images) > 3
    for a, b in zip(by_name(binary.images), by_name(text.images), strict=True):
        assert (a.name, a.camera_id) == (b.name, b.camera_id)
        assert a.cam_from_world.translation_m == pytest.approx(b.cam_from_world.translation_m)
        theirs = model.find_image_with_name(a.name).cam_from_world().matrix()
        np.testing.assert_allclose(a.cam_from_world.rotation_matrix(), theirs[:, :3], atol=1e-12)
        np.testing.assert_allclose(a.cam_from_world.translation_m, theirs[:, 3], atol=1e-12)
    assert len(binary.points.xyz_m) == len(model.points3D) > 10
    np.testing.assert_array_equal(ordered(binary.points.xyz_m), ordered(text.points.xyz_m))


def synthetic(folder: Path) -> Any:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 20
    pycolmap.set_random_seed(3)
    model = pycolmap.synthesize_dataset(options)
    for name in ("bin", "txt"):
        (folder / name).mkdir()
    model.write_binary(folder / "bin")
    model.write_text(folder / "txt")
    return model


def by_name(images: Any) -> list[Any]:
    return sorted(images, key=lambda image: image.name)


def ordered(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("cut", [4, 20, 60, 100])
def test_a_binary_file_cut_short_is_refused(golden, tmp_path, cut):
    folder = golden.write("colmap_binary", tmp_path)
    file = folder / "sparse" / "0" / "images.bin"
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(DatasetError, match=r"images\.bin: byte \d+: "):
        read_dataset(folder)


def test_a_count_that_the_file_cannot_hold_is_refused(golden, tmp_path):
    folder = golden.write("colmap_binary", tmp_path)
    file = folder / "sparse" / "0" / "points3D.bin"
    file.write_bytes((2**60).to_bytes(8, "little") + file.read_bytes()[8:])
    with pytest.raises(DatasetError, match=r"points3D\.bin: byte \d+: 51 bytes needed"):
        read_dataset(folder)
