"""Names of renderers, ``cpu`` or ``opencl[:DEVICE]``, and what became of this process's devices.

Nothing is loaded to read them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Lock

from rfcore.errors import InvalidInput

__all__ = ["CPU", "DEVICES", "DeviceRecord", "is_opencl", "renderer_isa"]

CPU, OPENCL = "cpu", "opencl"


@dataclass
class DeviceRecord:
    """The OpenCL devices that passed their self-check, and how often the CPU stood in for one.

    For metrics; any thread may add to it.
    """

    opened: list[tuple[str, str, str]] = field(default_factory=list)
    """Name, driver and build of each."""
    lost: int = 0
    """Renderers that left a failed device for good."""
    full: int = 0
    """Single pictures that a device could not hold."""
    _lock: Lock = field(default_factory=Lock)

    def add_opened(self, name: str, driver: str, build: str) -> None:
        """A device passed its check; one that was opened by two names counts once."""
        with self._lock:
            if (name, driver, build) not in self.opened:
                self.opened.append((name, driver, build))

    def add_lost(self) -> None:
        """A renderer left its device."""
        with self._lock:
            self.lost += 1

    def add_full(self) -> None:
        """A picture was drawn by the CPU instead."""
        with self._lock:
            self.full += 1


DEVICES = DeviceRecord()
"""Of this process."""


def is_opencl(isa: str | None) -> bool:
    """Return whether ``isa`` names an OpenCL device: ``opencl``, or ``opencl:`` and which."""
    return isa is not None and isa.partition(":")[0] == OPENCL


def renderer_isa(renderer: str, isa: str | None = None) -> str | None:
    """Return what to render with: ``isa`` for the renderer ``cpu``, else the OpenCL device.

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
