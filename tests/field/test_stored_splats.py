"""What a field takes of splats that are not finite, too many colours, or far away; and says so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError
from rfcore.field.ply_table import read_vertices, write_vertices
from rfcore.field.splat_file import read_splat_file
from rfcore.field.splat_ply import write_ply
from rfcore.field.stored_splats import (
    FLAT_LOG_SCALE,
    OPAQUE_LOGIT,
    ImportedSplats,
    StoredSplats,
    settled,
)
from tests.field.some import make_gaussians

UTM = TileOrigin(500_000.0, 5_400_000.0, 300.0)
N = 10


def stored(degree: int = 1) -> StoredSplats:
    given = make_gaussians(N, min(degree, 3))
    sh = np.random.default_rng(1).normal(size=(N, (degree + 1) ** 2, 3)).astype(np.float32)
    sh[:, : given.sh.shape[1]] = given.sh
    means_m = given.means.astype(np.float64)
    return StoredSplats(means_m, given.quaternions, given.log_scales, given.opacity_logits, sh)


def settle(splats: StoredSplats, origin: TileOrigin | None = None) -> ImportedSplats:
    return settled(Path("a.ply"), splats, origin)


def test_what_is_finite_and_near_is_taken_as_it_is_and_nothing_is_said():
    read, given = settle(stored()), make_gaussians(N, 1)
    for name, array in vars(given).items():
        np.testing.assert_array_equal(getattr(read.splats, name), array)
    assert (read.tile_origin, read.notes) == (TileOrigin(), ())


def test_infinite_opacities_and_no_width_are_limits():
    given = stored()
    given.opacity_logits[:3] = np.inf, -np.inf, np.inf
    given.log_scales[4:6, 1] = -np.inf
    read = settle(given)
    limits = [OPAQUE_LOGIT, -OPAQUE_LOGIT, OPAQUE_LOGIT]
    assert read.splats.opacity_logits[:3].tolist() == pytest.approx(limits)
    assert (read.splats.log_scales[4:6, 1] == FLAT_LOG_SCALE).all()
    assert len(read.splats) == N
    flat, opaque = read.notes
    assert opaque.startswith("3 of 10 splats are fully opaque")
    assert flat.startswith("2 of 10 splats have a scale of 0")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["means_m", "quaternions", "log_scales", "sh"])
def test_a_splat_that_is_not_finite_is_left_out_and_counted(name, bad):
    given, whole = stored(), settle(stored()).splats
    getattr(given, name)[3].reshape(-1)[0] = bad
    read = settle(given)
    for key, array in vars(whole).items():
        np.testing.assert_array_equal(getattr(read.splats, key), np.delete(array, 3, axis=0))
    assert "1 of 10 splats are not finite" in read.notes[0]
    assert name.removesuffix("_m") in read.notes[0]


def test_nan_opacities_are_left_out_too():
    given = stored()
    given.opacity_logits[7] = np.nan
    assert len(settle(given).splats) == N - 1


def test_more_than_half_that_is_not_finite_is_refused():
    given = stored()
    given.means_m[: N // 2 + 1] = np.nan
    with pytest.raises(
        FieldFormatError, match=r"a\.ply: 6 of 10 splats are not finite \(means of 6"
    ):
        settle(given)


def test_the_fourth_band_is_left_out():
    given = stored(degree=4)
    read = settle(given)
    np.testing.assert_array_equal(read.splats.sh, given.sh[:, :16])
    assert read.notes == ("colours of SH degree 4 are reduced to degree 3",)


def test_a_far_place_becomes_the_origin_in_float64():
    near, far = stored(), stored()
    offset_m = np.array([UTM.east_m, UTM.north_m, UTM.up_m])
    far = replace(far, means_m=far.means_m + offset_m)
    read = settle(far)
    moved_m = np.array([getattr(read.tile_origin, a) for a in ("east_m", "north_m", "up_m")])
    assert np.abs(moved_m - offset_m).max() <= 2, "the median of normal means, in whole metres"
    np.testing.assert_allclose(read.splats.means + moved_m - offset_m, near.means_m, atol=1e-6)
    assert "tile origin" in read.notes[0]
    given = settle(far, UTM)
    assert (given.tile_origin, given.notes) == (UTM, ())


def test_float32_far_from_zero_is_remarked_upon_and_float64_is_not(tmp_path):
    write_ply(tmp_path / "near.ply", make_gaussians(N, 0))
    table = read_vertices(tmp_path / "near.ply", ())
    far = table.astype([(name, "<f8" if name in "xyz" else "<f4") for name in table.dtype.names])
    for axis, value in zip("xyz", (UTM.east_m, UTM.north_m, UTM.up_m), strict=True):
        far[axis] += value
    write_vertices(tmp_path / "f8.ply", far)
    write_vertices(tmp_path / "f4.ply", far.astype(table.dtype))
    assert "steps" not in " ".join(read_splat_file(tmp_path / "f8.ply").notes)
    assert "steps of 0.5 m" in read_splat_file(tmp_path / "f4.ply").notes[1]


def test_sky_does_not_move_the_origin():
    given = stored()
    given.means_m[:4] *= 1e5
    assert settle(given).tile_origin == TileOrigin()
