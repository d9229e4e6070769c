"""Devices that have passed their self-check, one for a process each."""

from __future__ import annotations

from threading import Lock
from time import perf_counter

import structlog

from rfcore.errors import BackendUnavailable
from rfcore.raster.opencl.device import BUILDS, Device, build_device, find_device
from rfcore.raster.opencl.self_check import check_device
from rfcore.raster.renderers import DEVICES

__all__ = ["open_device"]

log = structlog.get_logger()
_opened: dict[str, Device] = {}
_lock = Lock()


def open_device(wanted: str = "") -> Device:
    """Return the device of a name (``find_device``), opened and checked once in a process.

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
