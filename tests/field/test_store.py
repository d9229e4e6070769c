"""A store gives back what was added, by id, and is never left with half a field."""

import os
from functools import partial

import pytest

from rfcore.errors import FieldFormatError, UnknownField
from rfcore.field import FieldStore, SplatField, save_field
from rfcore.field.store import decode_field, encode_field, load_checked, load_field
from tests.field.some import make_gaussians


def test_an_added_field_is_listed_found_and_loaded(tmp_path):
    store = FieldStore(tmp_path / "fields")
    assert store.ids() == ()
    field = SplatField(make_gaussians())
    assert store.add(encode_field(field)) == field.field_id
    assert store.ids() == (field.field_id,)
    assert store.path(field.field_id).name == f"{field.field_id}.rff"
    assert store.load(field.field_id).field_id == field.field_id


def test_a_file_may_be_added_under_its_expected_id(tmp_path):
    field_id = save_field(SplatField(make_gaussians()), tmp_path / "street.rff")
    store = FieldStore(tmp_path / "fields")
    assert store.add(tmp_path / "street.rff", field_id) == field_id
    assert store.add(tmp_path / "street.rff", field_id) == field_id, "adding twice is harmless"
    assert store.ids() == (field_id,)


def test_a_file_of_any_name_is_found_by_its_content(tmp_path):
    field_id = save_field(SplatField(make_gaussians()), tmp_path / "street.rff")
    store = FieldStore(tmp_path)
    assert store.path(field_id) == tmp_path / "street.rff"
    other_id = save_field(SplatField(make_gaussians(seed=1)), tmp_path / "street.rff")
    assert store.ids() == (other_id,), "a file that changes is looked at again"


@pytest.mark.parametrize("name", ["0" * 64, "../secret", "", "nonsense"])
def test_an_unknown_id_names_itself_and_what_is_here(tmp_path, name):
    store = FieldStore(tmp_path)
    with pytest.raises(UnknownField, match="holds nothing"):
        store.path(name)
    here = store.add(encode_field(SplatField(make_gaussians())))
    with pytest.raises(UnknownField, match=here) as caught:
        store.load(name)
    assert repr(name) in str(caught.value)


def test_a_compressed_field_is_kept_as_it_came(tmp_path):
    store = FieldStore(tmp_path)
    field = SplatField(make_gaussians(30)).compressed()
    data = encode_field(field)
    assert store.add(data) == field.field_id
    assert store.path(field.field_id).read_bytes() == data
    assert store.load(field.field_id, threads=2).field_id == field.field_id


def test_damaged_bytes_are_not_added(tmp_path):
    store = FieldStore(tmp_path)
    field = SplatField(make_gaussians())
    data = bytearray(encode_field(field))
    data[-100] ^= 1
    with pytest.raises(FieldFormatError, match="damaged"):
        store.add(bytes(data))
    with pytest.raises(FieldFormatError, match=f"not the field id {field.field_id}"):
        store.add(bytes(data), field.field_id)
    assert list(tmp_path.iterdir()) == []


def test_a_field_damaged_in_the_store_is_refused(tmp_path):
    store = FieldStore(tmp_path)
    field_id = store.add(encode_field(SplatField(make_gaussians())))
    path = store.path(field_id)
    path.write_bytes(path.read_bytes()[:-64])
    with pytest.raises(FieldFormatError, match="not the field id"):
        store.load(field_id)


def test_a_file_longer_than_its_field_may_be_is_refused_unread(tmp_path):
    long, field_id = tmp_path / "long.rff", "0" * 64
    with long.open("wb") as file:
        file.truncate(1 << 40)
    for load in (load_field, partial(load_checked, field_id=field_id)):
        with pytest.raises(FieldFormatError, match=r"1\.1e\+03 GB are over the limit of 0\.01 GB"):
            load(long, max_bytes=10**7)


def test_a_pipe_is_refused_and_hangs_nobody(tmp_path):
    os.mkfifo(tmp_path / "pipe.rff")
    with pytest.raises(FieldFormatError, match="is no file, but a pipe, a folder or a device"):
        load_field(tmp_path / "pipe.rff")


def test_a_raw_archive_takes_no_more_memory_than_it_may():
    field = SplatField(make_gaussians(40))
    data = encode_field(field)
    taken_bytes = sum(array.nbytes for array in field.archive().arrays.values())
    assert decode_field(data, max_bytes=taken_bytes).primitives == 40
    with pytest.raises(FieldFormatError, match="of memory, over the limit of"):
        decode_field(data, max_bytes=taken_bytes - 1)
