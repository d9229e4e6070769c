"""Bits and NAL units: writing then reading is the identity, and no bytes break the readers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.codec.h264.bitstream import (
    BitReader,
    BitWriter,
    join_nals,
    nal_of_rbsp,
    nal_type,
    parse_slice_start,
    rbsp_of_nal,
    split_nals,
)
from rfcore.errors import BitstreamError, InvalidInput

# Few zero bytes occur in uniform bytes; these have runs of them.
zeros_heavy = st.lists(st.sampled_from([0, 0, 0, 1, 2, 3, 4, 255]), max_size=60).map(bytes)
rbsp = (zeros_heavy | st.binary(max_size=60)).map(lambda data: data + b"\x80")
field = st.one_of(
    st.tuples(st.just("u"), st.integers(0, 2**20 - 1)),
    st.tuples(st.just("ue"), st.integers(0, 2**32 - 2)),
)


@given(st.lists(field, max_size=30))
def test_what_is_written_is_read_back(fields):
    writer = BitWriter()
    for kind, value in fields:
        if kind == "u":
            writer.u(20, value)
        else:
            getattr(writer, kind)(value)
    reader = BitReader(writer.stop().to_bytes())
    for kind, value in fields:
        assert (reader.u(20) if kind == "u" else getattr(reader, kind)()) == value
    assert reader.u(1) == 1, "the stop bit"


@pytest.mark.parametrize(
    ("value", "bits"), [(0, "1"), (1, "010"), (2, "011"), (3, "00100"), (25, "000011010")]
)
def test_exp_golomb_codes_are_those_of_table_9_2(value, bits):
    padded = bits + "0" * (-len(bits) % 8)
    expected = int(padded, 2).to_bytes(len(padded) // 8, "big")
    assert BitWriter().ue(value).align().to_bytes() == expected
    signed = (value + 1) // 2 if value % 2 else -(value // 2)
    assert BitWriter().se(signed).align().to_bytes() == expected, "table 9-3"


@given(rbsp)
def test_emulation_prevention_is_undone_and_hides_every_start_code(data):
    nal = nal_of_rbsp(0x41, data)
    assert rbsp_of_nal(nal) == data
    assert not any(code in nal for code in (b"\0\0\0", b"\0\0\1", b"\0\0\2"))


def test_emulation_prevention_goes_before_each_byte_up_to_three():
    assert nal_of_rbsp(0x65, b"\0\0\0\0\0\1\x80") == b"\x65\0\0\3\0\0\3\0\1\x80"
    assert nal_of_rbsp(0x65, b"\0\0\3\x80") == b"\x65\0\0\3\3\x80"
    assert nal_of_rbsp(0x65, b"\0\0\4\x80") == b"\x65\0\0\4\x80"


@given(st.lists(rbsp, min_size=1, max_size=5))
def test_a_byte_stream_splits_into_the_units_it_was_joined_from(payloads):
    nals = [nal_of_rbsp(0x41, payload) for payload in payloads]
    assert split_nals(join_nals(nals)) == nals


def test_start_codes_of_three_bytes_and_trailing_zeros_split_too():
    assert split_nals(b"\0\0\1\x67\x80\0\0\0\0\1\x68\x80\0\0") == [b"\x67\x80", b"\x68\x80"]


@pytest.mark.parametrize("stream", [b"", b"\x67", b"\x01\0\0\1\x67", b"\0\0\1", b"\0\0\1\0\0\1A"])
def test_what_is_no_byte_stream_is_refused(stream):
    with pytest.raises(BitstreamError):
        split_nals(stream)


@given(zeros_heavy | st.binary(max_size=80), st.sampled_from([b"", b"\x67", b"\x68", b"\x41"]))
def test_arbitrary_bytes_raise_only_our_error(data, header):
    nal = header + data
    for read in (split_nals, rbsp_of_nal, nal_type, parse_slice_start):
        try:
            read(nal)
        except BitstreamError:
            continue


def test_a_code_without_end_is_refused():
    with pytest.raises(BitstreamError, match="leading zeros"):
        BitReader(bytes(40)).ue()
    reader = BitReader(b"\xff")
    reader.u(4)
    with pytest.raises(BitstreamError, match="8 bits wanted, 4 left"):
        reader.u(8)


def test_values_that_do_not_fit_are_refused():
    with pytest.raises(InvalidInput, match="4 does not fit 2 bits"):
        BitWriter().u(2, 4)
    with pytest.raises(InvalidInput, match=r"ue\(-1\)"):
        BitWriter().ue(-1)
    with pytest.raises(InvalidInput, match="3 bits are not whole bytes"):
        BitWriter().u(3, 1).to_bytes()
    with pytest.raises(InvalidInput, match="stop bit"):
        nal_of_rbsp(0x41, b"\x80\0")
