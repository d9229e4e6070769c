"""Frames by number and time from every container that is read, sought, cut, turned or damaged."""

import json
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.bitstream import BitStreamFilterContext
from av.stream import Disposition

from rfcore.camera import Intrinsics
from rfcore.dataset import read_dataset
from rfcore.dataset.orientation import Orientation
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.video import Video, is_video
from rfcore.errors import DatasetError
from rfcore.lens import BrownLens
from rfedge.cli import parse

COUNT = 30
RATE = 10
B_FRAMES = {"bf": "2", "g": "10", "crf": "12", "preset": "fast"}
WRITTEN = {
    "a.mp4": ("mp4", "libx264"),
    "a.mov": ("mov", "libx264"),
    "a.mkv": ("matroska", "libx264"),
    "a.webm": ("webm", "libvpx-vp9"),
    "a.ts": ("mpegts", "libx264"),
    "a.mts": ("mpegts", "libx264"),
    "a.mpg": ("mpeg", "mpeg2video"),
    "a.vob": ("vob", "libx264"),
    "a.avi": ("avi", "libx264"),
    "a.flv": ("flv", "libx264"),
    "a.h264": ("h264", "libx264"),
    "a.hevc": ("hevc", "libx265"),
    "a.wmv": ("asf", "msmpeg4"),
    "a.ivf": ("ivf", "libvpx-vp9"),
    "a.mxf": ("mxf", "mpeg2video"),
    "a.ogv": ("ogg", "libvpx"),
    "a.y4m": ("yuv4mpegpipe", "rawvideo"),
    "a.nut": ("nut", "libx264"),
    "a.gif": ("gif", "gif"),
}
"""Format and codec by file name."""
TIMELESS = ("a.avi", "a.h264", "a.hevc", "a.vob")


def level(number: int) -> int:
    return 40 + 6 * number


def picture(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    """Grey of a level of its own, the left half 30 levels darker than the right, top marked."""
    rgb = np.full((height, width, 3), level(number), np.uint8)
    rgb[:, width // 2 :] += 30
    rgb[: height // 4] = 10
    return rgb


def write_video(path: Path, kind: str, codec: str, count: int = COUNT, **options) -> Path:
    with av.open(str(path), "w", format=kind, **options) as container:
        rate = 25 if codec == "mpeg2video" else RATE
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height = 64, 48
        stream.pix_fmt = "gray" if codec == "gif" else "yuv420p"
        stream.options = B_FRAMES if codec == "libx264" else {"g": "10", "b": "2M"}
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(picture(number), "rgb24")
            frame = frame.reformat(format=stream.pix_fmt)
            frame.pts, frame.time_base = number, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def shown(rgb: np.ndarray) -> float:
    """Return the number of the frame that a picture is of."""
    return (rgb[20:44, 4:28].mean() - 40) / 6


class Videos:
    """A video of each container, written when it is asked for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __truediv__(self, name: str) -> Path:
        path = self._folder / name
        return path if path.exists() else write_video(path, *WRITTEN[name])


@pytest.fixture(scope="module")
def videos(tmp_path_factory) -> Videos:
    return Videos(tmp_path_factory.mktemp("videos"))


@pytest.mark.parametrize("name", WRITTEN)
def test_each_container_gives_the_frame_that_is_asked_for(videos, name):
    video = Video(videos / name)
    assert len(video.index.pts) == COUNT
    order = [5, 29, 3, 4, 17, 0, 12, *range(COUNT)]
    assert [round(shown(video.read(number))) for number in order] == order
    assert max(abs(shown(video.read(number)) - number) for number in range(COUNT)) < 0.3


@pytest.mark.parametrize("name", WRITTEN)
def test_each_container_gives_the_times_of_its_frames(videos, name):
    video = Video(videos / name)
    rate = 25 if WRITTEN[name][1] == "mpeg2video" else RATE
    if name in ("a.h264", "a.hevc"):
        rate = 1e9 / video.index.times_ns[1]  # FFmpeg's guess, which is said
    expected = [number / rate for number in range(COUNT)]
    np.testing.assert_allclose(np.array(video.index.times_ns) / 1e9, expected, atol=6e-4)
    said = [note for note in video.index.notes if "a second are taken" in note]
    assert bool(said) == (name in TIMELESS)


def test_dv_gives_the_frame_that_is_asked_for(tmp_path):
    path = tmp_path / "a.dv"
    with av.open(str(path), "w", format="dv") as container:
        stream = container.add_stream("dvvideo", rate=25)
        stream.width, stream.height, stream.pix_fmt = 720, 576, "yuv420p"
        for number in range(8):
            frame = av.VideoFrame.from_ndarray(picture(number, 720, 576), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 25)
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode(None))
    video = Video(path)
    assert video.index.times_ns == tuple(40_000_000 * number for number in range(8))
    for number in (5, 7, 3, 4, 0):
        assert (video.read(number)[200:500, 50:300].mean() - 40) / 6 == pytest.approx(
            number, abs=0.3
        )


@pytest.mark.parametrize(("kind", "codec"), [("h264", "libx264"), ("hevc", "libx265")])
@pytest.mark.parametrize(("left", "top", "right"), [(0, 0, 6), (2, 4, 0), (6, 2, 8), (32, 16, 0)])
def test_a_cropped_video_shows_what_its_parameters_leave(tmp_path, kind, codec, left, top, right):
    whole = write_video(tmp_path / "a.mp4", "mp4", codec, 5)
    with av.open(str(whole)) as source, av.open(str(tmp_path / "b.mp4"), "w") as container:
        stream = source.streams.video[0]
        copy = container.add_stream_from_template(stream)
        crop = f"{kind}_metadata=crop_left={left}:crop_top={top}:crop_right={right}"
        changed = BitStreamFilterContext(crop, stream, copy)
        for packet in source.demux(stream):
            for out in changed.filter(packet if packet.dts is not None else None):
                out.stream = copy
                container.mux(out)
    video = Video(tmp_path / "b.mp4")
    assert video.size_px == (64 - left - right, 48 - top)
    assert np.array_equal(video.read(3), Video(whole).read(3)[top:, left : 64 - right])


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts"])
def test_of_several_videos_the_first_is_read_and_the_others_are_said(tmp_path, name):
    """Dash cams have the rear camera in the same file."""
    with av.open(str(tmp_path / name), "w") as container:
        streams = [container.add_stream("libx264", rate=RATE) for _ in range(2)]
        for stream, (width, height) in zip(streams, ((64, 48), (32, 24)), strict=True):
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number in range(3):
            for stream in streams:
                rgb = picture(number, stream.width, stream.height)
                frame = av.VideoFrame.from_ndarray(rgb, "rgb24")
                frame.pts, frame.time_base = number, Fraction(1, RATE)
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    video = Video(tmp_path / name)
    assert (len(video.index.pts), video.size_px) == (3, (64, 48))
    assert "the first of 2 videos in it, 64x48 px, is read; not read: 32x24 px" in video.index.notes


def test_a_cover_picture_is_no_video(tmp_path):
    """It comes first where a program has put it there."""
    plain = write_video(tmp_path / "a.mp4", "mp4", "libx264", 5)
    with av.open(str(plain)) as source, av.open(str(tmp_path / "b.mp4"), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 32, 32, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        copy = container.add_stream_from_template(source.streams.video[0])
        still = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), "rgb24")
        container.mux([*cover.encode(still), *cover.encode(None)])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = copy
                container.mux(packet)
    video = Video(tmp_path / "b.mp4")
    assert (len(video.index.pts), video.size_px, video.index.notes) == (5, (64, 48), ())


def test_an_avi_of_copied_packets_has_the_rate_of_its_length(videos, tmp_path):
    """Its header states the time base for a rate, as `ffmpeg -c copy` writes it."""
    path = tmp_path / "copy.avi"
    with av.open(str(videos / "a.ts")) as source, av.open(str(path), "w") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        stream.time_base = Fraction(1, 600)
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
    times_s = np.array(Video(path).index.times_ns) / 1e9
    np.testing.assert_allclose(np.diff(times_s), 1 / RATE, rtol=0.1)


@pytest.mark.parametrize("name", WRITTEN)
def test_a_video_is_known_by_its_content(videos, name, tmp_path):
    (tmp_path / "drive.txt").write_bytes((videos / name).read_bytes())
    assert is_video(tmp_path / "drive.txt")


@pytest.mark.parametrize(
    "content", [b"", b"text\n" * 99, json.dumps({"frames": []}).encode(), b"\x89PNG\r\n\x1a\n" * 9]
)
def test_other_files_are_no_videos(content, tmp_path):
    (tmp_path / "a.mp4").write_bytes(content)
    assert not is_video(tmp_path / "a.mp4")


def test_a_playlist_opens_no_other_file(videos, tmp_path):
    (tmp_path / "b.mp4").write_bytes((videos / "a.mp4").read_bytes())
    (tmp_path / "a.mp4").write_text("ffconcat version 1.0\nfile b.mp4\n")
    with pytest.raises(DatasetError, match=r"a\.mp4: not a readable video"):
        Video(tmp_path / "a.mp4")


def cut_by_copy(source: Path, path: Path, from_frame: int) -> Path:
    """Trim without encoding, as phones do: an edit list hides the packets before the start."""
    with av.open(str(source)) as old, av.open(str(path), "w") as new:
        stream = old.streams.video[0]
        copy = new.add_stream_from_template(stream)
        key = from_frame // 10 * 10
        start = round(from_frame / RATE / stream.time_base)
        for packet in old.demux(stream):
            if packet.dts is None or packet.pts < round(key / RATE / stream.time_base):
                continue
            packet.pts -= start
            packet.dts -= start
            packet.stream = copy
            new.mux(packet)
    return path


@pytest.mark.parametrize("name", ["a.mp4", "a.mov"])
def test_frames_before_the_edit_list_are_not_there(videos, tmp_path, name):
    video = Video(cut_by_copy(videos / name, tmp_path / name, 15))
    assert [round(shown(video.read(n))) for n in (14, 0, 3, 7)] == [29, 15, 18, 22]
    assert len(video.index.times_ns) == 15
    np.testing.assert_allclose(video.index.times_ns[:3], [0, 1e8, 2e8], atol=1)


@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts", "a.avi", "a.flv", "a.h264"])
def test_a_cut_file_is_refused_or_ends_early_but_shows_no_other_picture(
    videos, tmp_path, name, share
):
    content = (videos / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(share * len(content))])
    try:
        video = Video(tmp_path / name)
    except DatasetError:
        return
    count = len(video.index.pts)
    assert 0 < count <= COUNT
    pictures = [round(shown(video.read(n))) for n in range(count)]
    if name == "a.h264":  # nothing in it tells that B pictures before the last one are missing
        assert pictures[:-1] == list(range(count - 1))
        assert count - 1 <= pictures[-1] < count + int(B_FRAMES["bf"])
    else:
        assert pictures == list(range(count))


@pytest.mark.parametrize("name", ["a.mkv", "a.flv", "a.ivf", "a.mxf"])
def test_a_file_that_ends_before_its_stated_length_says_so(videos, tmp_path, name):
    assert not [note for note in Video(videos / name).index.notes if "may be cut" in note]
    content = (videos / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(0.6 * len(content))])
    video = Video(tmp_path / name)
    count, rate = len(video.index.pts), 25 if name == "a.mxf" else RATE
    (note,) = [note for note in video.index.notes if "may be cut" in note]
    assert f"{count / rate:.2f} s of the {COUNT / rate:.2f} s" in note


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_an_mp4_whose_header_lists_more_than_is_there_is_refused(tmp_path, share):
    path = write_video(tmp_path / "a.mp4", "mp4", "libx264", options={"movflags": "faststart"})
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(
        DatasetError, match=r"a\.mp4: (is cut: \d+ bytes are stated|not a readable)"
    ):
        Video(path)


def test_a_broadcast_that_begins_between_key_frames_starts_at_the_next_one(videos, tmp_path):
    content = (videos / "a.ts").read_bytes()
    (tmp_path / "a.ts").write_bytes(content[: 188 * 3] + content[188 * 12 :])
    video = Video(tmp_path / "a.ts")
    found = [round(shown(video.read(n))) for n in range(len(video.index.pts))]
    assert found == list(range(found[0], COUNT))
    assert video.index.times_ns[0] == 0


def test_a_video_of_absurd_size_is_refused_before_it_is_decoded(videos, monkeypatch):
    monkeypatch.setattr("rfcore.dataset.video.MAX_SIDE_PX", 63)
    monkeypatch.setattr("rfcore.dataset.video._frames", None)  # none is to get so far
    with pytest.raises(DatasetError, match=r"a\.mp4: video is 64x48 px, over the limit of 63 px"):
        Video(videos / "a.mp4")


def test_interlaced_frames_and_pixels_that_are_not_square_are_said(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.options = {"x264-params": "tff=1"}
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(picture(number), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    notes = " ".join(Video(tmp_path / "a.mp4").index.notes)
    assert "marked as interlaced" in notes
    assert "pixels are 1.333 times as wide as high" in notes


MATRICES = {
    1: (1, 0, 0, 1),
    2: (-1, 0, 0, 1),
    3: (-1, 0, 0, -1),
    4: (1, 0, 0, -1),
    5: (0, 1, 1, 0),
    6: (0, 1, -1, 0),
    7: (0, -1, -1, 0),
    8: (0, -1, 1, 0),
}
"""a b c d of ISO/IEC 14496-12's matrix by EXIF's number of the same turn."""


def as_exif_shows(rgb: np.ndarray, number: int) -> np.ndarray:
    """What each number means by CIPA DC-008: where row 0 and column 0 are seen."""
    return {
        1: lambda a: a,
        2: np.fliplr,
        3: lambda a: np.rot90(a, 2),
        4: np.flipud,
        5: lambda a: a.transpose(1, 0, 2),
        6: lambda a: np.rot90(a, -1),
        7: lambda a: np.rot90(a, 2).transpose(1, 0, 2),
        8: lambda a: np.rot90(a, 1),
    }[number](rgb)


def turned(path: Path, number: int) -> Path:
    """Write a turn into the track header of an MP4."""
    content = path.read_bytes()
    at = content.index(b"tkhd") + 4 + 4 + 20 + 8 + 8
    a, b, c, d = (value << 16 for value in MATRICES[number])
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content[:at] + matrix + content[at + 36 :])
    return path


@pytest.mark.parametrize("number", range(1, 9))
def test_frames_are_turned_and_mirrored_as_the_file_says(tmp_path, number):
    upright = write_video(tmp_path / "a.mp4", "mp4", "libx264", 3)
    stored = Video(upright).read(1)
    video = Video(turned(upright, number))
    assert np.array_equal(video.read(1), as_exif_shows(stored, number))
    assert video.index.orientation == number
    assert bool(video.index.notes) == (number != 1)


def test_a_turn_by_another_angle_is_refused(tmp_path):
    path = write_video(tmp_path / "a.mp4", "mp4", "libx264", 3)
    content = path.read_bytes()
    at = content.index(b"tkhd") + 44
    path.write_bytes(content[:at] + struct.pack(">i", 50_000) + content[at + 4 :])
    with pytest.raises(DatasetError, match=r"a\.mp4: is to be shown by the matrix 0\.763"):
        Video(path)


@pytest.mark.parametrize("number", range(1, 9))
def test_a_camera_is_turned_with_its_pictures(number):
    """A point lands on the same content: where the stored picture shows it, turned."""
    orientation = Orientation(number)
    lens = BrownLens(-0.2, 0.03, 0.01, -0.02)
    stored = SourceCamera(Intrinsics(64, 48, 50.0, 52.0, 30.0, 27.0), lens)
    camera = orientation.camera(stored)
    points = np.random.default_rng(number).uniform((-0.3, -0.3, 1), (0.3, 0.3, 2), (9, 3))
    axes = np.eye(3)
    if not orientation.mirrors:
        axes = np.array(orientation.stored_from_shown.rotation_matrix())
    else:
        offsets = as_exif_shows(np.mgrid[:3, :3].transpose(1, 2, 0) - 1, number)
        axes[:2, :2] = np.array([offsets[1, 2][::-1], offsets[2, 1][::-1]]).T

    def pixels(camera: SourceCamera, xyz: np.ndarray) -> np.ndarray:
        k = camera.intrinsics
        xy = camera.lens.distort(xyz[:, :2] / xyz[:, 2:])
        return xy * (k.fx_px, k.fy_px) + (k.cx_px, k.cy_px)

    before, after = pixels(stored, points), pixels(camera, points @ axes)
    marks = np.zeros((48, 64, 1))
    for i, (u, v) in enumerate(before):
        marks[int(v), int(u)] = i + 1
    seen = as_exif_shows(marks, number)
    assert [seen[int(v), int(u), 0] for u, v in after] == [
        marks[int(v), int(u), 0] for u, v in before
    ]


@pytest.mark.parametrize("number", [6, 8])
def test_a_video_turned_by_90_degrees_keeps_the_scene_in_place(golden, tmp_path, number, capsys):
    """The camera that is stated may be of the frames as stored or as shown."""
    folder = golden.write("video", tmp_path / "d")
    turned(folder / "drive.mp4", number)
    dataset = read_dataset(folder)
    assert (
        f"turned by 90 degrees {'' if number == 6 else 'counter-'}clockwise" in dataset.changes[0]
    )
    assert "its camera is turned with it" in dataset.changes[1]
    for picture in dataset.pictures:
        k = picture.camera.intrinsics
        assert (k.width_px, k.height_px) == (48, 64)
        x, y, z = picture.camera.cam_from_world().apply(golden.point)
        u, v = k.fx_px * x / z + k.cx_px, k.fy_px * y / z + k.cy_px
        assert (picture.read()[int(v), int(u)] > 200).all()
    text = (folder / "camera.toml").read_text().replace("width_px = 64", "width_px = 48")
    (folder / "camera.toml").write_text(text.replace("height_px = 48", "height_px = 64"))
    shown_camera = read_dataset(folder)
    assert len(shown_camera.changes) == 1
    assert (
        shown_camera.pictures[0].camera.world_from_cam != dataset.pictures[0].camera.world_from_cam
    )
    parse(["dataset", "convert", str(folder), "--out", str(tmp_path / "out")]).run()
    assert "turned by 90 degrees" in capsys.readouterr().out
