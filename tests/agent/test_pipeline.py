"""From a captured picture to a packet that a server takes, however noisy the picture."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cav_agent.frames import Capture, EncodeJob
from cav_agent.pipeline import Pipeline
from cav_agent.rate_control import ByteBudget
from rfcore.camera import Camera
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.sender.steering import Steering
from rfcore.field import Quality
from rfcore.views import View

LIMIT_BYTES = 300


class Grey:
    """A field that has seen nothing."""

    def render(self, camera: Camera, quality: Quality) -> View:  # noqa: ARG002
        k = camera.intrinsics
        side = (k.height_px, k.width_px)
        flat = np.full(side, 0.5, np.float32)
        return View(np.full((*side, 3), 0.5, np.float32), flat * 10, flat)


@pytest.fixture
def noisy(make_capture: Callable[..., Capture]) -> Capture:
    capture = make_capture(0)
    pixels = np.random.default_rng(3).integers(0, 256, (16, 32, 3), dtype=np.uint8)
    return replace(capture, picture=replace(capture.picture, read=lambda: pixels))


def test_a_noise_picture_is_coded_until_its_slice_is_below_the_limit(noisy: Capture) -> None:
    config = CodecConfig(32, 16, preset="ultrafast", crf=10)
    free = Pipeline(Grey(), config, lambda: 0).encode(EncodeJob(noisy, 0, 1))
    made = Pipeline(Grey(), config, lambda: 0, LIMIT_BYTES).encode(EncodeJob(noisy, 0, 1))
    assert free.tries == 1
    assert len(free.packet.payload) > LIMIT_BYTES >= len(made.packet.payload)
    assert made.tries > 1


def test_block_means_are_sent_only_where_the_server_is_not_exact(noisy: Capture) -> None:
    pipeline = Pipeline(Grey(), CodecConfig(32, 16, preset="ultrafast"), lambda: 0)
    lengths = [
        len(pipeline.encode(EncodeJob(noisy, 0, 1, exact=exact)).packet.render_block_means)
        for exact in (True, False)
    ]
    assert lengths == [0, 64]


def test_a_budget_of_bytes_is_aimed_at_and_costs_quality(noisy: Capture) -> None:
    config = CodecConfig(32, 16, preset="ultrafast", crf=10)
    pipeline = Pipeline(Grey(), config, lambda: 0)
    crfs, lengths = [], []
    for target in (1e6, 150.0, 150.0):
        made = pipeline.encode(EncodeJob(noisy, 0, 1, budget=ByteBudget(target, 10_000)))
        crfs.append(made.crf)
        lengths.append(len(made.packet.payload))
    assert crfs[0] == 10
    assert crfs[1] > 20
    assert lengths[2] < 0.5 * lengths[0]


def test_a_map_reaches_the_encoder(noisy: Capture) -> None:
    config = CodecConfig(32, 16, preset="ultrafast", crf=30)
    coarser = Steering(QpMap(np.full((1, 2), 12, np.int8)))
    plain = Pipeline(Grey(), config, lambda: 0).encode(EncodeJob(noisy, 0, 1))
    made = Pipeline(Grey(), config, lambda: 0, steering=coarser).encode(EncodeJob(noisy, 0, 1))
    assert len(made.packet.payload) < 0.7 * len(plain.packet.payload)


def test_the_pose_sent_is_the_one_that_was_rendered(noisy: Capture) -> None:
    """A grey field says nothing of the pose, so the measured one stays, and time is told."""
    config = CodecConfig(32, 16, preset="ultrafast")
    pipeline = Pipeline(Grey(), config, lambda: 0, steering=Steering(refine_pose_ms=50))
    made = pipeline.encode(EncodeJob(noisy, 0, 1))
    assert made.pose == noisy.picture.camera.world_from_cam
    assert "refine" in made.stage_s
