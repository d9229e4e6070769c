"""Notices of the street survive the wire; impossible ones are refused, unknown ones left out."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import ProtocolError
from rfcore.wire.convert_answers import AnswerReader, AnswerWriter
from rfcore.wire.notices import (
    NOTICE_KINDS,
    FieldChange,
    FieldChangeKind,
    ObjectAhead,
    StreetNotice,
    notice_to_wire,
)
from rfcore.wire.v1 import edge_pb2 as pb

FIELD = "ab" * 32
milliseconds = st.integers(0, 3_600_000).map(lambda ms: ms / 1e3)
metres = st.floats(-1e6, 1e6)
lengths = st.floats(0, 1e6)
objects = st.builds(
    ObjectAhead,
    st.just(FIELD),
    st.tuples(metres, metres, metres),
    st.tuples(metres, metres, metres),
    lengths,
    lengths,
    lengths,
    st.floats(0, 1),
    milliseconds,
    milliseconds,
    st.integers(0, 1000),
    st.sampled_from(["", "car"]),
)
changes = st.builds(
    FieldChange,
    st.sampled_from(FieldChangeKind),
    st.just("west"),
    st.just(FIELD),
    st.integers(1, 1000),
    st.sampled_from(["", "dusk"]),
)
notices = st.builds(StreetNotice, st.integers(0, 2**63), milliseconds, st.one_of(objects, changes))


@given(notice=notices)
def test_a_notice_survives_the_wire(notice: StreetNotice) -> None:
    (data,) = AnswerWriter().messages([notice])
    assert AnswerReader().messages(data) == [notice]
    assert notice.kind in NOTICE_KINDS


def sent(**changes: Any) -> bytes:
    ahead = ObjectAhead(
        FIELD, (1.0, 2.0, 0.0), (0.0, 0.0, 0.0), 1.8, 1.4, 20.0, 1.0, 2.0, 0.1, 1, "car"
    )
    message = notice_to_wire(StreetNotice(1, 1.0, ahead))
    for name, value in changes.items():
        setattr(message.object, name, value)
    return pb.StreamResponse(street_notice=message).SerializeToString()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"x_m": float("nan")}, "nan"),
        ({"velocity_z_mps": float("inf")}, "inf"),
        ({"width_m": -1.0}, "-1.0 is outside"),
        ({"distance_m": 1e10}, "1000000000"),
        ({"confidence": 1.5}, "confidence"),
        ({"field_id": "../x"}, "field_id"),
        ({"label": "a car\n"}, "label"),
    ],
)
def test_an_impossible_object_is_refused(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(ProtocolError, match=r"impossible notice.*" + problem):
        AnswerReader().messages(sent(**change))


def test_a_notice_that_holds_for_hours_is_refused() -> None:
    message = pb.StreetNotice(notice_id=1, valid_for_ms=3_600_001)
    message.field_change.CopyFrom(pb.FieldChange(kind=1, tile="west", field_id=FIELD, version=1))
    with pytest.raises(ProtocolError, match="valid_for_s"):
        AnswerReader().messages(pb.StreamResponse(street_notice=message).SerializeToString())


@pytest.mark.parametrize(
    "notice",
    [
        pb.StreetNotice(notice_id=1),
        pb.StreetNotice(notice_id=1, field_change=pb.FieldChange(kind=77)),
    ],
    ids=["subject", "kind"],
)
def test_what_only_a_newer_server_tells_of_is_left_out(notice: pb.StreetNotice) -> None:
    data = pb.StreamResponse(street_notice=notice).SerializeToString()
    assert AnswerReader().messages(data) == []
