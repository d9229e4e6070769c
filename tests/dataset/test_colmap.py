"""COLMAP's camera models, and agreement of both encodings with COLMAP itself."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from rfcore.dataset import read_dataset
from rfcore.dataset.colmap import camera_of, read_binary_model, read_text_model
from rfcore.dataset.source import SourceCamera
from rfcore.errors import DatasetError

SIZE_PX = (640, 360)
PARAMETERS = {
    "SIMPLE_PINHOLE": [400.0, 322.0, 178.0],
    "PINHOLE": [400.0, 410.0, 322.0, 178.0],
    "SIMPLE_RADIAL": [400.0, 322.0, 178.0, -0.05],
    "RADIAL": [400.0, 322.0, 178.0, -0.05, 0.01],
    "OPENCV": [400.0, 410.0, 322.0, 178.0, -0.05, 0.01, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [400.0, 410.0, 322.0, 178.0, -0.02, 0.01, 1e-3, -2e-3],
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
