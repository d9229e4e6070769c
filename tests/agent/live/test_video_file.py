"""A real reader's process on a real video file."""

from __future__ import annotations

import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from cav_agent.config import AgentConfig
from cav_agent.live.reader import EndRecord, FrameRecord
from cav_agent.live.settings import LiveSettings, ReaderSettings
from cav_agent.live.source import ReaderProcess, SourceProblem
from cav_agent.live_cameras import LiveCameras, open_live_cameras
from cav_agent.pose_feed.sources import PoseFeedSettings
from rfcore.camera import TileOrigin
from rfcore.errors import DatasetError, RfedgeError
from rfcore.wire.values import ClockKind

SIZE_PX = (64, 48)
CAMERA = "[camera]\nwidth_px = 64\nheight_px = 48\nfx_px = 40.0\n"
POSES = "[trajectory]\nfile = 'poses.txt'\ntime_offset_s = 5.0\n"


class Events:
    """Hears what happens to a source."""

    def __init__(self) -> None:
        self.lost: list[tuple[SourceProblem, str]] = []
        self.taken = 0

    def source_open(self, camera_id: str, clock: ClockKind) -> None:
        assert (camera_id, clock) == ("front", ClockKind.ARRIVAL)

    def source_lost(
        self,
        camera_id: str,  # noqa: ARG002
        problem: SourceProblem,
        text: str,
        begins: bool,
    ) -> None:
        assert begins or self.lost
        self.lost.append((problem, text))

    def source_damaged(self, camera_id: str, count: int) -> None:
        assert camera_id == "front"
        assert count > 0

    def source_frames(self, taken: int, dropped: int) -> None:
        assert dropped >= 0
        self.taken += taken


def grey_of(index: int) -> int:
    return 40 + 12 * index


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Twelve grey frames, each brighter, at 10 Hz, whose time stamps begin at 3 s."""
    path = tmp_path / "drive.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
        stream.options = {"crf": "10", "bf": "2"}
        for i in range(12):
            rgb = np.full((SIZE_PX[1], SIZE_PX[0], 3), grey_of(i), np.uint8)
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts, frame.time_base = 30 + i, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    (tmp_path / "camera.toml").write_text(CAMERA + POSES)
    (tmp_path / "poses.txt").write_text("5.0 1 2 3 0 0 0 1\n5.9 10 2 3 0 0 0 1\n")
    return path


def settings_of(video: Path, **more: Any) -> LiveSettings:
    return LiveSettings(str(video), video.parent, **more)


def opened(video: Path, events: Events, **more: Any) -> LiveCameras:
    config = AgentConfig("127.0.0.1:1", live=settings_of(video), **more)
    return open_live_cameras(config, None, events)


def read_all(settings: LiveSettings, rate_hz: float) -> tuple[list[FrameRecord], EndRecord]:
    reader = ReaderProcess(ReaderSettings(settings.opened_for(SIZE_PX), 5.0, rate_hz))
    frames = []
    try:
        while not isinstance(record := reader.read(30.0), EndRecord):
            assert record is not None
            frames.append(record)
    finally:
        reader.close()
    return frames, record


def test_a_file_is_played_at_its_own_speed(video: Path) -> None:
    frames, end = read_all(settings_of(video), 10.0)
    assert end.is_whole
    assert len(frames) + frames[-1].dropped == 12
    for frame in frames:
        assert frame.pts_ns is not None
        index = round(frame.pts_ns / 1e8)
        assert abs(float(frame.rgb.mean()) - grey_of(index)) < 3
        apart_s = (frame.received_ns - frames[0].received_ns) / 1e9
        assert apart_s > (frame.pts_ns - (frames[0].pts_ns or 0)) / 1e9 - 0.25


def test_a_lower_rate_leaves_frames_out_before_they_are_converted(video: Path) -> None:
    frames, _ = read_all(settings_of(video), 5.0)
    times = [round((frame.pts_ns or 0) / 1e8) for frame in frames]
    assert set(times) <= {0, 2, 4, 6, 8, 10}


def test_what_is_no_video_is_said_in_words(video: Path) -> None:
    video.write_bytes(b"not a video" * 100)
    frames, end = read_all(settings_of(video), 10.0)
    assert not frames
    assert not end.is_whole
    assert "Invalid data" in end.problem


def test_colours_that_are_not_read_are_said_in_words(video: Path) -> None:
    with av.open(str(video), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
        stream.codec_context.colorspace = 8
        frame = av.VideoFrame(*SIZE_PX, "yuv420p")
        frame.colorspace, frame.pts, frame.time_base = 8, 0, Fraction(1, 10)
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    frames, end = read_all(settings_of(video), 10.0)
    assert not frames
    assert "colour matrix 8 of ITU-T H.273 is not read" in end.problem


def test_frames_get_the_poses_of_their_times_and_the_drive_ends(video: Path) -> None:
    events = Events()
    live = opened(video, events)
    poses = live.poses(TileOrigin(1.0, 2.0, 3.0))
    assert poses is not None
    assert live.positions == ((1.0, 2.0), (10.0, 2.0))
    seen, outside = [], 0
    try:
        while not live.schedule.finished:
            index = live.schedule.next_capture(time.monotonic())
            if index is None:
                time.sleep(0.002)
                continue
            (capture,) = live.take(index)
            assert capture.clock is ClockKind.ARRIVAL
            picture_index = round(capture.picture.time_ns / 1e8)
            assert abs(float(capture.picture.read().mean()) - grey_of(picture_index)) < 3
            if picture_index > 9:
                with pytest.raises(DatasetError, match="is outside"):
                    poses.camera(capture)
                outside += 1
                continue
            x_m = poses.camera(capture).world_from_cam.translation_m[0]
            assert x_m == pytest.approx(picture_index, abs=1e-3)
            seen.append(picture_index)
    finally:
        live.close()
    assert events.lost == []
    assert len(seen) + outside == events.taken
    assert seen == sorted(set(seen))


def test_without_poses_a_live_camera_is_refused(video: Path) -> None:
    (video.parent / "camera.toml").write_text(CAMERA)
    with pytest.raises(RfedgeError, match="nothing says where the camera is"):
        opened(video, Events())
    opened(video, Events(), feed=PoseFeedSettings("udp:127.0.0.1:0")).close()


def test_a_lens_is_taken_out_by_the_vehicle(video: Path) -> None:
    (video.parent / "camera.toml").write_text(CAMERA + 'model = "OPENCV"\nk1 = -0.2\n' + POSES)
    live = opened(video, Events())
    try:
        assert live.cameras[0].intrinsics.fx_px != 40.0
        while live.schedule.next_capture(time.monotonic()) is None:
            time.sleep(0.002)
        (capture,) = live.take(0)
        assert capture.picture.camera.intrinsics == live.cameras[0].intrinsics
        assert capture.picture.read().shape == (48, 64, 3)
    finally:
        live.close()
