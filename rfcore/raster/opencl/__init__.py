"""The forward renderer on OpenCL devices: the bytes of the native kernels, or no picture at all.

``device`` finds and builds, ``renderer`` draws and carries pictures from pose to pose,
``self_check`` proves a device before it is opened. Everything that decides a byte stands in the
``.cl`` files, which follow ``rfcore/csrc/raster`` and ``rfcore/csrc/picture`` operation by
operation; the host only counts.
"""

from rfcore.raster.opencl.device import Device, DeviceFull, DeviceLost, LentBuffer
from rfcore.raster.opencl.renderer import DeviceRasterizer, DeviceWarp, DrawnPlane
from rfcore.raster.opencl.self_check import open_device

__all__ = [
    "Device",
    "DeviceFull",
    "DeviceLost",
    "DeviceRasterizer",
    "DeviceWarp",
    "DrawnPlane",
    "LentBuffer",
    "open_device",
]
