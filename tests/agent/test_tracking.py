"""The agent finds its pose while frames go on: searches run beside, OpenCV comes when asked for."""

import math
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cav_agent.camera_poses import DatasetPoses
from cav_agent.frames import Capture, EncodeJob
from cav_agent.lights import TileLights
from cav_agent.pipeline import Pipeline, PipelineOptions
from cav_agent.tracking import CameraTracking
from cav_agent.vehicle import SEARCH_NICENESS, yield_to_frames
from rfcore.camera import Camera
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.ladder import FULL_RUNG
from rfcore.dataset import read_dataset
from rfcore.field import RadianceField, SplatField, load_field, render_field_view
from rfcore.harmonics import SH_DC
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.native.yuv import i420_from_rgb

SAMPLES = Path(__file__).parents[2] / "samples"
RATE_HZ = 10


@pytest.fixture(scope="module")
def field() -> RadianceField:
    return load_field(SAMPLES / "fields/street.rff", threads=2)


@pytest.fixture(scope="module")
def captures() -> list[Capture]:
    pictures = read_dataset(SAMPLES / "street/transforms_drive_empty.json").pictures
    step_ns = 1_000_000_000 // RATE_HZ
    return [
        Capture("front", n, p, n / RATE_HZ, 10**18 + n * step_ns) for n, p in enumerate(pictures)
    ]


class HeldExecutor(Executor):
    """Runs nothing until told to."""

    def __init__(self) -> None:
        self.held: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.held.append((future, lambda: fn(*args, **kwargs)))
        return future

    def run(self) -> None:
        for future, call in self.held:
            future.set_result(call())
        self.held.clear()


def located(tracking: CameraTracking, capture: Capture) -> PoseEstimate:
    location = tracking.locate(capture, i420_from_rgb(capture.picture.read()), FULL_RUNG)
    assert location.fix is not None
    return location.fix


SEARCH_FRAMES = 3
"""A search begun with one frame has ended before the third after it: 200 to 300 ms at 10 Hz."""


def states_while_searching(
    tracking: CameraTracking, held: HeldExecutor, captures: list[Capture]
) -> list[LocalisationState]:
    """Return the states of frames while each search takes ``SEARCH_FRAMES`` of them."""
    states, frames = [], 0
    for capture in captures:
        if frames == SEARCH_FRAMES:
            held.run()
            frames = 0
        states.append(located(tracking, capture).state)
        frames = frames + 1 if held.held else 0
    return states


def again_at(captures: list[Capture], first: int) -> list[Capture]:
    """Return pictures from ``first`` on, at the times of those from frame 4 on."""
    return [
        replace(at, picture=capture.picture)
        for capture, at in zip(captures[first:], captures[4:], strict=False)
    ]


@pytest.mark.sample
@pytest.mark.parametrize("first", [0, 9, 14])
def test_after_a_restart_the_field_is_used_again_within_three_frames(
    field: RadianceField, captures: list[Capture], first: int
) -> None:
    """Nothing tells how fast it drives, and 2.7 m lie between a search's picture and its answer: it
    is the newest picture, looked for when the search has ended, that tells."""
    held = HeldExecutor()
    intrinsics = captures[0].picture.camera.intrinsics
    tracking = CameraTracking(field, intrinsics, DatasetPoses(), held)
    states = states_while_searching(tracking, held, captures[first : first + 8])
    assert states == [LocalisationState.LOCALISING] * 3 + [LocalisationState.TRACKING] * 5
    assert tracking.counts["searched"] == 1


@pytest.mark.sample
def test_after_a_jump_the_field_is_used_again_within_three_frames(
    field: RadianceField, captures: list[Capture]
) -> None:
    """The pictures jump by 9 m, and the feed with them: what is known is the speed."""
    held = HeldExecutor()
    intrinsics = captures[0].picture.camera.intrinsics
    tracking = CameraTracking(field, intrinsics, DatasetPoses(), held)
    for capture in captures[:4]:
        held.run()
        before = located(tracking, capture)
    assert before.state is LocalisationState.TRACKING
    held.run()
    states = states_while_searching(tracking, held, again_at(captures, 13))
    assert states == [LocalisationState.LOCALISING] * 3 + [LocalisationState.TRACKING] * (
        len(states) - 3
    )
    assert tracking.counts["track_lost"] == 1


def dimmed(field: RadianceField, gain: float) -> SplatField:
    """Return the field in ``gain`` of its light."""
    assert isinstance(field, SplatField)
    sh = field.gaussians.sh * np.float32(gain)
    sh[:, 0] += np.float32((gain - 1) * 0.5 / SH_DC)
    return SplatField(replace(field.gaussians, sh=sh), field.metadata, threads=2)


@pytest.mark.sample
def test_a_vehicle_that_localises_takes_the_light_that_fits(
    field: RadianceField, captures: list[Capture]
) -> None:
    """It is found in the field of noon, then in the light that arrives: its frames are coded
    against that one, and name it."""
    dim = dimmed(field, 0.4)
    wanted: list[int] = []
    lights = TileLights(field, lambda: wanted.append(1))
    intrinsics = captures[0].picture.camera.intrinsics
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px, effort="fast")

    def darker(capture: Capture) -> Capture:
        rgb = (0.4 * capture.picture.read()).astype(np.uint8)
        return replace(capture, picture=replace(capture.picture, read=lambda: rgb))

    made = None
    with ThreadPoolExecutor(1) as searcher:
        tracking = CameraTracking(lights, intrinsics, DatasetPoses(), searcher, patient=True)
        options = PipelineOptions(poses=tracking, lights=lights)
        pipeline = Pipeline(field, config, lambda: 0, options)
        for capture in captures[:3]:
            made = pipeline.encode(EncodeJob(darker(capture), 0, 1))
            if wanted and dim.field_id not in lights.held_ids():
                lights.add(dim)
    assert made is not None
    assert made.pose is not None
    assert made.pose_state is LocalisationState.TRACKING
    assert made.field_id == dim.field_id
    camera = Camera(intrinsics, made.pose)
    assert render_field_view(dim, camera).render.digest().startswith(made.packet.render_digest)
    true = captures[2].picture.camera.world_from_cam.translation_m
    assert math.dist(made.pose.translation_m, true) < 0.3


@pytest.mark.sample
def test_where_no_clock_runs_a_search_is_waited_for(
    field: RadianceField, captures: list[Capture]
) -> None:
    intrinsics = captures[0].picture.camera.intrinsics
    with ThreadPoolExecutor(1) as searcher:
        tracking = CameraTracking(field, intrinsics, DatasetPoses(), searcher, patient=True)
        assert [located(tracking, capture).state for capture in captures[:3]] == [
            LocalisationState.TRACKING
        ] * 3


def test_an_agent_that_was_not_asked_to_localise_does_not_load_opencv() -> None:
    program = "import sys, cav_agent.__main__, cav_agent.vehicle; print('cv2' in sys.modules)"
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == "False"


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no niceness of their own")
def test_the_searching_thread_lets_the_others_go_first() -> None:
    def niceness() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    before = niceness()
    with ThreadPoolExecutor(1, initializer=yield_to_frames) as searcher:
        assert searcher.submit(niceness).result() == min(before + SEARCH_NICENESS, 19)
    assert niceness() == before
