"""Warps and corrections of OpenCL devices are the CPU's, and until then depth stays on the device.

The CPU's are held to their definition in tests/native/test_warp.py.
"""

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_isas import DEVICE, GUARDED, OPENCL, WORST_CASE, opened, until_gone
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import Past, Reference
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.errors import BackendUnavailable
from rfcore.field import Quality, SplatField, render_field_view
from rfcore.image import I420
from rfcore.motion import quaternion_from_vector
from rfcore.native.warp import correct_i420, warp_i420
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.opencl.device import BUILDS, build_device, find_device
from rfcore.raster.opencl.renderer import DeviceRasterizer
from rfcore.raster.opencl.self_check import WARP_CASES, carried_on, check_device
from rfcore.views import FieldView, HeldFieldView
from tests.raster.conftest import camera, scene

F32 = np.float32
FRAMES = 4

slow = pytest.mark.slow
every_build = pytest.mark.parametrize("isa", [OPENCL, GUARDED, WORST_CASE])


@cache
def carrier(isa: str) -> DeviceRasterizer:
    nothing = Gaussians(*(np.zeros((0, *rest), F32) for rest in ((3,), (4,), (3,), (), (1, 3))))
    return DeviceRasterizer(opened(isa), nothing, antialiased=False)


def noise(rng: np.random.Generator, size_px: tuple[int, int]) -> I420:
    shapes = [plane.shape for plane in I420.empty(size_px).planes]
    return I420(*(rng.integers(0, 256, shape, dtype=np.uint8) for shape in shapes))


def rough(rng: np.random.Generator, size_px: tuple[int, int]) -> np.ndarray:
    """A wall with a step and a little relief; a part of it holes, and depths of any size."""
    width, height = size_px
    depth = rng.uniform(4, 4 + rng.choice([0.01, 2]), (height, width))
    depth[:, int(rng.integers(0, width)) :] *= rng.choice([1, 1.5])
    odd = rng.random((height, width)) < 0.1
    depth[odd] = rng.choice([0, -1, 1e-40, 1e-30, 1e30, 3e38, 0.1], odd.sum())
    return depth.astype(F32)


@given(
    size_px=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    step_m=st.tuples(*[st.floats(-0.5, 0.5) | st.floats(-1e6, 1e6)] * 3),
    turn=st.tuples(*[st.floats(-0.1, 0.1) | st.floats(-3, 3)] * 3),
    seed=st.integers(0, 1 << 32),
)
@settings(max_examples=60, deadline=None)
def assert_carried(
    isa: str,
    size_px: tuple[int, int],
    step_m: tuple[float, float, float],
    turn: tuple[float, float, float],
    seed: int,
) -> None:
    rng, (width, height) = np.random.default_rng(seed), size_px
    focal, shift = float(rng.uniform(0.3, 2)) * width, float(rng.uniform(-0.2, 0.2))
    lens = Intrinsics(width, height, focal, 1.1 * focal, (0.5 + shift) * width, height / 2)
    before, now = (
        FieldView(Camera(lens, pose), noise(rng, size_px), rough(rng, size_px))
        for pose in (Pose.identity(), Pose(step_m, quaternion_from_vector(turn)))
    )
    previous = noise(rng, size_px)
    for minus, make in ((None, warp_i420), (before.render, correct_i420)):
        made = carried_on(carrier(isa), previous, minus, before, now)
        assert made.packed() == make(previous, before, now).packed()


@slow
@every_build
def test_any_warp_and_correction_has_the_bytes_of_the_cpu(isa):
    assert_carried(isa)


@pytest.mark.parametrize("case", WARP_CASES, ids=lambda case: str(case.size_px))
def test_the_check_has_something_to_carry(case):
    """But from behind, where everything is the render's."""
    previous, before, now = case.given()
    warped = warp_i420(previous, before, now)
    carried = np.mean(warped.y != np.maximum(now.render.y, 1))
    assert (carried > 0.1) == (case.turn != (0, 0, 1, 0))


@slow
@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        (
            "PRODUCT(far, along) + warp->translation[axis]",
            "fma(far, along, warp->translation[axis])",
        ),
        ("#define RELATIVE 0.08f", "#define RELATIVE 0.081f"),
        ("#define ABSOLUTE_M 0.1f", "#define ABSOLUTE_M 0.11f"),
        ("at_x <= (float)(width - 1)", "at_x < (float)(width - 1)"),
        ("is_pair ? 2 * STEPS : 0", "2 * STEPS"),
        ("clamp(left + i, 0, width - 1)", "clamp(left + i, 0, width - 2)"),
        ("sum - clamp(sum >> 2", "sum - clamp(sum >> 3"),
        ("render, 1, 255)", "render, 0, 255)"),
    ],
)
def test_a_device_that_carries_otherwise_is_refused(monkeypatch, right, wrong):
    from rfcore.raster.opencl import device

    source = device._source()
    assert right in source
    monkeypatch.setattr(device, "_source", lambda: source.replace(right, wrong))
    with pytest.raises(BackendUnavailable, match=r"plain build: its (warp|correction) of \d+x\d+"):
        check_device(build_device(find_device(DEVICE), BUILDS[0]))


@dataclass
class Traffic:
    """Bytes copied to and from devices."""

    up: int = 0
    down: int = 0


@pytest.fixture
def traffic(monkeypatch: pytest.MonkeyPatch) -> Traffic:
    import pyopencl as cl

    counted, copy = Traffic(), cl.enqueue_copy

    def counting(queue: Any, to: Any, source: Any, **named: Any) -> Any:
        if isinstance(to, np.ndarray):
            counted.down += to.nbytes
        elif isinstance(source, np.ndarray):
            counted.up += source.nbytes
        return copy(queue, to, source, **named)

    monkeypatch.setattr(cl, "enqueue_copy", counting)
    return counted


def drive(camera: Camera, frames: int = FRAMES) -> list[Camera]:
    """Go ahead and turn a little."""
    east, north, up = camera.world_from_cam.translation_m
    rotation = camera.world_from_cam.rotation
    poses = [Pose((east + 0.02 * n, north, up + 0.05 * n), rotation) for n in range(frames)]
    return [replace(camera, world_from_cam=pose).rounded() for pose in poses]


def decoded(view: FieldView, number: int) -> I420:
    """Return what a frame may have been decoded to: the render, brighter and noisy."""
    rng = np.random.default_rng(number)
    return I420(*(
        np.clip(plane + rng.integers(-6, 20, plane.shape), 1, 255).astype(np.uint8)
        for plane in view.render.planes
    ))  # fmt: skip


def references(
    field: SplatField, cameras: Sequence[Camera], qualities: Sequence[Quality] = (Quality(),)
) -> list[bytes]:
    """Return all that is predicted from along a drive, as both ends make it."""
    made: list[bytes] = []
    past: Past | None = None
    for number, at in enumerate(cameras):
        view = render_field_view(field, at, qualities[number % len(qualities)])
        prediction = Prediction(view, past)
        made.append(prediction.render.packed())
        if past is not None:
            made += [prediction.warp.packed(), prediction.correction.packed()]
        past = prediction.past_of(decoded(view, number))
    return made


@slow
@pytest.mark.parametrize("isa", [OPENCL, WORST_CASE])
@pytest.mark.parametrize("size_px", [(67, 45), (64, 48), (9, 1), (1, 7)])
def test_references_of_a_drive_are_those_of_the_cpu(isa, size_px):
    cameras = drive(camera(*size_px))
    want = references(SplatField(scene(800)), cameras)
    assert references(SplatField(scene(800), isa=isa), cameras) == want


@slow
def test_only_pictures_cross_between_device_and_cpu(traffic):
    """Each picture has 1.5 bytes a pixel. The render and the references made of it go down, the
    earlier frame goes up. The rest are counts, camera and poses."""
    field, cameras = SplatField(scene(800), isa=OPENCL), drive(camera(160, 90))
    picture, rest = 160 * 90 * 3 // 2, 1000
    references(field, cameras[:1])
    views = [render_field_view(field, view_from) for view_from in cameras[:2]]
    past = Prediction(views[0]).past_of(decoded(views[0], 0))
    traffic.up = traffic.down = 0
    view = render_field_view(field, cameras[2])
    assert (traffic.up // rest, traffic.down // picture) == (0, 1)
    _ = Prediction(view, past).correction
    assert 2 * picture <= traffic.down < 2 * picture + rest
    _ = Prediction(view, past).warp
    assert 3 * picture <= traffic.down < 3 * picture + rest
    assert picture <= traffic.up < picture + rest
    _ = view.depth
    _ = view.depth
    assert traffic.down - 3 * picture - 160 * 90 * 4 in range(rest)


@slow
def test_a_held_view_is_a_view_like_any_other():
    fields = [SplatField(scene(800), isa=isa) for isa in (OPENCL, None)]
    view, want = (render_field_view(field, camera()) for field in fields)
    assert isinstance(view, HeldFieldView)
    lit = decoded(want, 1)
    for changed in (view.under(lit), replace(view, render=lit), replace(view).under(lit)):
        assert changed.render is lit
        assert np.array_equal(changed.depth, want.depth)
        assert np.array_equal(changed.kept_opacity, want.kept_opacity)
    for dropped in (view.without_opacity(), replace(view).without_opacity()):
        assert dropped.opacity is None
        assert np.array_equal(dropped.depth, want.depth)
    assert np.array_equal(view.confidence, want.confidence)
    assert replace(view).held_depth is None
    assert view.under(lit).held_depth is view.held_depth


@slow
def test_views_of_which_one_is_not_on_the_device_are_carried_by_the_cpu():
    fields = [SplatField(scene(800), isa=isa) for isa in (None, OPENCL, WORST_CASE)]
    first, second = drive(camera(), 2)
    before, now = ([render_field_view(f, at) for f in fields] for at in (first, second))
    picture = decoded(before[0], 0)
    want = correct_i420(picture, before[0], now[0]).packed()
    for earlier in before:
        for present in now:
            assert correct_i420(picture, earlier, present).packed() == want


@slow
@pytest.mark.parametrize(("sender", "receiver"), [(None, OPENCL), (OPENCL, None), (OPENCL, OPENCL)])
def test_a_drive_is_coded_alike_with_a_device_at_either_end(sender, receiver):
    ends = [SplatField(scene(800), isa=isa) for isa in (sender, receiver, None)]
    cameras = drive(camera(96, 64))
    encoder = DeltaEncoder(CodecConfig(96, 64))
    decoder = DeltaDecoder(encoder.header)
    state, received, plain = encoder.start(1), decoder.start(1), encoder.start(1)
    chosen = FrameChoice(references=(Reference.PREVIOUS, Reference.WARP, Reference.CORRECTION))
    used = set()
    for number, view_from in enumerate(cameras):
        views = [render_field_view(field, view_from) for field in ends]
        frame = decoded(views[2], number)
        choice = chosen if number % 2 else FrameChoice(max_references=4)
        sent = encoder.encode(state, frame, views[0], choice)
        want = encoder.encode(plain, frame, views[2], choice)
        assert sent.packet == want.packet
        shown = decoder.decode(received, sent.packet, views[1])
        assert shown.exact
        assert shown.frame.packed() == sent.reconstruction.packed()
        state, plain, received = sent.state, want.state, shown.state
        used |= set(sent.packet.references)
    decoder.close()
    assert used >= {Reference.WARP, Reference.CORRECTION}


def lose_kernels(field: SplatField, left: Iterator[int], _: pytest.MonkeyPatch) -> None:
    device = field.rasterizer(1.0)._device
    device._kernels = {name: until_gone(k, left) for name, k in device._kernels.items()}


def lose_copies(_: SplatField, left: Iterator[int], monkeypatch: pytest.MonkeyPatch) -> None:
    import pyopencl as cl

    monkeypatch.setattr(cl, "enqueue_copy", until_gone(cl.enqueue_copy, left))


@slow
@pytest.mark.parametrize(
    ("lose", "call"),
    [(lose_kernels, call) for call in range(0, 170, 13)]
    + [(lose_copies, call) for call in range(0, 60, 3)],
)
def test_a_device_lost_anywhere_costs_no_reference(monkeypatch, lose, call):
    """Depth that only the device had is drawn again, and carried by the CPU in that very frame. The
    drive has 174 kernels and 61 copies."""
    cameras = drive(camera())
    want = references(SplatField(scene(800)), cameras)
    field = SplatField(scene(800), isa=OPENCL)
    field.prepare()
    lose(field, iter(range(call)), monkeypatch)
    assert references(field, cameras) == want
    assert field.rasterizer(1.0).isa != OPENCL


@slow
@pytest.mark.parametrize("part", ["depth", "opacity"])
def test_what_a_lost_device_had_is_drawn_again(monkeypatch, part):
    fields = [SplatField(scene(800), isa=isa) for isa in (OPENCL, None)]
    view, want = (render_field_view(field, camera()) for field in fields)
    lose_copies(fields[0], iter(()), monkeypatch)
    assert np.array_equal(getattr(view, part), getattr(want, part))
    assert fields[0].rasterizer(1.0).isa != OPENCL


@slow
def test_planes_beyond_what_a_device_may_hold_come_back(monkeypatch):
    """Three planes stay; the oldest pictures' are the CPU's, and those are carried there."""
    monkeypatch.setattr("rfcore.raster.opencl.renderer.MOST_HELD_BYTES", 3 * 4 * 67 * 45)
    fields, cameras = (
        [SplatField(scene(800), isa=isa) for isa in (OPENCL, None)],
        drive(camera()),
    )
    held, want = ([render_field_view(field, at) for at in cameras] for field in fields)
    device = fields[0].rasterizer(1.0)._device
    assert sum(each() is not None for each in device._held) == 3
    for view, other in zip(held, want, strict=True):
        picture = decoded(other, 0)
        made, wanted = (
            correct_i420(picture, a, b) for a, b in ((view, held[-1]), (other, want[-1]))
        )
        assert made.packed() == wanted.packed()
        assert np.array_equal(view.depth, other.depth)
        assert np.array_equal(view.kept_opacity, other.kept_opacity)


@slow
def test_buffers_of_dropped_views_are_used_again(monkeypatch):
    import pyopencl as cl

    field, cameras, made = SplatField(scene(800), isa=OPENCL), drive(camera()), []
    references(field, cameras)

    def counted(context: Any, flags: Any, size: int) -> cl.Buffer:
        made.append(size)
        return buffer(context, flags, size)

    buffer = cl.Buffer
    monkeypatch.setattr(cl, "Buffer", counted)
    references(field, 3 * cameras)
    assert not made


@slow
@pytest.mark.parametrize("most_planes", [1, 5, 1000])
def test_streams_that_share_a_device_get_their_own_references(monkeypatch, most_planes):
    """Each changes its level of detail, which another rasterizer draws; planes that make room for
    another stream's may be in use."""
    monkeypatch.setattr("rfcore.raster.opencl.renderer.MOST_HELD_BYTES", most_planes * 4 * 67 * 45)
    drives = [drive(camera(67, height), 6) for height in (45, 44, 31, 45)]
    qualities = [(Quality(), Quality(0.5)), (Quality(),), (Quality(0.5), Quality()), (Quality(),)]
    plain = SplatField(scene(800))
    want = [references(plain, each, q) for each, q in zip(drives, qualities, strict=True)]
    field = SplatField(scene(800), isa=OPENCL)
    together = threading.Barrier(len(drives))

    def stream(job: tuple[list[Camera], Sequence[Quality]]) -> list[bytes]:
        together.wait()
        return references(field, *job)

    with ThreadPoolExecutor(len(drives)) as pool:
        assert list(pool.map(stream, zip(drives, qualities, strict=True))) == want
    assert field.rasterizer(1.0).isa == field.rasterizer(0.5).isa == OPENCL
