"""OpenCL draws the bytes of the native kernels, in every build, or is refused, or left in time."""

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from structlog.testing import capture_logs

from forward_isas import DEVICE, GUARDED, OPENCL, WORST_CASE, opened, until_gone
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.field import FieldMetadata, Quality, SplatField, render_field_view
from rfcore.image import I420
from rfcore.native.backend import available_isas
from rfcore.native.yuv import field_view_from_view
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.opencl.device import Device, build_device, find_device
from rfcore.raster.opencl.renderer import DeviceRasterizer
from rfcore.raster.opencl.self_check import (
    ARITHMETIC_DIGESTS,
    CHECKS,
    OPERATIONS,
    arithmetic_operands,
    bytes_of,
    canonical,
    check_device,
    check_gaussians,
    digest,
    open_device,
)
from rfcore.raster.renderers import DEVICES
from rfcore.views import FieldView, View
from tests.raster.conftest import camera, scene

F32 = np.float32

FUZZED_SCENES, VIEWS_OF_A_SCENE = 60, 2

slow = pytest.mark.slow


def view_on(device: Device, gaussians: Gaussians, camera: Camera, antialiased: bool) -> View:
    shape = (camera.intrinsics.height_px, camera.intrinsics.width_px)
    view = View(*(np.full(s, np.nan, F32) for s in ((*shape, 3), shape, shape)))
    rasterizer = DeviceRasterizer(device, gaussians, antialiased=antialiased)
    rasterizer.draw(camera, gaussians.sh_degree, view.colour, view.depth, view.opacity)
    return view


def view_bytes(view: View) -> bytes:
    return view.colour.tobytes() + view.depth.tobytes() + view.opacity.tobytes()


def fuzzed_gaussians(rng: np.random.Generator) -> Gaussians:
    """Return up to 600 Gaussians, a part of them of any size, at any place, with any quaternion."""
    count, degree = int(rng.integers(0, 600)), int(rng.integers(0, 4))
    tame = rng.random(count) < 0.6
    means = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3, 6, (count, 1))
    means[tame] = rng.uniform((-3, -2, 0.005), (3, 2, 8), (tame.sum(), 3))
    quaternions = rng.normal(size=(count, 4))
    wild = rng.random(count) < 0.3
    quaternions[wild] *= 10.0 ** rng.uniform(-44, 38, (wild.sum(), 1))
    quaternions[rng.random((count, 4)) < 0.1] = 0
    log_scales = rng.uniform(-45, 20, (count, 3))
    small = rng.random(count) < 0.7
    log_scales[small] = rng.uniform(-7, 1, (small.sum(), 3))
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 10.0 ** rng.uniform(-40, 4, (count, 1, 1))
    arrays = (means, quaternions, log_scales, rng.uniform(-9, 12, count), sh)
    return Gaussians(*(np.clip(a, -3e38, 3e38).astype(F32) for a in arrays))


def fuzzed_camera(rng: np.random.Generator) -> Camera:
    width, height = (int(side) for side in rng.integers(1, 400, 2))
    fx = float(10 ** rng.uniform(-0.5, 1)) * width
    centre = (float(rng.uniform(-0.2, 1.2)) * width, float(rng.uniform(0, 1)) * height)
    ahead = rng.random() < 0.5
    w, x, y, z = (1.0, 0.02, -0.03, 0.05) if ahead else (float(v) for v in rng.normal(size=4))
    norm = (w * w + x * x + y * y + z * z) ** 0.5
    east, north, up = (float(v) for v in rng.normal(size=3) * 0.3)
    return Camera(
        Intrinsics(width, height, fx, fx * float(rng.uniform(0.7, 1.4)), *centre),
        Pose((east, north, up), (w / norm, x / norm, y / norm, z / norm)),
    )


@slow
@pytest.mark.parametrize("isa", [OPENCL, GUARDED, WORST_CASE])
def test_fuzzed_views_have_the_bytes_of_the_native_kernels(isa):
    device, covered = opened(isa), 0
    for seed in range(FUZZED_SCENES):
        rng = np.random.default_rng(seed)
        gaussians, antialiased = fuzzed_gaussians(rng), bool(rng.integers(0, 2))
        native = Rasterizer(gaussians, antialiased=antialiased)
        for at in [fuzzed_camera(rng) for _ in range(VIEWS_OF_A_SCENE)]:
            want = native.render(at)
            got = view_on(device, gaussians, at, antialiased)
            assert view_bytes(got) == view_bytes(want), seed
            covered += int((want.opacity > 0).sum())
    assert covered > 1e6


@slow
def test_a_compiler_that_contracts_unasked_is_refused_by_its_picture(unguarded):
    """Without it the tests of the worst build would show nothing.

    PoCL divides exactly in this build; NVIDIA's compiler does not and is refused before it draws.
    """
    problem = "its picture of 200x120" if DEVICE == "Portable" else "a quotient|its picture"
    with pytest.raises(BackendUnavailable, match=f"unguarded build: ({problem})"):
        check_device(build_device(find_device(DEVICE), unguarded))


def test_the_check_holds_devices_to_ieee_arithmetic():
    x, y, z = arithmetic_operands()
    fused = ctypes.CDLL("libm.so.6").fmaf
    fused.argtypes, fused.restype = [ctypes.c_float] * 3, ctypes.c_float
    triples = zip(x.tolist(), y.tolist(), z.tolist(), strict=True)
    with np.errstate(all="ignore"):
        results = (x + y, x * y, x / y, np.sqrt(np.abs(x)), fused_all(fused, triples), np.floor(x))
        digests = [digest(canonical(result)) for result in results]
    assert dict(zip(OPERATIONS, digests, strict=True)) == ARITHMETIC_DIGESTS


def fused_all(fused: Callable[..., float], triples: object) -> np.ndarray:
    return np.array([fused(*triple) for triple in triples], F32)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.want)
def test_the_check_holds_devices_to_the_native_kernels(check):
    rasterizer = Rasterizer(check_gaussians(), antialiased=check.antialiased)
    view = rasterizer.render(check.camera, sh_degree=check.degree)
    assert digest(view.colour, view.depth, view.opacity) == check.want
    assert 0.5 < view.opacity.mean() < 0.95


@slow
@pytest.mark.parametrize("isa", [OPENCL, GUARDED, WORST_CASE])
@pytest.mark.parametrize("size_px", [(64, 48), (63, 47), (1, 1), (2, 5)])
def test_a_device_makes_the_codecs_picture_of_what_it_draws(isa, size_px):
    width, height = size_px
    camera = Camera(Intrinsics(width, height, 40.0, 40.0, width / 2, height / 2), Pose.identity())
    gaussians = scene(500)
    want = field_view_from_view(Rasterizer(gaussians).render(camera), camera)
    picture = I420.empty(size_px)
    drawn_by = DeviceRasterizer(opened(isa), gaussians, antialiased=False)
    planes = drawn_by.draw_codec_picture(camera, gaussians.sh_degree, picture)
    assert bytes_of(FieldView(camera, picture, *map(drawn_by.fetch, planes))) == bytes_of(want)
    assert want.kept_opacity.any()


@slow
def test_a_fields_view_is_the_same_from_a_device():
    """Also while the device is lost, and at half the size, where the CPU makes the picture."""
    fields = [SplatField(scene(2000), FieldMetadata(), isa=isa) for isa in (OPENCL, None)]
    for quality in (Quality(), Quality(scale=0.5)):
        views = [render_field_view(field, camera(), quality) for field in fields]
        assert bytes_of(views[0]) == bytes_of(views[1])
    assert fields[0].is_on_device
    device = fields[0].rasterizer(1.0)._device
    device._kernels["codec_picture"] = until_gone(device._kernels["codec_picture"], iter(()))
    views = [render_field_view(field, camera()) for field in fields]
    assert bytes_of(views[0]) == bytes_of(views[1])
    assert fields[0].rasterizer(1.0).isa == available_isas()[0]
    assert not fields[0].is_on_device


@slow
def test_an_opened_device_is_named_with_its_driver():
    Rasterizer(scene(3), isa=OPENCL)
    assert ("PoCL" if DEVICE == "Portable" else DEVICE) in open_device(DEVICE).description


@slow
def test_another_thread_count_of_a_device_is_drawn_by_it_too():
    first = Rasterizer(scene(3), isa=OPENCL)
    own = first.with_threads(2)
    assert own.isa == OPENCL
    assert own._device is not first._device
    assert view_bytes(own.render(camera())) == view_bytes(first.render(camera()))


@slow
def test_a_device_that_is_not_there_is_refused_by_name():
    with pytest.raises(BackendUnavailable, match=r"'voodoo'.*there is 0: "):
        Rasterizer(scene(3), isa="opencl:voodoo")
    with pytest.raises(BackendUnavailable, match="'99'"):
        Rasterizer(scene(3), isa="opencl:99")


@slow
@pytest.mark.parametrize("call", range(0, 40, 3))
def test_a_device_removed_in_a_picture_costs_no_picture(call):
    """The device is gone from the ``call``-th command on; a picture has about 60."""
    gaussians = scene(3000)
    want = view_bytes(Rasterizer(gaussians).render(camera()))
    rasterizer = Rasterizer(gaussians, isa=OPENCL)
    assert view_bytes(rasterizer.render(camera())) == want
    left = iter(range(call))
    device = rasterizer._device
    for name, kernel in list(device._kernels.items()):
        device._kernels[name] = until_gone(kernel, left)
    lost = DEVICES.lost
    with capture_logs() as logs:
        assert view_bytes(rasterizer.render(camera())) == want
        assert view_bytes(rasterizer.render(camera())) == want
    assert DEVICES.lost == lost + 1
    assert [line["event"] for line in logs] == ["opencl device lost"]
    assert rasterizer.isa == available_isas()[0]


@slow
@pytest.mark.parametrize(
    "quality",
    [Quality(0.5), Quality(0.1, sh_degree=1), Quality(scale=0.5), Quality(0.25, 0, None, 0.5)],
)
def test_every_reduced_quality_of_a_field_has_the_bytes_of_the_cpu(quality, antialiased):
    metadata = FieldMetadata(antialiased=antialiased)
    want = SplatField(scene(500), metadata).render(camera(130, 90), quality)
    field = SplatField(scene(500), metadata, isa=OPENCL)
    assert view_bytes(field.render(camera(130, 90), quality)) == view_bytes(want)
    alone = field.render_colour(camera(130, 90), quality)
    assert alone.tobytes() == want.colour.tobytes()


@slow
def test_threads_that_share_a_device_get_their_own_pictures():
    """Two fields, the first with two threads; every thread turns its own way."""
    fields = [scene(900, seed=1), scene(700, seed=2)]
    devices = [Rasterizer(gaussians, isa=OPENCL) for gaussians in fields]
    cameras = [camera(width, 90) for width in (50, 130, 90, 170)]
    jobs = [(0, cameras), (0, cameras[::-1]), (1, cameras[1:] + cameras[:1])]

    def drawn(rasterizers: list[Rasterizer], job: tuple[int, list[Camera]]) -> list[bytes]:
        return [view_bytes(rasterizers[job[0]].render(view_from)) for view_from in 3 * job[1]]

    want = [drawn([Rasterizer(gaussians) for gaussians in fields], job) for job in jobs]
    with ThreadPoolExecutor(len(jobs)) as pool:
        assert list(pool.map(lambda job: drawn(devices, job), jobs)) == want
    assert [device.isa for device in devices] == [OPENCL, OPENCL]


@slow
def test_a_picture_too_large_for_the_device_is_drawn_by_the_cpu(monkeypatch):
    rasterizer = Rasterizer(scene(300), isa=OPENCL)
    want = view_bytes(rasterizer.render(camera()))
    with monkeypatch.context() as patch, capture_logs() as logs:
        patch.setattr("rfcore.raster.opencl.renderer.MAX_TILE_ENTRIES", 10)
        assert view_bytes(rasterizer.render(camera())) == want
    assert [line["event"] for line in logs] == ["opencl picture drawn by cpu"]
    assert rasterizer.isa == OPENCL


@slow
def test_overlaps_are_counted_and_limited_as_by_the_native_kernels(monkeypatch):
    """They count overlaps with groups of 4x4 tiles; here they are counted anew from the tiles."""
    gaussians, view_from = scene(400), camera(517, 333)
    gaussians.log_scales[::7] += 2
    rasterizer = Rasterizer(gaussians, isa=OPENCL)
    rasterizer.render_colour(view_from)
    statistics, device = rasterizer.statistics(view_from), rasterizer._device
    assert device is not None
    tiles = read(device, "tiles", statistics.tile_entries)
    groups = tiles // 33 // 4 * 9 + tiles % 33 // 4
    overlaps = np.unique(
        groups.astype(np.uint64) << np.uint64(32) | read(device, "entries", len(tiles))
    )
    assert np.all(np.diff(tiles.astype(int)) >= 0)
    assert int(read(device, "group_counts", statistics.visible).sum()) == len(overlaps)
    monkeypatch.setattr("rfcore.raster.opencl.renderer.MAX_GROUP_ENTRIES", len(overlaps))
    rasterizer.render_colour(view_from)
    monkeypatch.setattr("rfcore.raster.opencl.renderer.MAX_GROUP_ENTRIES", len(overlaps) - 1)
    with pytest.raises(InvalidInput, match=r"gaussians: more than \d+ overlaps"):
        rasterizer.render_colour(view_from)


def read(device: DeviceRasterizer, name: str, count: int) -> np.ndarray:
    import pyopencl as cl

    values = np.empty(count, np.uint32)
    cl.enqueue_copy(device._queue, values, device._memory[name])
    return values
