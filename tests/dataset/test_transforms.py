"""Reading transforms.json: golden pixels, defaults of the format, and refusals by name."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.camera import TileOrigin
from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError, InvalidInput
from rfcore.field.ply_table import write_vertices
from rfcore.image import write_png

Content = dict[str, Any]


def test_a_rotated_camera_keeps_its_place_and_turns_its_axes(write, content):
    """Yaw by 90 degrees about z-up: a camera at (5, 6, 7) that looks along world +x."""
    content["frames"][0]["transform_matrix"] = [
        [0, 0, -1, 5],
        [-1, 0, 0, 6],
        [0, 1, 0, 7],
        [0, 0, 0, 1],
    ]
    camera = read_dataset(write(content)).pictures[0].camera
    assert camera.world_from_cam.translation_m == (5, 6, 7)
    assert camera.project((15, 6, 7)) == pytest.approx((4, 3, 10)), "straight ahead"
    assert camera.project((15, 5, 7)) == pytest.approx((5, 3, 10)), "world -y is to the right"
    assert camera.project((15, 6, 8)) == pytest.approx((4, 1.8, 10)), "world z is up"


def test_pixels_times_rate_and_points_come_with_it(write, content):
    dataset = read_dataset(write(content))
    assert [picture.name for picture in dataset.pictures] == ["a.png", "b.png"]
    assert [picture.time_ns for picture in dataset.pictures] == [0, 100_000_000]
    assert dataset.rate_hz == pytest.approx(10.0)
    assert (dataset.pictures[1].read() == 20).all()
    np.testing.assert_array_equal(dataset.points.xyz_m, [[0, 0, 1], [4, 5, 6], [0.5, 0, -1]])
    np.testing.assert_array_equal(dataset.points.rgb, [[1, 2, 3], [7, 8, 9], [255, 0, 0]])


def test_a_directory_stands_for_its_transforms_file(write, content):
    assert len(read_dataset(write(content).parent).pictures) == 2
    named = write(content, "transforms_drive.json")
    assert len(read_dataset(named.parent).pictures) == 2, "transforms.json goes first"


def test_a_directory_with_several_drives_asks_which(write, content):
    write(content, "transforms_one.json")
    directory = write(content, "transforms_two.json").parent
    with pytest.raises(DatasetError, match=r"transforms_one\.json, transforms_two\.json"):
        read_dataset(directory)


def test_a_frame_may_override_the_intrinsics(write, content):
    content["frames"][1] |= {"fl_x": 20.0, "cx": 1.5}
    first, second = (p.camera.intrinsics for p in read_dataset(write(content)).pictures)
    assert (first.fx_px, first.cx_px) == (10.0, 4.0)
    assert (second.fx_px, second.cx_px, second.fy_px) == (20.0, 1.5, 12.0)


def test_a_field_of_view_stands_for_the_focal_length(write, content):
    for key in ("fl_x", "fl_y", "cx", "cy"):
        del content[key]
    content["camera_angle_x"] = math.pi / 2
    k = read_dataset(write(content)).pictures[0].camera.intrinsics
    assert (k.fx_px, k.cx_px, k.cy_px) == (pytest.approx(4.0), 4.0, 3.0)
    assert k.fy_px == k.fx_px


def test_pictures_without_times_have_no_rate(write, content):
    del content["frames"][0]["time"]
    assert read_dataset(write(content)).rate_hz is None


def test_the_tile_origin_is_taken_off_poses_and_points(write, content):
    content["frames"][0]["transform_matrix"][0][3] = 691_608.125
    content["frames"][1]["transform_matrix"][0][3] = 691_609.125
    origin = TileOrigin(east_m=691_608.0)
    dataset = read_dataset(write(content), tile_origin=origin)
    assert dataset.tile_origin == origin
    assert dataset.pictures[0].camera.world_from_cam.translation_m == (0.125, 0, 0)
    assert dataset.points.xyz_m[1, 0] == np.float32(4.0 - 691_608.0)


def frame_change(key: str, value: object) -> Callable[[Content], None]:
    def change(content: Content) -> None:
        content["frames"][1][key] = value

    return change


def top_change(key: str, value: object) -> Callable[[Content], None]:
    def change(content: Content) -> None:
        content[key] = value

    return change


def without(key: str) -> Callable[[Content], None]:
    return lambda content: content.pop(key)


MIRRORED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
FAR = [[1, 0, 0, 7e5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (without("frames"), "'frames'"),
        (top_change("frames", []), "'frames'"),
        (without("fl_x"), "key 'fl_x' is missing"),
        (top_change("h", 6.5), "'h' is 6.5"),
        (top_change("w", 0), "intrinsics.width_px: 0 px"),
        (top_change("fl_x", "wide"), "'fl_x' is 'wide', not a number"),
        (top_change("cx", math.nan), "'cx' is nan"),
        (top_change("k4", 0.01), "distortion k4 = 0.01 of camera_model OPENCV is not read"),
        (top_change("ftheta_p0", 0.01), "'ftheta_p0' names a lens that is not read"),
        (top_change("k1", 0.01), "lens distortion BrownLens.*k1=0.01.*undistort"),
        (top_change("is_fisheye", True), "lens distortion FisheyeLens.*undistort"),
        (top_change("applied_scale", 0), "'applied_scale' is 0"),
        (top_change("applied_transform", [[1]]), "'applied_transform' is .*, not 3x4 or 4x4"),
        (frame_change("file_path", 3), r"frames\[1\]: key 'file_path'"),
        (frame_change("time", -1.0), "'time' is -1.0"),
        (frame_change("transform_matrix", MIRRORED), "left-handed"),
        (
            frame_change("transform_matrix", FAR),
            "350000 m from the tile's origin.*of another place",
        ),
        (top_change("ply_file_path", "../points.ply"), "points.ply' leaves the dataset"),
    ],
)
def test_what_is_wrong_is_named(write, content, change, named):
    change(content)
    with pytest.raises(DatasetError, match=named) as caught:
        read_dataset(write(content))
    assert "transforms.json" in str(caught.value) or "absent.ply" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_distortion_of_zero_is_no_distortion(write, content):
    content |= {"k1": 0.0, "k2": 0, "p1": 0.0}
    assert len(read_dataset(write(content)).pictures) == 2


@pytest.mark.parametrize("text", ["", "{", "[]", "3"])
def test_a_file_that_is_no_transforms_file_is_refused(tmp_path, text):
    file = tmp_path / "transforms.json"
    file.write_text(text)
    with pytest.raises(DatasetError, match=r"transforms.json"):
        read_dataset(file)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="cannot be read"):
        read_dataset(tmp_path / "transforms_x.json")


def test_a_blurred_picture_that_was_sorted_out_is_left_out(write, content):
    """instant-ngp's colmap2nerf writes ``sharpness`` so that blurred pictures can be deleted."""
    content["frames"][0]["file_path"] = "gone.png"
    file = write(content)
    with pytest.raises(DatasetError, match=r"gone\.png is missing"):
        read_dataset(file)
    content["frames"][0]["sharpness"] = 3.5
    dataset = read_dataset(write(content))
    assert [picture.name for picture in dataset.pictures] == ["b.png"]
    assert dataset.sorted_out == 1


def test_what_was_applied_to_the_world_is_undone(write, content):
    """nerfstudio turns COLMAP's world (x, y, z) to (x, z, -y); here it is also scaled by 2."""
    plain = read_dataset(write(content))
    turn = np.array([[1, 0, 0, 0.5], [0, 0, 1, -1], [0, -1, 0, 2], [0, 0, 0, 1]], float)
    content |= {"applied_transform": turn[:3].tolist(), "applied_scale": 2.0}
    for frame in content["frames"]:
        matrix = turn @ np.array(frame["transform_matrix"])
        matrix[:3, 3] *= 2.0
        frame["transform_matrix"] = matrix.tolist()
    file = write(content)
    turned = plain.points.xyz_m @ turn[:3, :3].T.astype(np.float32) + turn[:3, 3]
    write_points(file.parent / "points.ply", 2 * turned, plain.points.rgb)
    undone = read_dataset(file)
    for picture, expected in zip(undone.pictures, plain.pictures, strict=True):
        assert picture.camera.project((1, 1, -4)) == pytest.approx(
            expected.camera.project((1, 1, -4))
        )
    np.testing.assert_allclose(undone.points.xyz_m, plain.points.xyz_m, atol=1e-6)


def write_points(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    columns = [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = [(*p, *c) for p, c in zip(xyz.tolist(), rgb.tolist(), strict=True)]
    write_vertices(path, np.array(rows, columns))


def test_a_lens_is_taken_out_only_when_that_is_chosen(write, content):
    content["frames"][1]["k1"] = 0.05
    file = write(content)
    with pytest.raises(DatasetError, match=r"frames\[1\].*undistorted"):
        read_dataset(file)
    dataset = read_dataset(file, distortion="undistort")
    plain, lens = (picture.camera.intrinsics for picture in dataset.pictures)
    assert dataset.changes == ("1 of 2 pictures are undistorted",)
    assert plain.fx_px == 10.0
    assert lens.fx_px > 10.0, "the corners reach outside the picture at the same focal length"
    assert (dataset.pictures[1].read() == 20).all()


def test_a_size_of_another_shape_crops_and_points_stay_where_they_are(write, content):
    """A square pixel stays square: nothing is squashed."""
    dataset = read_dataset(write(content), size_px=(4, 2))
    (picture, *_), whole = dataset.pictures, read_dataset(write(content)).pictures[0]
    assert picture.read().shape == (2, 4, 3)
    u, v, _ = whole.camera.project((1, 1, -4))
    assert picture.camera.project((1, 1, -4))[:2] == pytest.approx((u / 2, (v - 1) / 2))
    k, own = picture.camera.intrinsics, whole.camera.intrinsics
    assert k.fx_px / k.fy_px == own.fx_px / own.fy_px
    (said,) = dataset.changes
    assert "2 of 2 pictures are cropped from 8x6 to 8x4 px, 67%" in said


def test_a_smaller_size_scales_pictures_and_cameras_alike(write, content):
    picture = read_dataset(write(content), size_px=(4, 3)).pictures[0]
    assert picture.read().shape == (3, 4, 3)
    assert picture.camera.project((1, 1, -4)) == pytest.approx((3.25, 0, 4))
    with pytest.raises(InvalidInput, match=r"8x6, the size of .*a\.png"):
        read_dataset(write(content), size_px=(16, 12))


NULLS = {"k1": None, "fl_y": None, "h": None, "ply_file_path": None, "applied_scale": None}


def test_a_key_of_null_is_absent(write, content):
    plain = read_dataset(write(content))
    for key in NULLS:
        content.pop(key, None)
    without = read_dataset(write(content)).pictures[0].camera
    content |= NULLS | {"exposure": None, "anchor": None, "camera_model": None, "k4": None}
    content["frames"][0] |= {"mask_path": None, "time": None, "fl_x": None, "sharpness": None}
    dataset = read_dataset(write(content))
    assert (len(dataset.pictures), dataset.points) == (len(plain.pictures), None)
    assert dataset.pictures[0].camera == without
    content["frames"][0]["transform_matrix"] = None
    with pytest.raises(DatasetError, match=r"frames\[0\] .*key 'transform_matrix' is missing"):
        read_dataset(write(content))


@pytest.mark.parametrize("keys", [{"x_fov": 90}, {"camera_angle_x": math.pi / 2, "x_fov": 80}])
def test_a_field_of_view_may_be_in_degrees(write, content, keys):
    for key in ("fl_x", "fl_y"):
        content.pop(key, None)
    k = read_dataset(write(content | keys)).pictures[0].camera.intrinsics
    assert (k.fx_px, k.fy_px) == pytest.approx((4, 4))
    k = read_dataset(write(content | keys | {"y_fov": 90})).pictures[0].camera.intrinsics
    assert (k.fx_px, k.fy_px) == pytest.approx((4, 3))
    with pytest.raises(DatasetError, match=r"'x_fov' is 3\.14159 rad, outside"):
        read_dataset(write(content | {"x_fov": 180}))


def test_mitsubas_cameras_look_along_their_z_axis(write, content):
    """x is left and y up there: the same camera, turned half round y."""
    plain = read_dataset(write(content)).pictures[1].camera
    half_round = np.diag([-1.0, 1, -1, 1])
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ half_round).tolist()
    turned = read_dataset(write(content | {"from_mitsuba": True})).pictures[1].camera
    assert turned.project((1, 1, -4)) == pytest.approx(plain.project((1, 1, -4)))


@pytest.mark.parametrize("scale", [(4, 3), (16, 12), (24, 18)])
def test_a_camera_is_scaled_to_copies_of_its_pictures(write, content, scale):
    file = write(content)
    expected = read_dataset(file).pictures[0].camera.project((1, 1, -4))
    write_png(file.parent / "a.png", np.full((scale[1], scale[0], 3), 10, np.uint8))
    dataset = read_dataset(file)
    u, v, _ = dataset.pictures[0].camera.project((1, 1, -4))
    assert (u / scale[0], v / scale[1]) == pytest.approx((expected[0] / 8, expected[1] / 6))
    assert dataset.pictures[0].read().shape == (*scale[::-1], 3)
    assert dataset.changes == (
        f"1 of 2 pictures are {scale[0]}x{scale[1]} px: their camera of 8x6 is scaled",
    )


@pytest.mark.parametrize("size", [(4, 2), (8, 7), (6, 8), (9, 6)])
def test_pictures_of_another_shape_than_their_camera_are_refused(write, content, size):
    file = write(content)
    write_png(file.parent / "a.png", np.full((size[1], size[0], 3), 10, np.uint8))
    with pytest.raises(DatasetError, match=rf"picture is {size[0]}x{size[1]} px, its camera says"):
        read_dataset(file)


def test_names_in_other_upper_and_lower_case_are_found_and_said(write, content):
    content["frames"][0]["file_path"] = "A.PNG"
    dataset = read_dataset(write(content))
    assert (dataset.pictures[0].read() == 10).all()
    assert dataset.changes == (
        "1 of 2 pictures are found under names in other upper and lower case",
    )


@pytest.mark.parametrize("missing", [("w", "h"), ("w",), ("h",)])
def test_a_size_that_is_not_stated_is_the_pictures(write, content, missing):
    for key in (*missing, "fl_x", "fl_y", "cx", "cy"):
        del content[key]
    content["camera_angle_x"] = math.pi / 2
    for frame in content["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")  # as Blender writes
    k = read_dataset(write(content)).pictures[0].camera.intrinsics
    assert (k.width_px, k.height_px, k.cx_px, k.cy_px) == (8, 6, 4.0, 3.0)
    assert k.fx_px == pytest.approx(4.0)


@pytest.mark.parametrize(
    "name",
    [
        "images\\a.png",
        ".\\images\\a",
        "{folder}/images/a.png",
        "/home/somebody/scene/images/a.png",
        "/home/somebody/scene/images/a",
        "C:\\data\\scene\\images\\a.png",
    ],
)
def test_paths_of_windows_and_of_other_machines_lead_to_the_picture(write, content, name):
    file = write(content)
    (file.parent / "images").mkdir()
    (file.parent / "a.png").rename(file.parent / "images" / "a.png")
    content["frames"][0]["file_path"] = name.format(folder=file.parent)
    dataset = read_dataset(write(content))
    assert (dataset.pictures[0].read() == 10).all()
    absolute = name[0] != "." and not name.startswith("images")
    assert bool(dataset.changes) == absolute
    assert not absolute or "1 of 2 pictures are named by absolute paths" in dataset.changes[0]


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("/home/somebody/elsewhere.png", "leaves .*no end of it is there; name files relative"),
        ("C:\\data\\elsewhere.png", "no end of it is there"),
        ("..\\secret.png", "leaves the dataset's folder"),
        ("/tmp/../etc/passwd", "leaves the dataset's folder"),
        ("images\\elsewhere.png", "is missing"),
    ],
)
def test_paths_that_lead_nowhere_are_refused_by_what_they_are(write, content, name, named):
    content["frames"][0]["file_path"] = name
    with pytest.raises(DatasetError, match=named):
        read_dataset(write(content))


@pytest.mark.parametrize("name", ["absent.ply", "/home/somebody/absent.ply"])
def test_points_that_are_not_there_stop_nothing(write, content, name):
    content["ply_file_path"] = name
    dataset = read_dataset(write(content))
    assert (len(dataset.pictures), dataset.points) == (2, None)
    assert "no points: " in dataset.changes[0]


def test_a_lens_of_colmap_is_read_by_its_name(write, content):
    content |= {"camera_model": "FULL_OPENCV", "k3": 0.01, "k4": 0.1}
    assert read_dataset(write(content), distortion="undistort").changes
    content["camera_model"] = "OPENCV"  # of nerfstudio, whose k4 is another
    with pytest.raises(DatasetError, match=r"k4 = 0\.1 of camera_model OPENCV is not read"):
        read_dataset(write(content), distortion="undistort")
