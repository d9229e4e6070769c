"""Names of renderers, ``cpu`` or ``opencl[:DEVICE]``, and a record of this process's devices.

It does not import OpenCL.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Lock

from rfcore.errors import InvalidInput

CPU, OPENCL = "cpu", "opencl"


@dataclass
class DeviceRecord:
    """The OpenCL devices that passed their self-check, and how often the CPU replaced one.

    It serves metrics; any thread may add to it.
    """

    opened: list[tuple[str, str, str]] = field(default_factory=list)
    """Name, driver and build of each device."""
    lost: int = 0
    """Renderers whose device failed."""
    full: int = 0
    """Pictures that were too large for a device."""
    _lock: Lock = field(default_factory=Lock)

    def add_opened(self, name: str, driver: str, build: str) -> None:
        """Record a device that passed its check; one that was opened by two names counts once."""
        with self._lock:
            if (name, driver, build) not in self.opened:
                self.opened.append((name, driver, build))

    def add_lost(self) -> None:
        """Count a renderer whose device failed."""
        with self._lock:
            self.lost += 1

    def add_full(self) -> None:
        """Count a picture that the CPU drew instead."""
        with self._lock:
            self.full += 1


DEVICES = DeviceRecord()
"""The devices of this process."""


def is_opencl(isa: str | None) -> bool:
    """Return whether ``isa`` names an OpenCL device: ``opencl``, or ``opencl:`` and which."""
    return isa is not None and isa.partition(":")[0] == OPENCL


def renderer_isa(renderer: str, isa: str | None = None) -> str | None:
    """Return the instruction set ``isa`` for the renderer ``cpu``, else the OpenCL device.

    Raises ``InvalidInput`` for a renderer that is neither ``cpu`` nor ``opencl[:DEVICE]``, and for
    an instruction set beside an OpenCL device.
    """
    if renderer == CPU:
        return isa
    if not is_opencl(renderer):
        raise InvalidInput("renderer", f"{renderer!r} is neither cpu nor opencl[:DEVICE]")
    if isa is not None:
        raise InvalidInput("isa", f"{isa!r} is for --renderer cpu, not for {renderer}")
    return renderer
