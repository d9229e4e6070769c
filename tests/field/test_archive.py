"""The field archive: what goes in comes out, and no damage goes unnoticed."""

import hashlib
import json
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.archive import Archive, decode_archive, encode_archive

arrays = hnp.arrays(
    dtype=st.sampled_from(["<f4", "<f8", "|u1", "<i4"]),
    shape=hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=7),
)
names = st.text(max_size=12)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
    max_leaves=8,
)
archives = st.builds(
    Archive, names, st.dictionaries(names, json_values, max_size=3), st.dictionaries(names, arrays)
)


def small() -> bytes:
    content = {"a": np.arange(5, dtype="<f4"), "b": np.full((2, 33), 7, "|u1")}
    return encode_archive(Archive("splats", {"name": "street", "held_out": 26.5}, content))


def with_header(change: dict[str, Any]) -> bytes:
    """An archive whose header says something else, with its digest put right."""
    data = small()
    length = struct.unpack_from("<I", data, 12)[0]
    header = json.loads(data[64 : 64 + length])
    end = 64 + -(-length // 64) * 64
    raw = json.dumps({**header, **change}).encode()
    prefix = struct.pack("<8sII32s16x", b"RFFIELD\0", 1, len(raw), hashlib.sha256(raw).digest())
    return prefix + raw + bytes(-len(raw) % 64) + data[end:]


@given(archives)
def test_what_goes_in_comes_out(archive):
    data = encode_archive(archive)
    back = decode_archive(data)
    assert len(data) % 64 == 0
    assert back.kind == archive.kind
    assert back.metadata == archive.metadata
    assert list(back.arrays) == list(archive.arrays)
    for name, array in archive.arrays.items():
        assert back.arrays[name].dtype == array.dtype
        assert back.arrays[name].shape == array.shape
        assert back.arrays[name].tobytes() == array.tobytes()
    assert encode_archive(back) == data, "equal content, equal bytes"


def test_version_1_stays_as_it_is():
    """Fields are addressed by these bytes: a change here needs a new version."""
    golden = "f9f0c76a0d9891873e24362a8dd71c2be0c55f668e0b6ea7357fde49bb4cbf15"
    assert hashlib.sha256(small()).hexdigest() == golden


def test_every_truncation_is_refused():
    data = small()
    for length in range(len(data)):
        with pytest.raises(FieldFormatError, match=r"^field: "):
            decode_archive(data[:length])


@pytest.mark.parametrize("extra", [b"\0", b"\0" * 64, b"x" * 100])
def test_bytes_after_the_end_are_refused(extra):
    with pytest.raises(FieldFormatError):
        decode_archive(small() + extra)


def test_every_flipped_bit_is_refused():
    data = bytearray(small())
    for position in range(len(data)):
        data[position] ^= 1 << position % 8
        with pytest.raises(FieldFormatError):
            decode_archive(bytes(data))
        data[position] ^= 1 << position % 8


@given(st.binary(max_size=300))
def test_noise_is_refused(noise):
    with pytest.raises(FieldFormatError):
        decode_archive(noise)
    with pytest.raises(FieldFormatError):
        decode_archive(small()[:64] + noise)


def array_entry(**change: Any) -> dict[str, Any]:
    entry = {"name": "a", "dtype": "<f4", "shape": [5], "offset": 0, "sha256": "00"}
    return {"arrays": [{**entry, **change}]}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (array_entry(shape=[2_000_000_000, 59]), "472000000000 bytes does not fit"),
        (array_entry(shape=[2**63, 2**63, 2**63]), "does not fit"),
        (array_entry(shape=[0, 2**62]), r"shape \[0, 4611686018427387904\], of nothing"),
        (array_entry(shape=[-1]), r"shape \[-1\]"),
        (array_entry(shape=[True]), r"shape \[True\]"),
        (array_entry(shape=[1.0]), r"shape \[1.0\]"),
        (array_entry(shape=[1, 1, 1, 1, 1]), "shape"),
        (array_entry(shape=None), "shape None"),
        (array_entry(dtype="|O"), "dtype '|O'"),
        (array_entry(dtype=">f4"), "dtype '>f4'"),
        (array_entry(dtype=["<f4"]), "dtype"),
        (array_entry(offset=64), "should start at byte 0, not 64"),
        (array_entry(), "array 'a' is damaged"),
        (array_entry(name=None), "has no name"),
        ({"arrays": [3]}, "has no name"),
        ({"arrays": None}, "lacks"),
        ({"metadata": []}, "lacks"),
        ({"kind": 3}, "lacks"),
        ({"arrays": []}, "192 bytes after the last array"),
        ({"data_bytes": 0}, "192 bytes of arrays, the header says 0"),
        ({"metadata": {"x": float("nan")}}, "NaN is not a number"),
    ],
)
def test_a_header_that_lies_is_refused_by_name(change, named):
    with pytest.raises(FieldFormatError, match=named):
        decode_archive(with_header(change))


def test_an_array_listed_twice_is_refused():
    data = small()
    length = struct.unpack_from("<I", data, 12)[0]
    entries = json.loads(data[64 : 64 + length])["arrays"]
    entries[1]["name"] = "a"
    with pytest.raises(FieldFormatError, match="'a' is there twice"):
        decode_archive(with_header({"arrays": entries}))


def test_arrays_the_format_does_not_know_are_not_written():
    with pytest.raises(InvalidInput, match=r"archive\.a"):
        Archive("splats", {}, {"a": np.array(["text"])})
