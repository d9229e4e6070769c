"""Every reader ends with the newest message of every key, however slowly it reads."""

import json
import struct

from hypothesis import given
from hypothesis import strategies as st

from rfedge.twin.scene import Board, Message

KEYS = st.sampled_from("abc")
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("post"), KEYS, st.integers(0, 99)),
        st.tuples(st.just("clear"), KEYS, st.just(-1)),
        st.tuples(st.just("take"), st.just(""), st.just(0)),
        st.tuples(st.just("join"), st.just(""), st.just(0)),
    ),
    max_size=40,
)


def message(key: str, value: int) -> Message:
    return Message({"key": key, "value": value}, 0.0)


@given(STEPS)
def test_a_reader_ends_with_the_newest_of_every_key(steps: list[tuple[str, str, int]]) -> None:
    board = Board()
    shown: dict[str, int] = {}
    readers = [(board.read(lambda: None), dict[str, int]())]
    for step, key, value in steps:
        if step == "post":
            board.post(key, message(key, value))
            shown[key] = value
        elif step == "clear":
            board.clear(key, message(key, value))
            shown.pop(key, None)
        elif step == "join":
            readers.append((board.read(lambda: None), {}))
        elif (taken := readers[0][0].take()) is not None:
            readers[0][1][taken.header["key"]] = taken.header["value"]
    for reader, known in readers:
        while (taken := reader.take()) is not None:
            known[taken.header["key"]] = taken.header["value"]
        assert {key: value for key, value in known.items() if value >= 0} == shown


def test_a_reader_is_woken_counts_what_it_missed_and_holds_one_message_a_key() -> None:
    board, calls = Board(), []
    reader = board.read(lambda: calls.append(1))
    for value in range(5):
        board.post("a", message("a", value))
    assert len(calls) == 5
    assert reader.missed == 4
    taken = reader.take()
    assert taken is not None
    assert taken.header["value"] == 4
    assert reader.take() is None


def test_one_that_left_is_told_nothing() -> None:
    board, calls = Board(), []
    reader = board.read(lambda: calls.append(1))
    board.leave(reader)
    board.post("a", message("a", 1))
    assert not calls


def test_a_message_says_how_long_its_parts_are_and_how_long_it_waited() -> None:
    data = Message({"kind": "x"}, 2.0, (b"abc", b"", b"de")).encode(2.5)
    (length,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + length])
    assert header == {"kind": "x", "held_ms": 500.0, "part_bytes": [3, 0, 2]}
    assert data[4 + length :] == b"abcde"
