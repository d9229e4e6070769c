"""MCAP files and ROS 2 bags as datasets: the bags are written by the public libraries."""

import json
import math
import sqlite3
from fractions import Fraction

import av
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

import bags
from bags import SIZE_PX, Recording, drive, map_from_base, time_ns
from rfcore.camera import Intrinsics, Pose
from rfcore.dataset import bag_records
from rfcore.dataset.read import read_source
from rfcore.errors import DatasetError
from rfcore.image import jpeg_bytes, png_bytes, rgb_from_bytes
from rfcore.lens import BrownLens, FisheyeLens
from rfedge.cli import parse

STORAGES = (StoragePlugin.MCAP, StoragePlugin.SQLITE3)


@pytest.fixture(autouse=True)
def reader_in_this_process(request, monkeypatch):
    """Read without a process for each bag, which takes a second, unless a test is about that."""
    if "sandbox" not in request.node.name:
        monkeypatch.setattr(bag_records, "confined_records", bags.records_here)


def one_picture(message, info=None, topic="/front/image_raw"):
    """Return a drive of one picture, which is ``message``."""
    made = drive(1, with_pictures=False)
    made.add("/front/camera_info", info or bags.camera_info(time_ns(0), SIZE_PX), time_ns(0))
    made.add(topic, message, time_ns(0))
    return made


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_read_in_a_sandbox(tmp_path, storage):
    source = read_source(drive(2).write(tmp_path / "bag", storage))
    for i, picture in enumerate(source.pictures):
        np.testing.assert_array_equal(picture.read(), bags.rgb(i))
    content = (next((tmp_path / "bag").glob("bag.*"))).read_bytes()
    (tmp_path / "cut").write_bytes(content[:2000])
    with pytest.raises(DatasetError, match=r"cut|no whole bag|holds no pictures"):
        read_source(tmp_path / "cut")


@pytest.mark.parametrize("storage", STORAGES)
def test_pictures_are_equal_to_the_byte_and_at_the_poses_of_their_stamps(tmp_path, storage):
    source = read_source(drive(4).write(tmp_path / "bag", storage))
    assert [picture.time_ns for picture in source.pictures] == [time_ns(i) for i in range(4)]
    for i, picture in enumerate(source.pictures):
        np.testing.assert_array_equal(picture.read(), bags.rgb(i))
        expected = map_from_base(i).compose(bags.BASE_FROM_CAM)
        assert math.dist(picture.world_from_cam.translation_m, expected.translation_m) < 1e-9
        assert math.dist(picture.world_from_cam.rotation, expected.rotation) < 1e-12
    k = source.pictures[0].camera.intrinsics
    assert k == Intrinsics(16, 12, 20, 21, 8, 6), "ROS counts from pixel centres"
    assert source.notes == (f"poses: transforms of '{bags.OPTICAL}' in 'map'",)
    (
        np.testing.assert_array_equal(source.pictures[1].read(), bags.rgb(1)),
        "read again, out of order",
    )


def test_a_pose_is_interpolated_and_looks_where_the_vehicle_drives(tmp_path):
    """REP 103: the vehicle's x is forward, which is z of an optical frame."""
    made = drive(2, with_pictures=False)
    made.add("/front/camera_info", bags.camera_info(time_ns(0), SIZE_PX), time_ns(0))
    made.add("/front/image_raw", bags.rgb_image(time_ns(0.3), bags.rgb(0)), time_ns(0))
    (picture,) = read_source(made.write(tmp_path / "bag")).pictures
    ahead = picture.world_from_cam.apply((0, 0, 1))
    here = picture.world_from_cam.translation_m
    forward = map_from_base(0.3).apply((1, 0, 0))
    origin = map_from_base(0.3).translation_m
    np.testing.assert_allclose(np.subtract(ahead, here), np.subtract(forward, origin), atol=1e-12)


RAW = {
    "rgb8": lambda rgb: rgb,
    "bgr8": lambda rgb: rgb[..., ::-1],
    "rgba8": lambda rgb: np.dstack([rgb, np.zeros(rgb.shape[:2], np.uint8)]),
    "bgra8": lambda rgb: np.dstack([rgb[..., ::-1], np.zeros(rgb.shape[:2], np.uint8)]),
    "mono8": lambda rgb: rgb[..., :1],
}


@pytest.mark.parametrize("encoding", RAW)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_pictures_are_read_in_the_order_of_their_channels(tmp_path, encoding, padding):
    rgb = bags.rgb(7)
    stored = RAW[encoding](rgb)
    rows = np.pad(stored.reshape(12, -1), ((0, 0), (0, padding)))
    message = bags.image(time_ns(0), rows, encoding, SIZE_PX)
    (picture,) = read_source(one_picture(message).write(tmp_path / "bag")).pictures
    expected = np.repeat(rgb[..., :1], 3, 2) if encoding == "mono8" else rgb
    np.testing.assert_array_equal(picture.read(), expected)


PATTERNS = {"rggb": (0, 1, 1, 2), "bggr": (2, 1, 1, 0), "gbrg": (1, 2, 0, 1), "grbg": (1, 0, 2, 1)}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_mosaic_of_one_colour_is_that_colour(tmp_path, pattern):
    colour = np.array([200, 120, 40], np.uint8)
    cell = colour[list(PATTERNS[pattern])].reshape(2, 2)
    message = bags.image(time_ns(0), np.tile(cell, (6, 8)), f"bayer_{pattern}8", SIZE_PX)
    source = read_source(one_picture(message).write(tmp_path / "bag"))
    assert any("interpolated by FFmpeg" in note for note in source.notes)
    np.testing.assert_allclose(source.pictures[0].read(), np.tile(colour, (12, 16, 1)), atol=1)


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_yuv422_is_bt601_of_limited_range(tmp_path, encoding):
    y, u, v = 81, 90, 240  # red, by BT.601
    cell = [u, y, v, y] if encoding in ("yuv422", "uyvy") else [y, u, y, v]
    message = bags.image(time_ns(0), np.tile(np.uint8(cell), (12, 8)), encoding, SIZE_PX)
    source = read_source(one_picture(message).write(tmp_path / "bag"))
    np.testing.assert_allclose(source.pictures[0].read(), np.tile([255, 0, 0], (12, 16, 1)), atol=2)


def test_compressed_pictures_are_those_of_their_files(tmp_path):
    rgb = bags.rgb(3)
    for name, data in (("rgb8; jpeg compressed bgr8", jpeg_bytes(rgb)), ("png", png_bytes(rgb))):
        topic = "/front/image_raw/compressed"
        made = one_picture(bags.still(time_ns(0), data, name), topic=topic)
        (picture,) = read_source(made.write(tmp_path / name[:3])).pictures
        np.testing.assert_array_equal(picture.read(), rgb_from_bytes(data, name))


def encoded(pictures, rate=10):
    """Return H.264 in Annex B, an access unit a picture, a key frame each three."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = (*SIZE_PX, "yuv420p")
    encoder.time_base = Fraction(1, rate)
    encoder.options = {"bf": "0", "g": "3", "tune": "zerolatency", "crf": "1", "sc_threshold": "0"}
    packets = []
    for i, rgb in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(rgb, "rgb24")
        frame.pts = i
        packets += encoder.encode(frame)
    return [bytes(packet) for packet in (*packets, *encoder.encode(None))]


def smooth(number):
    return np.full((12, 16, 3), 20 + 25 * number, np.uint8)


def video_bag(path, units, skip=0):
    made = drive(len(units), with_pictures=False).write(path / "poses")
    calibration = bags.camera_info(time_ns(0), SIZE_PX)
    del calibration
    messages = [
        ("/front/video", time_ns(i), bags.video_message(time_ns(i), unit))
        for i, unit in enumerate(units)
    ]
    bags.foxglove_mcap(path / "video.mcap", messages[skip:])
    (path / "camera.toml").write_text(
        '[camera]\nwidth_px = 16\nheight_px = 12\nfx_px = 20\n[pictures]\nbag = "video.mcap"\n'
        '[trajectory]\nfile = "poses.csv"\n'
    )
    rows = ["time_ns,x_m,y_m,z_m,qw,qx,qy,qz"]
    rows += [f"{time_ns(i)},{i},0,0,1,0,0,0" for i in range(len(units))]
    (path / "poses.csv").write_text("\n".join(rows) + "\n")
    return path / "camera.toml", made


@pytest.mark.parametrize("skip", [0, 1])
def test_foxglove_video_is_decoded_from_its_key_frames_on(tmp_path, skip):
    toml, _ = video_bag(tmp_path, encoded([smooth(i) for i in range(7)]), skip)
    source = read_source(toml)
    first = 3 if skip else 0
    if skip:
        assert any("pictures of /front/video come before" in note for note in source.notes)
    assert [picture.time_ns for picture in source.pictures] == [time_ns(i) for i in range(first, 7)]
    for number in (5, 6, 4):
        picture = source.pictures[number - first].read()
        np.testing.assert_allclose(picture, smooth(number), atol=3)


def test_camera_info_is_applied_with_its_lens_region_and_binning(tmp_path):
    k = (40, 0, 19.5, 0, 42, 14.5, 0, 0, 1)
    info = bags.camera_info(
        time_ns(0), (64, 48), k=k, d=(0.1, 0.01, 0.001, 0.002, 0), roi=(4, 6, 24, 32), binning=2
    )
    source = read_source(
        one_picture(bags.rgb_image(time_ns(0), bags.rgb(0)), info).write(tmp_path / "bag")
    )
    camera = source.pictures[0].camera
    assert camera.intrinsics == Intrinsics(16, 12, 20, 21, (20 - 4) / 2, (15 - 6) / 2)
    assert camera.lens == BrownLens(0.1, 0.01, 0.001, 0.002, 0)
    assert any("binning 2x2" in note for note in source.notes)


def test_equidistant_is_a_fisheye_and_a_rectified_picture_has_no_lens(tmp_path):
    message = bags.rgb_image(time_ns(0), bags.rgb(0))
    info = bags.camera_info(time_ns(0), SIZE_PX, model="equidistant", d=(0.1, 0.2, 0.3, 0.4))
    source = read_source(one_picture(message, info).write(tmp_path / "a"))
    assert source.pictures[0].camera.lens == FisheyeLens(0.1, 0.2, 0.3, 0.4)
    p = (30, 0, 8.5, 0, 0, 31, 6.5, 0, 0, 0, 1, 0)
    info = bags.camera_info(time_ns(0), SIZE_PX, d=(0.1, 0, 0, 0, 0), p=p)
    made = one_picture(message, info, topic="/front/image_rect")
    camera = read_source(made.write(tmp_path / "b")).pictures[0].camera
    assert camera.lens is None
    assert camera.intrinsics == Intrinsics(16, 12, 30, 31, 9, 7)


def without(recording, *topics):
    return Recording([message for message in recording.messages if message[0] not in topics])


def test_odometry_places_the_camera_by_the_static_transforms(tmp_path):
    made = without(drive(3), "/tf")
    for i in range(3):
        message = bags.odometry(time_ns(i), "odom", "base_link", map_from_base(i), 0.04)
        made.add("/odom", message, time_ns(i))
    source = read_source(made.write(tmp_path / "bag"))
    expected = map_from_base(1).compose(bags.BASE_FROM_CAM)
    assert math.dist(source.pictures[1].world_from_cam.translation_m, expected.translation_m) < 1e-9
    line = json.loads(source.feeds["/odom"][1])
    assert line["covariance_m2"] == [0.04] * 3
    assert line["quaternion"] == pytest.approx([0.8, 0, 0, 0.6])


def test_a_pose_that_does_not_say_of_what_needs_a_mounting(tmp_path):
    made = without(drive(3), "/tf", "/tf_static")
    for i in range(3):
        made.add("/pose", bags.pose_stamped(time_ns(i), "map", map_from_base(i)), time_ns(i))
    made.write(tmp_path / "bag")
    with pytest.raises(DatasetError, match=r"/pose: .* of no frame; state body_from_cam"):
        read_source(tmp_path / "bag")
    rows = "[[0, 0, 1, 1.2], [-1, 0, 0, 0.1], [0, -1, 0, 1.4]]"
    toml = tmp_path / "camera.toml"
    toml.write_text(f'[pictures]\nbag = "bag"\n[trajectory]\nbody_from_cam = {rows}\n')
    expected = map_from_base(2).compose(bags.BASE_FROM_CAM)
    found = read_source(toml).pictures[2].world_from_cam
    assert math.dist(found.translation_m, expected.translation_m) < 1e-9


def test_two_cameras_are_told_apart_by_their_topic(tmp_path, capsys):
    made = drive(2)
    for i in range(2):
        made.add("/rear/camera_info", bags.camera_info(time_ns(i), SIZE_PX), time_ns(i))
        made.add("/rear/image_raw", bags.rgb_image(time_ns(i), bags.rgb(9)), time_ns(i))
    bag = made.write(tmp_path / "bag")
    with pytest.raises(DatasetError, match=r"--topics /front/image_raw"):
        read_source(bag)
    words = ["dataset", "convert", str(bag), "--out", str(tmp_path / "out")]
    parse([*words, "--topics", "/rear/image_raw"]).run()
    first = read_source(tmp_path / "out").pictures[0]
    np.testing.assert_array_equal(first.read(), bags.rgb(9))
    parse(["doctor", str(bag)]).run()
    assert capsys.readouterr().out.count("next: rfedge dataset convert") == 2


def test_fixes_and_poses_become_feeds_that_the_agent_reads(tmp_path, capsys):
    from cav_agent.pose_feed import PoseFeed

    made = drive(2)
    for i, status in enumerate((0, -1, 2)):
        made.add("/fix", bags.fix(time_ns(i), 48.1, 11.5, 520.0, status), time_ns(i))
    bag = made.write(tmp_path / "bag")
    parse(["dataset", "convert", str(bag), "--out", str(tmp_path / "out")]).run()
    assert "/fix: 1 messages without a fix" in capsys.readouterr().out
    problems = []
    feed = PoseFeed(lambda *problem: problems.append(problem), recorded=True)
    feed.receive((tmp_path / "out" / "fix.jsonl").read_bytes(), 0)
    fixes, count = feed.since(0)
    assert (count, problems) == (2, [])
    fix, at_ns = fixes[0]
    assert fix.geodetic == (48.1, 11.5, 520.0)
    assert fix.position_std_m == (0.5, 0.5, 1.0)
    assert abs(at_ns - time_ns(0)) < 1000


def test_a_bag_that_is_cut_gives_its_whole_messages_and_says_so(tmp_path):
    bag = bags.in_small_chunks(drive(4).write(tmp_path / "bag"))
    content = bag.read_bytes()
    bag.write_bytes(content[: content.index(bags.rgb(3).tobytes())])
    source = read_source(bag)
    assert len(source.pictures) == 3
    assert "is cut: its" in source.notes[0]


def damaged(path, content):
    path.write_bytes(content)
    return path


def test_a_bag_that_is_damaged_is_refused(tmp_path):
    (bag,) = drive(4).write(tmp_path / "bag").glob("*.mcap")
    content = bytearray(bag.read_bytes())
    at = content.index(b"front_optical")
    content[at : at + 4] = b"XXXX"
    with pytest.raises(DatasetError, match="damaged"):
        read_source(damaged(tmp_path / "flipped.mcap", content))
    with pytest.raises(DatasetError, match="ROS 1"):
        read_source(damaged(tmp_path / "old.bag", b"#ROSBAG V2.0\n" + bytes(20)))
    with pytest.raises(DatasetError, match="no whole bag of SQLite"):
        read_source(damaged(tmp_path / "a.db3", b"SQLite format 3\0" + bytes(90)))


def test_a_bag_of_sqlite_with_other_types_in_its_columns_is_refused(tmp_path):
    (bag,) = drive(1).write(tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3")
    with sqlite3.connect(bag) as connection:
        connection.execute("UPDATE message_definitions SET encoding = x'00'")
    with pytest.raises(DatasetError, match="is no row of it"):
        read_source(bag)


def bad_clock(made):
    for i in (0, 1, -300):
        made.add("/back/image_raw", bags.rgb_image(time_ns(i), bags.rgb(0)), time_ns(2))


def late_world(made):
    made.messages = [m for m in made.messages if m[0] != "/tf"]
    for at in (900, 901):
        moved = bags.transform(time_ns(at), "map", "base_link", map_from_base(at))
        made.add("/tf", bags.transforms(moved), time_ns(at))


def second_parent(made):
    moved = bags.transform(time_ns(2), "odom", "base_link", Pose.identity())
    made.add("/tf", bags.transforms(moved), time_ns(2))


def tf_steps_back(made):
    moved = bags.transform(time_ns(-90), "map", "base_link", Pose.identity())
    made.add("/tf", bags.transforms(moved), time_ns(5))


def other_camera(made):
    frame = "rear_optical_frame"
    made.add("/front/image_raw", bags.rgb_image(time_ns(4), bags.rgb(0), frame), time_ns(4))


def other_size(made):
    made.add("/front/image_raw", bags.rgb_image(time_ns(4), bags.rgb(0, (8, 8))), time_ns(4))


def no_poses(made):
    made.messages = [m for m in made.messages if m[0] != "/tf"]


def no_camera(made):
    made.messages = [m for m in made.messages if m[0] != "/front/camera_info"]


def camera_changes(made):
    info = bags.camera_info(time_ns(4), SIZE_PX, k=(25, 0, 7.5, 0, 21, 5.5, 0, 0, 1))
    made.add("/front/camera_info", info, time_ns(4))


WRONG = {
    bad_clock: r"several cameras|/back/image_raw, .* the clock steps by -30",
    late_world: r"base_link in map by /tf: 1767225690\.000\.\.",
    second_parent: r"/tf, 1767225600\.200 s: base_link in odom: .* has the parent 'map'",
    tf_steps_back: r"/tf, 1767225591\.000 s: base_link in map: the clock steps back by",
    other_camera: r"/front/image_raw, 1767225600\.400 s: .*two cameras share the topic",
    other_size: r"/front/image_raw, 1767225600\.400 s: 8x8 px after 16x12 px",
    no_poses: r"no transform that moves leads from 'front_optical_frame' up \(.*base_link\)",
    no_camera: r"/front/image_raw: 0 topics state its camera, of frame 'front_optical_frame'",
    camera_changes: r"/front/camera_info, 1767225600\.400 s: the camera changes",
}


@pytest.mark.parametrize("spoil", WRONG, ids=lambda spoil: spoil.__name__)
def test_what_is_wrong_is_said_by_topic_and_time(tmp_path, spoil):
    made = drive(4)
    spoil(made)
    with pytest.raises(DatasetError, match=WRONG[spoil]):
        read_source(made.write(tmp_path / "bag"))


ENCODINGS = {"16UC1": "16UC1", "mono16": "mono16", "bayer_rggb16": "bayer_rggb16"}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_pictures_that_are_not_read_are_refused_by_the_name_of_their_encoding(tmp_path, encoding):
    message = bags.image(time_ns(0), np.zeros((12, 32), np.uint8), encoding, SIZE_PX)
    bag = one_picture(message).write(tmp_path / "bag")
    with pytest.raises(DatasetError, match=f"/front/image_raw, 17672.* '{encoding}' is not read"):
        read_source(bag)
    with pytest.raises(DatasetError, match=f"'{encoding}'"):
        parse(["dataset", "convert", str(bag), "--out", str(tmp_path / "out")]).run()
    assert not (tmp_path / "out").exists()


def test_a_picture_shorter_than_its_header_says_is_refused(tmp_path):
    message = bags.image(time_ns(0), np.zeros((6, 48), np.uint8), "rgb8", SIZE_PX)
    with pytest.raises(DatasetError, match="has 288 bytes, 12 rows of 48 are stated"):
        read_source(one_picture(message).write(tmp_path / "bag"))


def test_the_rational_polynomial_is_read(tmp_path):
    d = (0.1, 0.02, 1e-3, 2e-3, 0.01, 0.3, 0.05, 0.01)
    info = bags.camera_info(time_ns(0), SIZE_PX, d=d, model="rational_polynomial")
    message = bags.rgb_image(time_ns(0), bags.rgb(0))
    source = read_source(one_picture(message, info).write(tmp_path / "bag"))
    assert source.pictures[0].camera.lens == BrownLens(*d)


@pytest.mark.parametrize("d", [(0.1, 0.2), (0.1, 0, 0, 0, 0, 0, 0, 0, 0.3)])
def test_lenses_that_are_not_read_are_refused(tmp_path, d):
    info = bags.camera_info(time_ns(0), SIZE_PX, d=d, model="rational_polynomial")
    message = bags.rgb_image(time_ns(0), bags.rgb(0))
    with pytest.raises(DatasetError, match="/front/camera_info"):
        read_source(one_picture(message, info).write(tmp_path / "bag"))


def test_pictures_without_a_pose_are_left_out_and_counted(tmp_path):
    made = drive(3)
    for i in (-20, 30):
        made.add("/front/image_raw", bags.rgb_image(time_ns(i), bags.rgb(0)), time_ns(i))
    made.messages.sort(key=lambda message: message[1])
    source = read_source(made.write(tmp_path / "bag"))
    assert len(source.pictures) == 3
    assert any("2 of 5 pictures of /front/image_raw have no pose" in note for note in source.notes)


def test_a_topic_without_stamps_has_its_log_times_which_is_said(tmp_path):
    made = drive(2, with_pictures=False)
    made.add("/front/camera_info", bags.camera_info(0, SIZE_PX), time_ns(0))
    made.add("/front/image_raw", bags.rgb_image(0, bags.rgb(0)), time_ns(0))
    source = read_source(made.write(tmp_path / "bag"))
    assert source.pictures[0].time_ns == time_ns(0)
    assert any("the log times are taken" in note for note in source.notes)


def test_messages_of_another_version_of_their_schema_are_read_by_their_own(tmp_path):
    """An Image with a field more, at its front: only the definition in the bag says so."""
    (bag,) = drive(1).write(tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3")
    with sqlite3.connect(bag) as connection:
        name = "sensor_msgs/msg/CameraInfo"
        where = "FROM messages JOIN topics ON topics.id = topic_id WHERE type = ?"
        ((number, data),) = connection.execute(f"SELECT messages.id, data {where}", (name,))
        ((text,),) = connection.execute(
            "SELECT encoded_message_definition FROM message_definitions WHERE topic_type = ?",
            (name,),
        )
        assert "uint32 height" in text
        changed = "uint32 made_up\nuint32 and_more\n" + text
        connection.execute(
            "UPDATE message_definitions SET encoded_message_definition = ? WHERE topic_type = ?",
            (changed, name),
        )
        connection.execute(
            "UPDATE messages SET data = ? WHERE id = ?",
            (data[:4] + bytes(8) + data[4:], number),
        )
    assert read_source(bag).pictures[0].camera.intrinsics.fx_px == 20
    with sqlite3.connect(bag) as connection:
        connection.execute("DELETE FROM message_definitions")
    with pytest.raises(DatasetError, match="/front/camera_info, log time"):
        read_source(bag)
