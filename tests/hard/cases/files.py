"""Hard files: what is not finite is left out and said; what is extreme survives exactly."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hard.cases.case import Case, Finding, statement, within
from hard.cases.scenes import arrays_of, blobs, poisoned
from rfcore.camera import TileOrigin
from rfcore.field.splat_file import read_splat_file
from rfcore.field.splat_ply import write_ply
from rfcore.raster.gaussians import Gaussians

GROUP = "Files"


def _ply_with(value: float) -> Finding:
    """Put the value into the last coordinate of a mean, in the bytes of a good file."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "field.ply"
        marked = poisoned(blobs(), {"means": (0.0, 0.0, 12345.678)}, every=len(blobs()))
        write_ply(path, marked)
        mark, bad = np.float32(12345.678).tobytes(), np.float32(value).tobytes()
        content = path.read_bytes()
        assert content.count(mark) == 1
        path.write_bytes(content.replace(mark, bad))
        read = read_splat_file(path)
    said = " ".join(read.notes)
    holds = len(read.splats) == len(marked) - 1 and "1 of 24" in said and "means of 1" in said
    return statement(holds, said, f"{len(read.splats)} splats: {said}")


def _extremes_survive() -> Finding:
    values = {
        "means": (3e38, -1e-45, -0.0),
        "log_scales": (3e38, -3e38, 1e-45),
        "quaternions": 3e38,
        "opacity_logits": -3e38,
        "sh": 1e-45,
    }
    extreme = poisoned(blobs(), values)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "field.ply"
        write_ply(path, extreme)
        back = read_splat_file(path).splats
    return statement(_same(extreme, back), "equal bytes", "bytes differ")


def _global_coordinates() -> Finding:
    """A file in UTM metres (float64 columns would be needed; float32 has 0.5 m at 5,334,760)."""
    origin = TileOrigin(691_608.0, 5_334_760.0, 520.0)
    offset = np.array([origin.east_m, origin.north_m, origin.up_m])
    home = blobs()
    home.means[:] = np.round(home.means * 2) / 2
    moved = poisoned(home, {"means": (home.means + offset).astype(np.float32)}, every=1)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "field.ply"
        write_ply(path, moved)
        back = read_splat_file(path, origin).splats
    return within(float(np.abs(back.means - home.means).max()), 0.0, "metres")


def _same(a: Gaussians, b: Gaussians) -> bool:
    return all(x.tobytes() == y.tobytes() for x, y in zip(arrays_of(a), arrays_of(b), strict=True))


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


CASES = (
    *(
        _case(
            f"{value} in a .ply",
            "left out, which is said with the property and how many",
            partial(_ply_with, value),
        )
        for value in (math.nan, math.inf, -math.inf)
    ),
    _case("largest and smallest floats", "survive a .ply bit for bit", _extremes_survive),
    _case(".ply in UTM coordinates", "relative to its tile exactly", _global_coordinates),
)
