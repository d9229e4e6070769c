"""An OpenCL device with the program built for it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from rfcore.errors import BackendUnavailable
from rfcore.extras import needs

with needs("opencl"):
    import pyopencl as cl

__all__ = ["BUILDS", "Build", "Device", "DeviceFull", "DeviceLost", "build_device", "find_device"]

SOURCES = ("arithmetic.cl", "project.cl", "tiles.cl", "sort.cl", "blend.cl", "codec_picture.cl")


class DeviceLost(Exception):
    """The device failed while it drew; what it had drawn is not to be shown."""


class DeviceFull(Exception):
    """One picture takes more memory than is kept for one; others do not."""


@dataclass(frozen=True)
class Build:
    """Options of the compiler, and a name for logs."""

    name: str
    options: tuple[str, ...]


BUILDS = (
    Build("plain", ("-cl-fp32-correctly-rounded-divide-sqrt",)),
    Build("guarded", ("-DUNFUSED_PRODUCTS", "-DINTEGER_DIVISION")),
)
"""In the order in which they are tried: the second for compilers that contract all the same and
devices whose division is not correctly rounded."""


@dataclass(frozen=True)
class Device:
    """A device whose program is built; not yet one whose pictures may be believed."""

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
    """Compile the kernels; raise ``BackendUnavailable`` with the compiler's words if it cannot."""
    try:
        context = cl.Context([device])
        # Without pyopencl's cache of binaries: services may have no home to write to.
        program = cl.Program(context, _source()).build(
            ["-cl-std=CL1.2", *build.options],
            cache_dir=False,  # type: ignore[arg-type]
        )
    except cl.Error as error:
        raise BackendUnavailable(f"{device.name} ({build.name} build): {error}") from error
    platform = device.platform
    driver = f"{platform.name} {platform.version}, driver {device.driver_version}"
    return Device(device.name, driver, build, context, program)


def _source() -> str:
    return "\n".join((files(__package__) / name).read_text("utf-8") for name in SOURCES)
