"""The bench of hash grids checks before it times, and its rows have the published keys."""

from pathlib import Path

import numpy as np
import pytest

from lab.bench import ngp
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import (
    F32,
    HashGrid,
    Marching,
    NgpParameters,
    NgpShape,
    Space,
    grid_levels,
    initial_parameters,
)
from rfedge.results import as_json

KEYS = [
    *("width", "height", "threads", "frame_ms", "samples_per_ray", "psnr_to_reference_db"),
    *("budget", "isa", "held_out_db", "torch_ms_scaled"),
]
CAMERA = Camera(Intrinsics(30, 20, 20.0, 20.0, 15.0, 10.0), Pose((0, 0, -0.5), (1.0, 0, 0, 0)))


@pytest.fixture
def numbers() -> NgpParameters:
    space = Space((0.0, 0.0, 1.0), (2.0, 2.0, 1.0), True)
    grid = HashGrid(grid_levels(4, 3, 30, space.aspect), 8)
    shape = NgpShape(grid, space, Marching.between(0.2, 8.0, 10), 16, (16, 16, 8))
    full = np.full(shape.occupancy_words, 0xFFFFFFFF, np.uint32)
    found = initial_parameters(shape, full, np.random.default_rng(0))
    found.table[:] *= 1e4
    return found


def test_a_row_has_the_published_keys(numbers):
    renderer = NgpRenderer(numbers, threads=2)
    unhurried, hurried = (ngp._row(renderer, CAMERA, n, (25.0, 1e3)) for n in (None, 4))
    assert list(as_json(unhurried)) == list(as_json(hurried)) == KEYS
    assert unhurried.psnr_to_reference_db is None
    assert hurried.psnr_to_reference_db is not None
    assert 10 < hurried.psnr_to_reference_db < 100
    assert hurried.samples_per_ray < unhurried.samples_per_ray
    assert (hurried.width, hurried.height, hurried.threads) == (30, 20, 2)
    assert hurried.frame_ms > 0


def test_a_wrong_renderer_is_not_timed(numbers, monkeypatch):
    class Wrong(NgpRenderer):
        def render_colour(self, camera: Camera, samples_per_ray: int | None = None) -> F32:
            return super().render_colour(camera, samples_per_ray) + np.float32(1e-3)

    ngp.check_against_reference(numbers, CAMERA)
    monkeypatch.setattr(ngp, "NgpRenderer", Wrong)
    with pytest.raises(RfedgeError, match="nothing was timed"):
        ngp.check_against_reference(numbers, CAMERA)


def test_a_field_of_splats_is_not_a_hash_grid():
    with pytest.raises(InvalidInput, match="holds splats; give one of kind ngp"):
        ngp.ngp_rows(Path("samples/fields/street.rff"))
