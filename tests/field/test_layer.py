"""A colour layer: what it adds, which base it is for, and that its id says so."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import FieldFormatError, InvalidInput, UnknownField
from rfcore.field import FieldStore, SplatField, load_field, save_field
from rfcore.field.archive import Archive, encode_archive
from rfcore.field.layer import (
    VOXELS_M,
    ColourLayer,
    layer_archive,
    layered_colours,
    layered_field,
    voxels_of,
)
from rfcore.field.store import decode_field, encode_field
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians
from tests.field.some import make_gaussians


def empty_layer(gaussians: Gaussians, bands: int = 64) -> ColourLayer:
    counts = [voxels_of(gaussians.means, side_m)[1] for side_m in VOXELS_M]
    voxels = tuple(np.zeros((count, 6), np.int32) for count in counts)
    return ColourLayer(voxels, np.zeros((len(gaussians), 3), np.int32), bands)


def some_layer(gaussians: Gaussians, seed: int = 3) -> ColourLayer:
    rng = np.random.default_rng(seed)
    empty = empty_layer(gaussians)
    voxels = tuple(rng.integers(-9, 9, v.shape).astype(np.int32) for v in empty.voxels)
    return ColourLayer(voxels, rng.integers(-5, 5, empty.own.shape).astype(np.int32), 32)


def layered(base: SplatField, layer: ColourLayer) -> SplatField:
    return layered_field(layer_archive(layer, base, base.metadata), base, base.metadata)


def test_a_layer_of_zeros_changes_nothing():
    gaussians = make_gaussians(40)
    assert (layered_colours(gaussians, empty_layer(gaussians)).sh == gaussians.sh).all()


def test_a_voxel_moves_the_splats_in_it_and_no_other():
    """It moves the first of two splats 1 m apart, by one luma step of 2 / 255."""
    arrays = {
        "means": [[0.1, 0.1, 0.1], [1.1, 0.1, 0.1]], "quaternions": [[1, 0, 0, 0]] * 2,
        "log_scales": [[0, 0, 0]] * 2, "opacity_logits": [0, 0], "sh": [[[0.5, 0.5, 0.5]]] * 2,
    }  # fmt: skip
    gaussians = Gaussians(**{name: np.asarray(a, np.float32) for name, a in arrays.items()})
    layer = empty_layer(gaussians)
    layer.voxels[0][0, 0] = 1
    moved = layered_colours(gaussians, layer).sh - gaussians.sh
    np.testing.assert_allclose(moved[0, 0], 2 / 255 / SH_DC, rtol=1e-5)
    assert (moved[1] == 0).all()


def test_voxels_are_counted_in_the_order_of_their_corners():
    means = np.array([[5, 0, 0], [-1, 0, 0], [5.1, 0, 0], [-1, 0, 3]], np.float32)
    voxel, count = voxels_of(means, 1.0)
    cells = np.unique(np.floor(means), axis=0, return_inverse=True)
    assert count == len(cells[0])
    assert voxel.tolist() == cells[1].reshape(-1).tolist() == [2, 0, 2, 1]
    assert voxels_of(means[:0], 1.0)[1] == 0


def test_base_and_layer_are_read_back_as_they_were(tmp_path):
    base = SplatField(make_gaussians(60))
    made = layered(base, some_layer(base.gaussians))
    save_field(base, tmp_path / "noon.rff")
    field_id = save_field(made, tmp_path / "dusk.rff")
    again = load_field(tmp_path / "dusk.rff")
    assert isinstance(again, SplatField)
    assert again.field_id == field_id == made.field_id != base.field_id
    assert (again.gaussians.sh == made.gaussians.sh).all()
    assert again.gaussians.means is not None
    assert (again.gaussians.means == base.gaussians.means).all()


def test_numbers_that_are_all_zero_take_no_bytes():
    base = SplatField(make_gaussians(3000))
    nothing = layered(base, empty_layer(base.gaussians))
    assert nothing.archive().arrays == {}
    again = decode_field(encode_field(nothing), open_base=lambda _: base)
    assert isinstance(again, SplatField)
    assert (again.gaussians.sh == base.gaussians.sh).all()


def test_another_base_is_refused():
    base, other = SplatField(make_gaussians(20)), SplatField(make_gaussians(20, seed=1))
    archive = layer_archive(some_layer(base.gaussians), base, base.metadata)
    with pytest.raises(InvalidInput, match=r"layer.base: is for field"):
        layered_field(archive, other, other.metadata)


def test_a_layer_on_a_layer_is_refused():
    base = SplatField(make_gaussians(20))
    once = layered(base, some_layer(base.gaussians))
    with pytest.raises(InvalidInput, match="is a layer itself"):
        layered(once, some_layer(base.gaussians))


def test_a_layer_without_its_base_says_which_one_it_lacks(tmp_path):
    base = SplatField(make_gaussians(20))
    made = layered(base, some_layer(base.gaussians))
    save_field(made, tmp_path / "dusk.rff")
    with pytest.raises(UnknownField, match=base.field_id):
        load_field(tmp_path / "dusk.rff")
    with pytest.raises(UnknownField, match=base.field_id):
        FieldStore(tmp_path / "store").add(tmp_path / "dusk.rff")
    assert FieldStore(tmp_path / "store").ids() == ()


def test_a_store_opens_a_layer_with_the_base_it_holds(tmp_path):
    base = SplatField(make_gaussians(20))
    made = layered(base, some_layer(base.gaussians))
    store = FieldStore(tmp_path)
    store.add(encode_field(base))
    field_id = store.add(encode_field(made))
    loaded = store.load(field_id)
    assert isinstance(loaded, SplatField)
    assert (loaded.gaussians.sh == made.gaussians.sh).all()


def test_a_described_layer_stands_on_its_own():
    base = SplatField(make_gaussians(20))
    made = layered(base, some_layer(base.gaussians))
    named = made.described(replace(made.metadata, name="dusk"))
    again = decode_field(encode_field(named))
    assert isinstance(again, SplatField)
    assert again.metadata.name == "dusk"
    assert (again.gaussians.sh == made.gaussians.sh).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "nothing"}, "is no field id"),
        ({"encoding": {"name": "voxels-2"}}, "is not 'voxels-1'"),
        (
            {"encoding": {"name": "voxels-1", "bands": 2.5, "streams": {}}},
            "not a whole number",
        ),
    ],
)
def test_a_header_that_is_wrong_is_refused(change, message):
    base = SplatField(make_gaussians(20))
    archive = layer_archive(some_layer(base.gaussians), base, base.metadata)
    wrong = Archive(archive.kind, {**archive.metadata, **change}, archive.arrays)
    with pytest.raises(FieldFormatError, match=message):
        decode_field(encode_archive(wrong), open_base=lambda _: base)


def test_counts_beyond_the_splats_are_refused_before_anything_is_made():
    base = SplatField(make_gaussians(20))
    archive = layer_archive(some_layer(base.gaussians), base, base.metadata)
    encoding = archive.metadata["encoding"]
    counts = {**encoding["counts"], "own": 1 << 40}
    wrong = {**archive.metadata, "encoding": {**encoding, "counts": counts}}
    with pytest.raises(FieldFormatError, match=r"outside 0\.\.20"):
        decode_field(
            encode_archive(Archive(archive.kind, wrong, archive.arrays)), open_base=lambda _: base
        )
