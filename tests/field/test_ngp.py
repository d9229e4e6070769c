"""Hash grid fields: their files give them back, and damaged ones are refused by name."""

from collections.abc import Callable

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field import FieldMetadata, NgpField, Quality, load_field, save_field
from rfcore.field.archive import Archive, decode_archive, encode_archive
from rfcore.field.store import decode_field, encode_field
from rfcore.ngp.shape import HashGrid, Marching, NgpShape, Space, grid_levels, initial_parameters

METADATA = FieldMetadata("tile 7", TileOrigin(4e5, 5e6, 30.0), "ab" * 32, 25.5, 0.7, kind="ngp")


@pytest.fixture
def field() -> NgpField:
    space = Space((1.0, 2.0, 3.0), (4.0, 2.0, 1.0), True)
    grid = HashGrid(grid_levels(4, 3, 30, space.aspect), 8)
    shape = NgpShape(grid, space, Marching.between(0.2, 30.0, 8), 16, (20, 10, 5))
    rng = np.random.default_rng(0)
    occupancy = rng.integers(0, 1 << 32, shape.occupancy_words, dtype=np.uint32)
    occupancy[rng.random(len(occupancy)) < 0.5] = 0
    numbers = initial_parameters(shape, occupancy, rng)
    numbers.table[:] *= 1e4
    return NgpField(numbers, METADATA)


@pytest.fixture
def camera() -> Camera:
    return Camera(Intrinsics(19, 11, 12.0, 12.0, 9.5, 5.5), Pose((1, 2, 2.5), (1.0, 0, 0, 0)))


def test_a_saved_field_is_read_back_whole(field, camera, tmp_path):
    field_id = save_field(field, tmp_path / "a.rff")
    read = load_field(tmp_path / "a.rff", threads=2)
    assert isinstance(read, NgpField)
    assert read.field_id == field.field_id == field_id
    assert read.metadata == METADATA
    assert read.bounds == field.bounds
    assert read.bounds.low_m == (-3.0, 0.0, 2.0)
    assert encode_field(read) == encode_field(field)
    assert read.render_colour(camera).tobytes() == field.render_colour(camera).tobytes()


def test_a_field_with_other_threads_shares_the_numbers(field, camera):
    field.prepare()
    own = field.with_threads(2)
    assert own.numbers is field.numbers
    assert (own.field_id, own.metadata) == (field.field_id, field.metadata)
    assert own.renderer() is not field.renderer()
    assert own.renderer().threads == 2
    assert own.render_colour(camera).tobytes() == field.render_colour(camera).tobytes()


def test_the_field_is_what_its_file_can_hold(field):
    table = field.numbers.table
    assert np.array_equal(table, table.astype(np.float16).astype(np.float32))
    assert field.primitives == table.size + field.numbers.matrices.size


def test_samples_per_ray_is_the_knob_and_the_others_do_nothing(field, camera):
    full = field.render(camera)
    assert full.colour.tobytes() == field.render_colour(camera).tobytes()
    other = field.render_colour(camera, Quality(detail=0.1, sh_degree=0))
    assert other.tobytes() == full.colour.tobytes()
    hurried = field.render_colour(camera, Quality(samples_per_ray=2))
    assert hurried.tobytes() != full.colour.tobytes()
    assert full.confidence.shape == (11, 19)


def test_metadata_of_splats_is_refused(field):
    with pytest.raises(InvalidInput, match=r"field\.kind: 'splats'"):
        NgpField(field.numbers, FieldMetadata())


Change = Callable[[dict, dict], None]


def _set(key: str, value: object) -> Change:
    return lambda header, _: header["ngp"].__setitem__(key, value)


def _array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda _, arrays: arrays.__setitem__(name, change(arrays[name]))


def _poisoned(table: np.ndarray) -> np.ndarray:
    table = table.copy()
    table[3, 1] = np.inf
    return table


DAMAGES = {
    "a huge grid": (_set("level_cells", [[1 << 30] * 3]), "level_cells"),
    "a huge table": (_set("log2_T", 60), "log2_T"),
    "more entries than there are": (_set("log2_T", 20), "ngp.table"),
    "a fractional width": (_set("hidden", 16.5), "whole number"),
    "an unknown width": (_set("hidden", 17), "hidden"),
    "a huge occupancy": (_set("occupancy_cells", [1 << 20] * 3), "occupancy_cells"),
    "an empty box": (_set("half_m", [0.0, 1.0, 1.0]), "half_m"),
    "another box": (_set("centre_m", [0.0, 0.0, 0.0]), "bounds"),
    "steps that do not grow": (_set("growth", 1.0), "growth"),
    "steps beyond float32": (_set("steps", 8000), "steps"),
    "text for a flag": (_set("unbounded", "yes"), "unbounded"),
    "an infinite feature": (_array("table", _poisoned), "not finite"),
    "raw float32 features": (_array("table", lambda a: a.astype(np.float32)), "float16"),
    "a shorter network": (_array("matrices", lambda a: a[:-1]), "matrices"),
    "words out of order": (_array("occupancy_at", lambda a: a[::-1].copy()), "occupancy"),
    "words beyond the grid": (_array("occupancy_at", lambda a: a + np.uint32(900)), "occupancy"),
    "no table": (lambda _, arrays: arrays.pop("table"), "not a hash grid"),
    "no shape": (lambda header, _: header.pop("ngp"), "ngp"),
}


@pytest.mark.parametrize(("change", "named"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_file_that_makes_no_sense_is_refused_by_name(field, change, named):
    archive = decode_archive(encode_field(field))
    header, arrays = dict(archive.metadata), dict(archive.arrays)
    header["ngp"] = dict(header["ngp"])
    change(header, arrays)
    data = encode_archive(Archive("ngp", header, arrays))
    with pytest.raises(FieldFormatError, match=named) as refused:
        decode_field(data, "street.rff")
    assert "street.rff" in str(refused.value)


def test_a_grid_takes_no_more_memory_than_it_may(field):
    data, arrays = encode_field(field), field.archive().arrays
    occupancy_words = 20 * 10 * 5 // 32 + 1
    taken_bytes = 4 * (arrays["table"].size + arrays["matrices"].size + occupancy_words)
    assert decode_field(data, max_bytes=taken_bytes).field_id == field.field_id
    with pytest.raises(FieldFormatError, match="of memory, over the limit of"):
        decode_field(data, max_bytes=taken_bytes - 1)
