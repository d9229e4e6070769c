"""One set of Gaussians in a device's memory, the kernels that draw them, and drawn planes.

A picture is projected, its visible Gaussians gathered and sorted by depth, their overlaps with
tiles written down and sorted by tile, and every tile blended. Both sorts are stable, so that ties
stay in the order of the Gaussians. Two numbers come back in between: how many are visible, and how
many overlaps there are.

Depth and opacity of a codec's picture stay on the device until the first request
(``DrawnPlane``), so that warps and corrections find their inputs there: depths, and pictures that
were drawn or uploaded before. When planes take too much memory, the oldest are moved to the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from weakref import ReferenceType, ref

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.extras import needs
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.warp import CORRECTION_DOUBT, warp_numbers
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.opencl.device import (
    Device,
    DeviceFull,
    DeviceLost,
    DeviceMemory,
    LentBuffer,
)
from rfcore.views import FieldView

with needs("opencl"):
    import pyopencl as cl

TILE_SIDE_PX = 16
MAX_GROUP_ENTRIES = 1 << 28
"""Overlaps of Gaussians and 64x64 pixels; the native kernels refuse more in the same words."""
MAX_TILE_ENTRIES = 1 << 26
"""Overlaps of Gaussians and tiles that memory is kept for, 16 bytes each: 1 GiB."""
MOST_HELD_BYTES = 1 << 28
"""Most bytes of planes of one rasterizer that stay on the device: 32 planes of 1920x1080."""
MOST_PICTURES = 32
"""Pictures of one rasterizer that are also kept on the device."""
SPLAT_BYTES, BOX_BYTES, PREPARED_BYTES, CAMERA_BYTES = 64, 12, 40, 84
PLACE_BYTES = 8
SIDE = 64
"""Work-items of a group, where a kernel does not say."""
SCAN_ITEMS, SCAN_BLOCK, SORT_BLOCK, DIGIT_BITS = 256, 2048, 1024, 4
DEPTH_BITS = 32

U32 = np.uint32
I32 = np.int32
NOTHING = np.zeros(1, U32)
ZERO = U32(0)
"""A zero that kernels get only at run time (``PRODUCT`` in arithmetic.cl)."""


class DrawnPlane:
    """Depth or opacity of a picture, float32 [H, W]: ``lent`` is its buffer while ``device`` holds
    it, ``array`` its copy on the CPU, if there is one."""

    def __init__(self, device: Device, lent: LentBuffer, shape: tuple[int, int]) -> None:
        self.device, self.shape = device, shape
        self.lent: LentBuffer | None = lent
        self.array: F32 | None = None


@dataclass(frozen=True, eq=False)
class DeviceWarp:
    """The inputs of a warp, or with ``minus`` of a correction (``rfcore.native.warp``).

    ``previous`` was taken at ``before``; the depths are buffers of the device.
    """

    previous: I420
    minus: I420 | None
    before: FieldView
    now: FieldView
    earlier_depth: LentBuffer
    depth: LentBuffer

    @property
    def numbers(self) -> Sequence[float]:
        """The numbers of ``warp_numbers``."""
        return warp_numbers(self.before.camera, self.now.camera)

    @property
    def doubt(self) -> int:
        """Levels by which a difference is reduced."""
        return 0 if self.minus is None else CORRECTION_DOUBT


class DeviceRasterizer:
    """Gaussians on a device; for one thread at a time.

    Raises ``DeviceLost`` when the device fails, here and in each method.
    """

    def __init__(self, device: Device, gaussians: Gaussians, *, antialiased: bool) -> None:
        self.device = device
        self._count, self._degree = len(gaussians), gaussians.sh_degree
        self._antialiased = I32(antialiased)
        with _lost_if_it_fails(device):
            self._queue = cl.CommandQueue(device.context)
            self._kernels = {k.function_name: k for k in device.program.all_kernels()}
            self._memory = DeviceMemory(device)
            self._held: list[ReferenceType[DrawnPlane]] = []
            self._pictures: list[tuple[ReferenceType[I420], LentBuffer]] = []
            self._prepare(gaussians)

    def _prepare(self, g: Gaussians) -> None:
        count, memory = self._count, self._memory
        named = {"means": g.means, "sh": g.sh}
        used_once = {
            "quaternions": g.quaternions,
            "scales": g.log_scales,
            "logits": g.opacity_logits,
        }
        for name, array in {**named, **used_once}.items():
            memory.at_least(name, array.nbytes)
            if count:
                cl.enqueue_copy(self._queue, memory[name], np.ascontiguousarray(array))
        for name, size in (
            ("prepared", PREPARED_BYTES),
            ("splats", SPLAT_BYTES),
            ("boxes", BOX_BYTES),
        ):
            memory.at_least(name, size * count)
        memory.at_least("depth_bits", 4 * count)
        memory.at_least("marks", 4 * count)
        memory.at_least("camera", CAMERA_BYTES)
        self._fill("filter", np.frombuffer(_native.warp_filter(), np.uint8))
        arrays = (memory[name] for name in (*used_once, "prepared"))
        self._run("prepare", count, I32(count), *arrays, ZERO)
        self._queue.finish()
        for name in used_once:
            memory.give_back(name)

    def draw(
        self,
        camera: Camera,
        degree: int,
        colour: F32,
        depth: F32 | None = None,
        opacity: F32 | None = None,
    ) -> None:
        """Write ``colour`` [H, W, 3] and, if given, ``depth`` and ``opacity`` [H, W].

        Raises ``ValueError`` as the native kernels do for more than 2^28 overlaps, ``DeviceFull``
        for what only this device cannot hold, and ``DeviceLost``. None of them leaves a picture.
        """
        with _lost_if_it_fails(self.device):
            self._draw(camera, degree)
            self._fetch(("colour", colour), ("depth", depth), ("opacity", opacity))

    def draw_codec_picture(
        self, camera: Camera, degree: int, picture: I420
    ) -> tuple[DrawnPlane, DrawnPlane]:
        """Write the colours as the codec's picture; return depth and opacity.

        It copies 1.5 bytes a pixel from the device instead of 20. Raises as ``draw``.
        """
        with _lost_if_it_fails(self.device):
            self._draw(camera, degree)
            self._memory.at_least("picture", _size_bytes(picture))
            names = ("camera", "colour", "picture")
            self._run("codec_picture", picture.u.size, *self._buffers(*names), ZERO)
            self._fetch_picture("picture", picture)
            self._keep_picture(picture)
            shape = picture.y.shape
            return self._hold("depth", shape), self._hold("opacity", shape)

    def hold(self, plane: F32) -> DrawnPlane:
        """Upload a plane [H, W] of the CPU."""
        with _lost_if_it_fails(self.device):
            self._fill("depth", plane)
            return self._hold("depth", plane.shape)

    def fetch(self, plane: DrawnPlane) -> F32:
        """Return a plane as an array on the CPU; it stays on the device, too."""
        with _lost_if_it_fails(self.device):
            if plane.array is None:
                assert plane.lent is not None
                array = np.empty(plane.shape, np.float32)
                cl.enqueue_copy(self._queue, array, plane.lent.buffer)
                plane.array = array
            return plane.array

    def carry(self, warp: DeviceWarp, out: I420) -> None:
        """Write the result of ``warp_i420`` or, with ``minus``, of ``correct_i420``."""
        memory, pixels, names = self._memory, out.y.size, ("warp", "filter", "places")
        with _lost_if_it_fails(self.device):
            minus = warp.previous if warp.minus is None else warp.minus
            given = [self._picture(each) for each in (warp.previous, minus, warp.now.render)]
            self._fill("warp", warp_on_device(warp.numbers, out.size_px))
            memory.at_least("places", PLACE_BYTES * pixels)
            memory.at_least("picture", _size_bytes(out))
            depths = (warp.earlier_depth.buffer, warp.depth.buffer)
            self._run("locate", pixels, memory["warp"], *depths, memory["places"], ZERO)
            buffers = [lent.buffer for lent in given]
            arguments = (*self._buffers(*names), *buffers, memory["picture"])
            rule = I32(warp.minus is not None), I32(warp.doubt)
            for kernel, items in (("carry_luma", pixels), ("carry_chroma", out.u.size)):
                self._run(kernel, items, *arguments, *rule)
            self._fetch_picture("picture", out)

    def _draw(self, camera: Camera, degree: int) -> None:
        self._load(camera)
        self._project(degree)
        visible = self._gather()
        self._place(visible, camera)
        self._blend(camera)

    def _fetch(self, *wanted: tuple[str, F32 | None]) -> None:
        """Copy buffers to arrays, and wait for the copies."""
        for name, out in wanted:
            if out is not None:
                cl.enqueue_copy(self._queue, out, self._memory[name], is_blocking=False)
        self._queue.finish()

    def _fetch_picture(self, name: str, out: I420) -> None:
        """Copy a buffer to the planes of ``out``, and wait for the copies."""
        start, made = 0, self._memory[name]
        for plane in out.planes:
            cl.enqueue_copy(self._queue, plane, made, src_offset=start, is_blocking=False)
            start += plane.nbytes
        self._queue.finish()

    def _fill(self, name: str, values: NDArray[Any]) -> None:
        self._memory.at_least(name, values.nbytes)
        cl.enqueue_copy(self._queue, self._memory[name], np.ascontiguousarray(values))

    def _hold(self, name: str, shape: tuple[int, int]) -> DrawnPlane:
        """Return a buffer's content as a plane that the next picture does not overwrite."""
        lent = self._memory.lend(name, 4 * shape[0] * shape[1])
        plane = DrawnPlane(self.device, lent, shape)
        self._held.append(ref(plane))
        self._make_room()
        return plane

    def _make_room(self) -> None:
        """Move the oldest planes to the CPU while all of them take too much memory."""
        held = [plane for each in self._held if (plane := each()) and plane.lent is not None]
        sizes = [plane.lent.size_bytes for plane in held if plane.lent is not None]
        while len(held) > 1 and sum(sizes) > MOST_HELD_BYTES:
            oldest, _ = held.pop(0), sizes.pop(0)
            self.fetch(oldest)
            oldest.lent = None
        self._held = [ref(plane) for plane in held]

    def _picture(self, picture: I420) -> LentBuffer:
        """Return the buffer of a CPU picture, and upload it if necessary."""
        for each, lent in self._pictures:
            if each() is picture:
                return lent
        self._memory.at_least("picture", _size_bytes(picture))
        start, made = 0, self._memory["picture"]
        for plane in map(np.ascontiguousarray, picture.planes):
            cl.enqueue_copy(self._queue, made, plane, dst_offset=start)
            start += plane.nbytes
        return self._keep_picture(picture)

    def _keep_picture(self, picture: I420) -> LentBuffer:
        """Keep the buffer ``picture``, the copy of a CPU picture, as long as that one lives."""
        lent = self._memory.lend("picture", _size_bytes(picture))
        alive = [(each, kept) for each, kept in self._pictures if each() is not None]
        self._pictures = [*alive[-(MOST_PICTURES - 1) :], (ref(picture), lent)]
        return lent

    def _load(self, camera: Camera) -> None:
        cl.enqueue_copy(self._queue, self._memory["camera"], camera_on_device(camera))

    def _project(self, degree: int) -> None:
        names = ("camera", "means", "prepared", "sh", "splats", "boxes", "depth_bits")
        stored = I32((self._degree + 1) ** 2)
        numbers = (I32(self._count), I32(degree), stored, self._antialiased)
        self._run("project", self._count, *numbers, *self._buffers(*names), ZERO)

    def _gather(self) -> int:
        """Sort the visible Gaussians by depth into ``order``; return how many there are."""
        count = U32(self._count)
        self._run("mark_visible", self._count, count, *self._buffers("depth_bits", "marks"))
        visible = int(self._total(self._scan("marks", self._count)))
        self._reserve_pairs("depths", "order", visible)
        names = ("depth_bits", "marks", "depths", "order")
        self._run("gather_visible", self._count, count, *self._buffers(*names))
        self._sort("depths", "order", visible, DEPTH_BITS)
        return visible

    def _place(self, visible: int, camera: Camera) -> None:
        """Sort the overlaps by tile into ``entries``."""
        memory = self._memory
        for name in ("starts_of_splats", "group_counts"):
            memory.at_least(name, 4 * visible)
        splats = self._buffers("camera", "splats", "boxes", "order")
        counts = self._buffers("starts_of_splats", "group_counts")
        self._run("count_tiles", visible, U32(visible), *splats, *counts)
        entries = self._checked_entries(visible)
        self._scan("starts_of_splats", visible)
        self._reserve_pairs("tiles", "entries", entries)
        places = self._buffers("starts_of_splats", "tiles", "entries")
        self._run("place_tiles", visible, U32(visible), *splats, *places)
        tiles = _tiles(camera)
        self._sort("tiles", "entries", entries, (tiles - 1).bit_length())
        memory.at_least("starts_of_tiles", 4 * (tiles + 1))
        starts = self._buffers("tiles", "starts_of_tiles")
        self._run("find_starts", entries + 1, U32(entries), U32(tiles), *starts)

    def _checked_entries(self, visible: int) -> int:
        if self._sum("group_counts", visible) > MAX_GROUP_ENTRIES:
            raise ValueError(
                f"more than {MAX_GROUP_ENTRIES} overlaps of Gaussians and 64x64 pixels; the "
                "Gaussians are too large or too many for this picture size"
            )
        entries = self._sum("starts_of_splats", visible)
        if entries > MAX_TILE_ENTRIES:
            raise DeviceFull(f"{entries} overlaps of Gaussians and tiles exceed {MAX_TILE_ENTRIES}")
        return entries

    def _blend(self, camera: Camera) -> None:
        k, memory = camera.intrinsics, self._memory
        pixels = k.width_px * k.height_px
        for name, channels in (("colour", 3), ("depth", 1), ("opacity", 1)):
            memory.at_least(name, 4 * channels * pixels)
        size = tuple(-(-side // TILE_SIDE_PX) * TILE_SIDE_PX for side in (k.width_px, k.height_px))
        names = ("camera", "splats", "starts_of_tiles", "entries", "colour", "depth", "opacity")
        blend = self._kernels["blend"]
        blend(self._queue, size, (TILE_SIDE_PX, TILE_SIDE_PX), *self._buffers(*names), ZERO)

    def _run(self, kernel: str, items: int, *arguments: Any, side: int = SIDE) -> None:
        if items:
            self._kernels[kernel](self._queue, (-(-items // side) * side,), (side,), *arguments)

    def _buffers(self, *names: str) -> list[Any]:
        return [self._memory[name] for name in names]

    def _reserve_pairs(self, keys: str, values: str, count: int) -> None:
        for name in (keys, values, f"{keys} moved", f"{values} moved"):
            self._memory.at_least(name, 4 * count)

    def _scan(self, name: str, count: int, level: int = 0) -> str:
        """Make exclusive prefix sums in place; return the name of the buffer of their total."""
        blocks = -(-count // SCAN_BLOCK)
        sums = f"sums {level}"
        self._memory.at_least(sums, 4 * max(1, blocks))
        if not count:
            cl.enqueue_fill_buffer(self._queue, self._memory[sums], NOTHING, 0, 4)
        values = self._buffers(name, sums)
        self._run("scan_blocks", blocks * SCAN_ITEMS, U32(count), *values, side=SCAN_ITEMS)
        if blocks <= 1:
            return sums
        total = self._scan(sums, blocks, level + 1)
        self._run("add_block_sums", count, U32(count), *self._buffers(name, sums))
        return total

    def _total(self, name: str) -> np.uint32:
        total = np.empty(1, U32)
        cl.enqueue_copy(self._queue, total, self._memory[name])
        return U32(total[0])

    def _sum(self, name: str, count: int) -> int:
        blocks = -(-count // SCAN_ITEMS)
        self._memory.at_least("sums of 64 bits", 8 * blocks)
        sums = np.zeros(blocks, np.uint64)
        values = self._buffers(name, "sums of 64 bits")
        self._run("sum_blocks", count, U32(count), *values, side=SCAN_ITEMS)
        if blocks:
            cl.enqueue_copy(self._queue, sums, self._memory["sums of 64 bits"])
        return int(sums.sum())

    def _sort(self, keys: str, values: str, count: int, bits: int) -> None:
        """Sort pairs by the lowest ``bits`` of their keys; equal keys keep their order."""
        if count < 2:
            return
        blocks, memory = -(-count // SORT_BLOCK), self._memory
        memory.at_least("digits", 4 * (blocks << DIGIT_BITS))
        for shift in range(0, bits, DIGIT_BITS):
            numbers = (U32(count), U32(shift))
            self._run("count_digits", blocks * SIDE, *numbers, *self._buffers(keys, "digits"))
            self._scan("digits", blocks << DIGIT_BITS)
            names = (keys, values, "digits", f"{keys} moved", f"{values} moved")
            self._run("move_by_digit", blocks * SIDE, *numbers, *self._buffers(*names))
            memory.swap(keys, f"{keys} moved")
            memory.swap(values, f"{values} moved")


def camera_on_device(camera: Camera) -> NDArray[np.uint8]:
    """Return the bytes of ``Camera`` in project.cl: float32, rounded once; the position as two."""
    k = camera.intrinsics
    rotation = np.array(camera.cam_from_world().rotation_matrix(), np.float64).ravel()
    position = np.array(camera.world_from_cam.translation_m, np.float64)
    rest = position - position.astype(np.float32).astype(np.float64)
    lens = np.array([k.fx_px, k.fy_px, k.cx_px, k.cy_px], np.float64)
    numbers = np.concatenate([rotation, position, rest, lens]).astype(np.float32)
    sides = np.array([k.width_px, k.height_px], I32)
    return np.concatenate([numbers.view(np.uint8), sides.view(np.uint8)])


def warp_on_device(numbers: Sequence[float], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the bytes of ``Warp`` in warp.cl: ``numbers`` rounded to float32 once."""
    rounded = np.array(numbers, np.float64).astype(np.float32)
    return np.concatenate([rounded.view(np.uint8), np.array(size_px, I32).view(np.uint8)])


def _size_bytes(picture: I420) -> int:
    return sum(plane.nbytes for plane in picture.planes)


def _tiles(camera: Camera) -> int:
    k = camera.intrinsics
    return -(-k.width_px // TILE_SIDE_PX) * -(-k.height_px // TILE_SIDE_PX)


@contextmanager
def _lost_if_it_fails(device: Device) -> Iterator[None]:
    try:
        yield
    except (cl.Error, MemoryError) as error:
        raise DeviceLost(f"{device.name}: {error}") from error
