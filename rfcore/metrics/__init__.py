"""Distances between pictures, in numpy only.

Pictures are [H, W] or [H, W, 3], both of one shape and dtype: uint8, whose peak is 255, or
floating point with a stated peak. Means run over every pixel and channel.
"""

from rfcore.metrics.psnr import mean_squared_error, psnr
from rfcore.metrics.ssim import ssim

__all__ = ["mean_squared_error", "psnr", "ssim"]
