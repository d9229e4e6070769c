"""Tests an OpenCL device before it is used.

A driver's own claims do not help: one that reports neither fused multiply-add nor correct rounding
may be exact, and another that reports both may contract. So the device's arithmetic is compared on
bit patterns, and whole pictures with the digests of the native kernels, which reach every path:
all SH degrees, both modes, splats of all sizes, ties, several batches a tile, opaque pixels. Its
codec pictures, warps and corrections are compared with those of the CPU: odd sizes, holes, steps of
depth, depths of any size, poses that leave the earlier picture.

``open_device`` opens one for the process, and only once it has passed.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from threading import Lock
from time import perf_counter

import numpy as np
import structlog
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import BackendUnavailable
from rfcore.extras import needs
from rfcore.image import I420
from rfcore.native.warp import correct_i420, warp_i420
from rfcore.native.yuv import field_view_from_view
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.opencl.device import BUILDS, Device, DeviceLost, build_device, find_device
from rfcore.raster.opencl.renderer import SIDE, DeviceRasterizer, DeviceWarp
from rfcore.raster.renderers import DEVICES
from rfcore.views import FieldView, View

with needs("opencl"):
    import pyopencl as cl

log = structlog.get_logger()
_opened: dict[str, Device] = {}
_lock = Lock()


def open_device(wanted: str = "") -> Device:
    """Return the device called so (``find_device``), opened and tested once in a process.

    The builds are tried in their order. Raises ``BackendUnavailable`` with what was wrong with
    each when none is exact.
    """
    with _lock:
        if wanted not in _opened:
            _opened[wanted] = _first_exact(wanted)
        return _opened[wanted]


def _first_exact(wanted: str) -> Device:
    found, problems = find_device(wanted), []
    for build in BUILDS:
        begin = perf_counter()
        try:
            device = build_device(found, build)
            check_device(device)
        except BackendUnavailable as error:
            log.warning("opencl build refused", build=build.name, problem=str(error))
            problems.append(str(error))
            continue
        DEVICES.add_opened(device.name, device.driver, build.name)
        log.info(
            "opencl device opened",
            device=device.name,
            driver=device.driver,
            build=build.name,
            self_check="exact",
            seconds=round(perf_counter() - begin, 2),
        )
        return device
    raise BackendUnavailable(
        f"{'; '.join(problems)}: pictures of this device would not be those of the other end; "
        "render with --renderer cpu"
    )


OPERATIONS = ("addition", "product", "quotient", "square root", "fused multiply-add", "floor")
PATTERNS = 1 << 14
TINY = np.finfo(np.float32).tiny


class Chance:
    """Pseudo-random numbers by integer arithmetic: the same bits with every version of numpy."""

    def __init__(self) -> None:
        self._drawn = 0

    def bits(self, *shape: int) -> NDArray[np.uint32]:
        """Return 32 random bits each (the finalizer of MurmurHash3)."""
        count = int(np.prod(shape))
        x = np.arange(self._drawn, self._drawn + count, dtype=np.uint32)
        self._drawn += count
        x = x * np.uint32(0x9E3779B9) + np.uint32(0x7F4A7C15)
        for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
            x = (x ^ x >> np.uint32(shift)) * np.uint32(factor)
        return (x ^ x >> np.uint32(16)).reshape(shape)

    def uniform(self, low: float, high: float, *shape: int) -> F32:
        """Return float32 from ``low`` to below ``high``."""
        unit = (self.bits(*shape) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)
        return np.float32(low) + np.float32(high - low) * unit


def arithmetic_operands() -> tuple[F32, F32, F32]:
    """Return x, y and z [PATTERNS]: random bits, numbers near 1, small, integer and special ones.

    Subnormals are zero: some devices flush them, and no byte of a picture depends on one.
    """
    chance = Chance()
    return _operand(chance), _operand(chance), _operand(chance)


def _operand(chance: Chance) -> F32:
    specials = np.array([0.0, -0.0, np.inf, -np.inf, 1.0, TINY, 3.4028235e38, -1.0], np.float32)
    near, small = chance.uniform(-4, 4, PATTERNS), chance.uniform(0, 1e-37, PATTERNS)
    whole = (chance.bits(PATTERNS) & np.uint32(0xFFF)).astype(np.float32)
    special = specials[chance.bits(PATTERNS) & np.uint32(7)]
    kinds = [chance.bits(PATTERNS).view(np.float32), near, small, whole, special]
    chosen = np.choose(chance.bits(PATTERNS) % np.uint32(len(kinds)), kinds)
    return canonical(chosen)


def canonical(x: F32) -> F32:
    """Return ``x`` with one NaN for all and without subnormals and negative zeros."""
    kept = np.where(np.abs(x) < TINY, np.float32(0), x)
    return np.where(np.isnan(kept), np.float32(np.nan), kept)


def digest(*arrays: NDArray[np.float32]) -> str:
    """Return 16 hexadecimal digits of the bytes of arrays."""
    return hashlib.blake2b(b"".join(a.tobytes() for a in arrays), digest_size=8).hexdigest()


def bytes_of(view: FieldView) -> bytes:
    """Return depth, opacity and codec picture of one drawing."""
    arrays = (*view.render.planes, view.depth, view.kept_opacity)
    return b"".join(array.tobytes() for array in arrays)


def arithmetic_on(device: Device) -> F32:
    """Return the device's canonical results [6, PATTERNS] for the operands."""
    queue, flags = cl.CommandQueue(device.context), cl.mem_flags
    operands = [
        cl.Buffer(device.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=operand)
        for operand in arithmetic_operands()
    ]
    results = np.empty((len(OPERATIONS), PATTERNS), np.float32)
    made = cl.Buffer(device.context, flags.WRITE_ONLY, results.nbytes)
    kernel = cl.Kernel(device.program, "arithmetic")
    kernel(queue, (PATTERNS,), (SIDE,), np.uint32(PATTERNS), *operands, made)
    cl.enqueue_copy(queue, results, made)
    return canonical(results)


class Check:
    """One picture of a self-check: its settings, and the digest that the native kernels give."""

    def __init__(self, size_px: tuple[int, int], degree: int, antialiased: bool, want: str) -> None:
        self.camera, self.degree, self.antialiased = _camera(*size_px), degree, antialiased
        self.want = want

    def on(self, device: Device, gaussians: Gaussians) -> tuple[View, FieldView]:
        """Return the device's picture, and the codec picture that it makes of it."""
        k = self.camera.intrinsics
        shape = (k.height_px, k.width_px)
        view = View(*(np.empty(s, np.float32) for s in ((*shape, 3), shape, shape)))
        drawn_by = DeviceRasterizer(device, gaussians, antialiased=self.antialiased)
        drawn_by.draw(self.camera, self.degree, view.colour, view.depth, view.opacity)
        picture = I420.empty(shape[::-1])
        planes = drawn_by.draw_codec_picture(self.camera, self.degree, picture)
        return view, FieldView(self.camera, picture, *map(drawn_by.fetch, planes))


def _camera(width_px: int, height_px: int) -> Camera:
    pose = Pose((0.25, -0.125, -0.5), (0.96, 0.0, 0.28, 0.0))
    return Camera(_lens(width_px, height_px), pose)


def _lens(width_px: int, height_px: int) -> Intrinsics:
    focal = 0.5 * max(width_px, height_px)
    return Intrinsics(
        width_px, height_px, focal, 1.03125 * focal, 0.48 * width_px, 0.53 * height_px
    )


@dataclass(frozen=True)
class WarpCase:
    """A warp of a self-check: the pose of the present camera, seen from the earlier one."""

    size_px: tuple[int, int]
    step_m: tuple[float, float, float]
    turn: tuple[float, float, float, float]
    """A quaternion w, x, y, z of any length."""

    def given(self) -> tuple[I420, FieldView, FieldView]:
        """Return noise of every level, on a rough surface, and the two views of it."""
        chance, lens = Chance(), _lens(*self.size_px)
        length = math.sqrt(sum(part * part for part in self.turn))
        w, x, y, z = (part / length for part in self.turn)
        poses = (Pose.identity(), Pose(self.step_m, (w, x, y, z)))
        before, now = (
            FieldView(Camera(lens, pose), noise(chance, self.size_px), rough(chance, self.size_px))
            for pose in poses
        )
        return noise(chance, self.size_px), before, now


def noise(chance: Chance, size_px: tuple[int, int]) -> I420:
    """Return a picture of every level."""
    shapes = [plane.shape for plane in I420.empty(size_px).planes]
    return I420(*(chance.bits(*shape).astype(np.uint8) for shape in shapes))


def rough(chance: Chance, size_px: tuple[int, int]) -> F32:
    """Return the depth of a rough surface with a step in it, holes, and depths of any size."""
    width_px, height_px = size_px
    shape = (height_px, width_px)
    depth = chance.uniform(4, 6, *shape)
    depth[:, 3 * width_px // 4 :] *= np.float32(2)
    specials = np.array([0, 0, -1, 1e-30, 1e30, -1e30, 3e38, 0.125], np.float32)
    special = specials[chance.bits(*shape) & np.uint32(7)]
    return np.where(chance.bits(*shape) % np.uint32(16) == 0, special, depth)


def check_gaussians() -> Gaussians:
    """Return a cloud with walls, needles, ties, a pile of faint splats, sky, odd quaternions."""
    chance, count = Chance(), 2000
    means = chance.uniform(-1, 1, count, 3) * np.array([3, 2, 3], np.float32)
    means[:, 2] += np.float32(4)
    quaternions = chance.uniform(-1, 1, count, 4)
    log_scales = chance.uniform(-4, -1.5, count, 3)
    logits = chance.uniform(-4, 4, count)
    sh = chance.uniform(-0.5, 0.5, count, 16, 3)
    log_scales[0:40] = chance.uniform(-6, 1.5, 40, 3)  # needles and discs over many tiles
    log_scales[40:44] += np.float32(4)  # wider than the picture
    means[50:90] = means[90:130]  # equal depths
    means[200:800], logits[200:800] = (0.5, 0.25, 3.0), -3.5  # several batches of one tile
    quaternions[800:810], quaternions[810:820] = 0, chance.uniform(1e37, 3e38, 10, 4)
    logits[820:860] = 12  # opaque
    sh[860:900] *= np.float32(1e30)  # colours at their limit
    log_scales[900:920] = -30
    means[920:1000] *= np.float32(8192)  # sky
    log_scales[920:1000] += np.float32(11)
    return Gaussians(means, quaternions, log_scales, logits, sh)


ARITHMETIC_DIGESTS = {
    "addition": "549cf4f58061dcd4",
    "product": "fe88f7d7377d4bcf",
    "quotient": "8438635ebf714c5a",
    "square root": "6955cc75193bd2dd",
    "fused multiply-add": "f9a1463a8f843c9f",
    "floor": "c21333978a6de98b",
}
CHECKS = (
    Check((200, 120), 3, False, "11169eced0f3b738"),
    Check((150, 90), 2, True, "a433088a3c33a309"),
    Check((333, 17), 1, False, "fcd311e439b7588b"),
    Check((40, 301), 0, True, "58d1c4a673b1c6a6"),
)


WARP_CASES = (
    WarpCase((101, 67), (0.2, -0.1, 0.5), (0.9995, 0.02, -0.01, 0.005)),
    WarpCase((64, 48), (1.5, 0.25, -0.5), (0.99, 0.0, 0.1, 0.0)),  # leaves the picture
    WarpCase((37, 3), (0.0, 0.0, -0.5), (1.0, 0.0, 0.0, 0.03125)),
    WarpCase((1, 9), (0.0, 0.125, 0.0), (1.0, 0.0, 0.0, 0.0)),
    WarpCase((1, 1), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
    WarpCase((24, 18), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),  # sees nothing of it
)


def check_device(device: Device) -> None:
    """Raise ``BackendUnavailable`` saying what differs, unless the device is exact."""
    try:
        _check_arithmetic(device)
        gaussians = check_gaussians()
        for check in CHECKS:
            _check_pictures(device, check, gaussians)
        carried_by = DeviceRasterizer(device, gaussians, antialiased=False)
        for case in WARP_CASES:
            _check_carried(carried_by, case)
    except (DeviceLost, cl.Error) as error:
        raise BackendUnavailable(f"{device.description}: {error}") from error


def _check_arithmetic(device: Device) -> None:
    for name, result in zip(OPERATIONS, arithmetic_on(device), strict=True):
        if digest(result) != ARITHMETIC_DIGESTS[name]:
            raise BackendUnavailable(f"{device.description}: a {name} is not the IEEE result")


def _check_pictures(device: Device, check: Check, gaussians: Gaussians) -> None:
    view, held = check.on(device, gaussians)
    k = check.camera.intrinsics
    if digest(view.colour, view.depth, view.opacity) != check.want:
        raise BackendUnavailable(
            f"{device.description}: its picture of {k.width_px}x{k.height_px} pixels with "
            f"bands up to {check.degree} is not that of the native kernels"
        )
    if bytes_of(held) != bytes_of(field_view_from_view(view, check.camera)):
        raise BackendUnavailable(
            f"{device.description}: its codec picture of {k.width_px}x{k.height_px} pixels "
            "is not that of the native kernels"
        )


def _check_carried(device: DeviceRasterizer, case: WarpCase) -> None:
    previous, before, now = case.given()
    wanted = {
        "warp": (None, warp_i420(previous, before, now)),
        "correction": (before.render, correct_i420(previous, before, now)),
    }
    for name, (minus, want) in wanted.items():
        if carried_on(device, previous, minus, before, now).digest() != want.digest():
            width_px, height_px = case.size_px
            raise BackendUnavailable(
                f"{device.device.description}: its {name} of {width_px}x{height_px} pixels is not "
                "that of the native kernels"
            )


def carried_on(
    device: DeviceRasterizer, previous: I420, minus: I420 | None, before: FieldView, now: FieldView
) -> I420:
    """Return a device's warp or, with ``minus``, its correction, of views of the CPU."""
    earlier, depth = (device.hold(view.depth).lent for view in (before, now))
    assert earlier is not None
    assert depth is not None
    out = I420.empty(now.render.size_px)
    device.carry(DeviceWarp(previous, minus, before, now, earlier, depth), out)
    return out
