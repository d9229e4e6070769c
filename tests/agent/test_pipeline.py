"""From a captured picture to a packet that a server takes, however noisy the picture."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cav_agent.camera_poses import CameraLocation
from cav_agent.deadline import FixedRung
from cav_agent.frames import Capture, EncodeJob
from cav_agent.pipeline import Pipeline, PipelineOptions, Stopwatch
from cav_agent.rate_control import ByteBudget
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig, LightChange
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.references import Reference
from rfcore.codec.sender.ladder import Rung
from rfcore.errors import InvalidInput
from rfcore.field import Quality, render_field_view
from rfcore.image import I420, Rgb
from rfcore.localise.estimate import LocalisationState
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView, View
from rfcore.wire.messages import FrameAddress, PoseAhead

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
    config = CodecConfig(32, 16, effort="fast", crf=10)
    free = Pipeline(Grey(), config, lambda: 0).encode(EncodeJob(noisy, 0, 1))
    made = Pipeline(Grey(), config, lambda: 0, PipelineOptions(LIMIT_BYTES)).encode(
        EncodeJob(noisy, 0, 1)
    )
    assert free.tries == 1
    assert len(free.packet.payload) > LIMIT_BYTES >= len(made.packet.payload)
    assert made.tries > 1


def test_the_error_is_that_of_the_picture_that_the_server_decodes(noisy: Capture) -> None:
    pipeline = Pipeline(Grey(), CodecConfig(32, 16, effort="fast", crf=30), lambda: 0)
    made = pipeline.encode(EncodeJob(noisy, 0, 1))
    view = render_field_view(Grey(), noisy.picture.camera.rounded(), made.rung.quality)
    decoder = DeltaDecoder(pipeline.header)
    shown = decoder.decode(decoder.start(), made.packet, view).frame
    difference = shown.y.astype(float) - i420_from_rgb(noisy.picture.read()).y
    assert made.luma_mse == pytest.approx(np.mean(difference**2))
    assert made.luma_mse > 1


def test_block_means_are_sent_only_where_the_server_is_not_exact(noisy: Capture) -> None:
    pipeline = Pipeline(Grey(), CodecConfig(32, 16, effort="fast"), lambda: 0)
    lengths = [
        len(pipeline.encode(EncodeJob(noisy, 0, 1, exact=exact)).packet.render_block_means)
        for exact in (True, False)
    ]
    assert lengths == [0, 64]


@pytest.mark.parametrize(("light", "changed"), [(LightChange.AUTO, True), (LightChange.OFF, False)])
def test_the_light_is_changed_as_the_settings_allow(
    make_capture: Callable[..., Capture], light: LightChange, changed: bool
) -> None:
    """The street is darker on one side than the field shows it, which no matrix says."""
    ramp = np.linspace(200, 20, 64)[None, :, None] + np.zeros((48, 64, 3))
    noise = np.random.default_rng(1).normal(0, 3, ramp.shape)
    pixels = np.clip(ramp + noise, 0, 255).astype(np.uint8)
    k = Intrinsics(64, 48, 64.0, 64.0, 32.0, 24.0)
    captures = [make_capture(index) for index in range(2)]
    seen = [
        replace(
            c, picture=replace(c.picture, camera=Camera(k, Pose.identity()), read=lambda: pixels)
        )
        for c in captures
    ]
    options = PipelineOptions(light=light)
    pipeline = Pipeline(Grey(), CodecConfig(64, 48, effort="fast"), lambda: 0, options)
    first = pipeline.encode(EncodeJob(seen[0], 0, 1))
    base = FrameAddress("front", 0, first.packet.sequence)
    second = pipeline.encode(EncodeJob(seen[1], 0, 1, base))
    assert not first.packet.relit
    assert second.packet.relit == changed
    assert changed or not (first.packet.photometric or second.packet.photometric)


def test_a_budget_of_bytes_is_aimed_at_and_costs_quality(noisy: Capture) -> None:
    config = CodecConfig(32, 16, effort="fast", crf=10)
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
    config = CodecConfig(32, 16, effort="fast", crf=30)
    coarser = QpMap(np.full((1, 2), 12, np.int8))
    plain = Pipeline(Grey(), config, lambda: 0).encode(EncodeJob(noisy, 0, 1))
    made = Pipeline(Grey(), config, lambda: 0, PipelineOptions(qp_map=coarser)).encode(
        EncodeJob(noisy, 0, 1)
    )
    assert len(made.packet.payload) < 0.7 * len(plain.packet.payload)


class Places:
    """Finds the pose of every second frame, where the dataset has it."""

    def __init__(self) -> None:
        self.calls = 0

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> CameraLocation:  # noqa: ARG002
        self.calls += 1
        if self.calls % 2:
            return CameraLocation(None, None, LocalisationState.LOCALISING)
        camera = capture.picture.camera.rounded()
        view = render_field_view(Grey(), camera, rung.quality)
        return CameraLocation(camera, camera.world_from_cam, LocalisationState.TRACKING, view=view)


def test_lost_frames_are_coded_without_the_field_and_found_ones_with_it(noisy: Capture) -> None:
    config, options = CodecConfig(32, 16, effort="fast"), PipelineOptions(poses=Places())
    pipeline = Pipeline(Grey(), config, lambda: 0, options)
    decoder = DeltaDecoder(pipeline.header)
    state, base = decoder.start(0), None
    for number, references in enumerate([(), None, (Reference.PREVIOUS,), None]):
        made = pipeline.encode(EncodeJob(noisy, 0, 1, base=base))
        lost = number % 2 == 0
        assert (made.pose is None) == lost
        assert references is None or made.packet.references == references
        camera = noisy.picture.camera
        view = FieldView.nothing(camera.intrinsics)
        if not lost:
            view = render_field_view(Grey(), camera.rounded())
        state = decoder.decode(state, made.packet, view).state
        base = FrameAddress("front", 0, number)


class StepClock:
    """A clock that advances by a millisecond whenever it is read."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        self.now_ns += 1_000_000
        return self.now_ns


class RecordedRungs(FixedRung):
    """One rung; keeps what it was told of every frame."""

    def __init__(self) -> None:
        super().__init__(Rung(effort="fast"))
        self.sender_s: list[float] = []
        self.in_field: list[bool] = []

    def coded(self, sender_s: float, now: float, instant: int, *, in_field: bool) -> None:
        del now, instant
        self.sender_s.append(sender_s)
        self.in_field.append(in_field)


def test_rungs_hear_which_frames_were_coded_without_the_field(noisy: Capture) -> None:
    rungs = RecordedRungs()
    options = PipelineOptions(rungs=rungs, poses=Places())
    pipeline = Pipeline(Grey(), CodecConfig(32, 16, effort="fast"), StepClock(), options)
    for _ in range(4):
        pipeline.encode(EncodeJob(noisy, 0, 1))
    assert rungs.in_field == [False, True, False, True]


def test_loading_the_picture_is_measured_apart_from_the_senders_stages(noisy: Capture) -> None:
    clock, rungs = StepClock(), RecordedRungs()

    def load() -> Rgb:
        clock.now_ns += 700_000_000  # a slow disk
        return noisy.picture.read()

    slow = replace(noisy, picture=replace(noisy.picture, read=load))
    config = CodecConfig(32, 16, effort="fast")
    made = Pipeline(Grey(), config, clock, PipelineOptions(rungs=rungs)).encode(
        EncodeJob(slow, 0, 1)
    )
    assert made.read_s == pytest.approx(0.701)
    assert list(made.stage_s)[:2] == ["convert", "render"]
    assert made.sender_s == pytest.approx(sum(made.stage_s.values()))
    assert made.sender_s < 0.1
    assert rungs.sender_s == [made.sender_s], "a deadline is not missed by a slow disk"


def test_laps_add_up_to_the_time_that_passed() -> None:
    clock = StepClock()
    watch = Stopwatch(clock)
    began_ns = clock.now_ns
    laps = [watch.lap_s() for _ in range(5)]
    assert sum(laps) == pytest.approx((clock.now_ns - began_ns) / 1e9)


def test_a_picture_of_another_size_is_refused_by_name_and_both_sizes(noisy: Capture) -> None:
    pipeline = Pipeline(Grey(), CodecConfig(64, 16, effort="fast"), lambda: 0)
    with pytest.raises(InvalidInput, match=r"000\.png: 32x16 px, the stream is coded at 64x16 px"):
        pipeline.encode(EncodeJob(noisy, 0, 1))


def test_a_base_that_is_no_longer_kept_counts_as_none(noisy: Capture) -> None:
    pipeline = Pipeline(Grey(), CodecConfig(32, 16, effort="fast"), lambda: 0)
    gone = FrameAddress("front", 7, 99)
    packet = pipeline.encode(EncodeJob(noisy, 0, 1, base=gone)).packet
    assert packet.base_digest == b""
    kept = FrameAddress("front", packet.epoch, packet.sequence)
    assert pipeline.encode(EncodeJob(noisy, 0, 1, base=kept)).packet.sequence == 1


def test_the_pose_is_announced_before_anything_is_rendered(noisy: Capture) -> None:
    announced: list[PoseAhead] = []

    class Late(Grey):
        def render(self, camera: Camera, quality: Quality) -> View:
            assert announced
            return super().render(camera, quality)

    pipeline = Pipeline(Late(), CodecConfig(32, 16, effort="fast"), lambda: 0)
    noisy = replace(noisy, instant=7)
    for epoch, sequence in ((3, 0), (3, 1), (4, 0)):
        made = pipeline.encode(EncodeJob(noisy, epoch, 1), announced.append)
        (ahead,) = announced
        assert (ahead.epoch, ahead.sequence, ahead.instant) == (epoch, sequence, 7)
        assert (made.packet.epoch, made.packet.sequence) == (epoch, sequence)
        assert (ahead.pose, ahead.field_id, ahead.quality) == (
            made.pose,
            made.field_id,
            made.rung.quality,
        )
        announced.clear()
