"""An OpenCL device with the program built for it, and memory on it."""

from __future__ import annotations

import warnings
from collections import deque
from dataclasses import dataclass
from importlib.resources import files
from typing import Any
from weakref import finalize

import structlog

from rfcore.errors import BackendUnavailable
from rfcore.extras import needs

with needs("opencl"):
    import pyopencl as cl

log = structlog.get_logger()

SOURCES = (
    *("arithmetic.cl", "project.cl", "tiles.cl", "sort.cl", "blend.cl", "codec_picture.cl"),
    "warp.cl",
)
LEAST_BYTES = 64
"""Smallest buffer: OpenCL has no empty ones."""
MOST_RETURNED = 8
"""Returned buffers that are kept for reuse."""


class DeviceLost(Exception):
    """The device failed while drawing; the picture must not be used."""


class DeviceFull(Exception):
    """This picture takes more memory than is reserved for one; others may not."""


@dataclass(frozen=True)
class Build:
    """Options of the compiler, and a name for logs."""

    name: str
    options: tuple[str, ...]


BUILDS = (
    Build("plain", ("-cl-fp32-correctly-rounded-divide-sqrt",)),
    Build("guarded", ("-DUNFUSED_PRODUCTS", "-DINTEGER_DIVISION")),
)
"""Builds in the order in which they are tried. The second is for compilers that contract all the
same and devices whose division is not correctly rounded."""


@dataclass(frozen=True)
class Device:
    """A device whose program is built, but not yet tested."""

    name: str
    driver: str
    """Platform with its version, and driver version."""
    build: Build
    context: Any
    program: Any

    @property
    def description(self) -> str:
        """Device, driver and build in a line."""
        return f"{self.name}; {self.driver}; {self.build.name} build"


def find_device(wanted: str) -> Any:
    """Return the pyopencl device of a name.

    ``wanted`` is the device's number, a part of its name or of its platform's, or empty: the first
    GPU, or without one the first device. Raises ``BackendUnavailable`` listing what there is.
    """
    found = _devices()
    if not found:
        raise BackendUnavailable(
            "OpenCL has no device here: install the driver of the GPU, or pocl-opencl-icd for the "
            "CPU; or render with --renderer cpu"
        )
    if not wanted:
        return next((d for d in found if d.type & cl.device_type.GPU), found[0])
    if wanted.isdecimal() and int(wanted) < len(found):
        return found[int(wanted)]
    named = [d for d in found if wanted.lower() in f"{d.platform.name} {d.name}".lower()]
    if wanted.isdecimal() or not named:
        known = "; ".join(f"{k}: {d.platform.name}, {d.name}" for k, d in enumerate(found))
        raise BackendUnavailable(f"no OpenCL device is called {wanted!r}; there is {known}")
    return named[0]


def _devices() -> list[Any]:
    try:
        platforms = cl.get_platforms()
    except cl.Error:  # the loader finds no driver
        return []
    return [device for platform in platforms for device in platform.get_devices()]


def build_device(device: Any, build: Build) -> Device:
    """Compile the kernels; raise ``BackendUnavailable`` with the compiler's message if it fails.

    Warnings of the compiler are logged.
    """
    try:
        context = cl.Context([device])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", cl.CompilerWarning)
            # Without pyopencl's cache of binaries: services may have no home to write to.
            program = cl.Program(context, _source()).build(
                ["-cl-std=CL1.2", *build.options],
                cache_dir=False,  # type: ignore[arg-type]
            )
        words = program.get_build_info(device, cl.program_build_info.LOG)
    except cl.Error as error:
        raise BackendUnavailable(f"{device.name} ({build.name} build): {error}") from error
    if words.strip():
        log.debug("opencl compiler", device=device.name, build=build.name, words=words.strip())
    platform = device.platform
    driver = f"{platform.name} {platform.version}, driver {device.driver_version}"
    return Device(device.name, driver, build, context, program)


def _source() -> str:
    return "\n".join((files(__package__) / name).read_text("utf-8") for name in SOURCES)


class LentBuffer:
    """A buffer that stays unchanged while this object is referred to, by any thread."""

    def __init__(self, buffer: Any, returned: deque[Any]) -> None:
        self.buffer = buffer
        finalize(self, returned.append, buffer).atexit = False

    @property
    def size_bytes(self) -> int:
        """The buffer's size on the device."""
        return int(self.buffer.size)


class DeviceMemory:
    """Buffers by name, which grow by half when needed and are reused for the next picture."""

    def __init__(self, device: Device) -> None:
        self._context = device.context
        self._buffers: dict[str, Any] = {}
        self._returned: deque[Any] = deque(maxlen=MOST_RETURNED)

    def __getitem__(self, name: str) -> Any:
        return self._buffers[name]

    def at_least(self, name: str, size_bytes: int) -> None:
        """Make room for ``size_bytes``; a buffer that grows loses its content."""
        before = self._buffers.get(name)
        if before is not None and before.size >= size_bytes:
            return
        grown = size_bytes if before is None else max(size_bytes, 3 * before.size // 2)
        self._buffers[name] = self._buffer(max(grown, LEAST_BYTES))
        if before is not None:
            before.release()

    def lend(self, name: str, size_bytes: int) -> LentBuffer:
        """Remove a buffer of ``size_bytes`` from this memory; its name will get another one."""
        self.at_least(name, size_bytes)
        return LentBuffer(self._buffers.pop(name), self._returned)

    def _buffer(self, size_bytes: int) -> Any:
        """Return a returned buffer of this size, or a new one."""
        for _ in range(len(self._returned)):
            returned = self._returned.popleft()
            if returned.size == size_bytes:
                return returned
            self._returned.append(returned)
        return cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size_bytes)

    def swap(self, one: str, other: str) -> None:
        """Exchange two names."""
        buffers = self._buffers
        buffers[one], buffers[other] = buffers[other], buffers[one]

    def give_back(self, name: str) -> None:
        """Free a buffer."""
        self._buffers.pop(name).release()
