"""Bit-exact kernels of rfcore; use the wrappers in rfcore.native."""

import numpy as np
from numpy.typing import NDArray

# --- raster -----------------------------------------------------------------

# --- yuv --------------------------------------------------------------------

def i420_from_colour(
    colour: NDArray[np.float32], y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8]
) -> int: ...
def i420_from_rgb(
    rgb: NDArray[np.uint8], y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8]
) -> None: ...
def rgb_from_i420(
    y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8], rgb: NDArray[np.uint8]
) -> None: ...
