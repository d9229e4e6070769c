"""The forward renderer on OpenCL devices: the bytes of the native kernels, or no picture at all.

``device`` finds devices and builds the program, ``renderer`` draws pictures and warps them to other
poses, ``self_check`` tests a device before it is used. Everything that decides a byte is in the
``.cl`` files, which follow ``rfcore/csrc/raster`` and ``rfcore/csrc/picture`` operation by
operation; the host computes only sizes.
"""
