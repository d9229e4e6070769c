"""The page is told of fields, cameras and tiles, as are readers of the board."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Pose, TileOrigin
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, SplatField, save_field
from rfcore.image import write_png
from rfcore.vertical import Sight
from rfcore.wire.tiles import LearntLight, Tile, TileLight, learnt_message, learnt_of
from rfedge.cli.twin import Twin
from rfedge.twin.scene import Board, Message, PlacedField, Reader, TwinScene
from rfedge.twin.server_source import tile_rows
from wall_scene import INTRINSICS, seen, wall_field


def told(reader: Reader) -> list[dict[str, Any]]:
    headers = []
    while (message := reader.take()) is not None:
        headers.append(dict(message.header))
    return headers


def at(field: SplatField, east_m: float) -> SplatField:
    metadata = FieldMetadata(tile_origin=TileOrigin(east_m, 0.0, 0.0))
    return SplatField(field.gaussians, metadata)


def test_tiles_lie_where_their_origins_say_relative_to_the_first(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    first, second = at(wall, 4.5e6), at(wall, 4.5e6 + 120.25)
    scene.place(PlacedField(first, "a", b"x"), 0.0)
    scene.place(PlacedField(second, "b", b"x"), 0.0)
    scene.show(replace(seen(second), field_id=second.field_id), 0.0)
    fields, picture = told(board.read(lambda: None))
    assert [f["origin_m"] for f in fields["fields"]] == [(0.0, 0.0, 0.0), (120.25, 0.0, 0.0)]
    assert picture["origin_m"] == (120.25, 0.0, 0.0)


def test_the_page_is_told_the_vertical_of_a_field_and_where_its_cameras_stood(
    wall: SplatField,
) -> None:
    sight = Sight((1.0, 2.0, 3.0), (0.0, 0.0, 1.0))
    field = wall.described(FieldMetadata(up=(0.0, -1.0, 0.0), sights=(sight,)))
    board = Board()
    scene = TwinScene(board)
    scene.place(PlacedField(field, "a", b"x"), 0.0)
    (shown,) = told(board.read(lambda: None))[0]["fields"]
    assert shown["up"] == (0.0, -1.0, 0.0)
    assert shown["start"] == {"eye_m": (1.0, 2.0, 3.0), "towards": (0.0, 0.0, 1.0)}


def test_a_vertical_that_is_asked_for_goes_before_that_of_a_field(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    scene.up = (0.0, 1.0, 0.0)
    scene.place(PlacedField(wall, "a", b"x"), 0.0)
    (shown,) = told(board.read(lambda: None))[0]["fields"]
    assert (shown["up"], shown["start"]) == ((0.0, 1.0, 0.0), None)


def test_without_a_vertical_of_the_field_the_cameras_of_the_drive_show_it(
    wall: SplatField, tmp_path: Path
) -> None:
    save_field(wall, tmp_path / "wall.rff")
    write_png(tmp_path / "a.png", np.zeros((64, 96, 3), np.uint8))
    taken = WrittenPicture("a.png", SourceCamera(INTRINSICS), Pose.identity())
    write_transforms(tmp_path, [taken], None)
    twin = Twin(str(tmp_path / "wall.rff"), drive=tmp_path)
    for asked, up in ((twin, (0.0, -1.0, 0.0)), (replace(twin, up="y"), (0.0, 1.0, 0.0))):
        scene = TwinScene(Board())
        asked._source()(scene)
        assert scene.up == up


def test_a_new_version_of_a_tile_takes_the_place_of_the_old(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    newer = wall_field(0.6)
    scene.place(PlacedField(wall, "a", b"x"), 0.0)
    scene.place(PlacedField(newer, "a", b"y"), 0.0)
    (fields,) = told(board.read(lambda: None))
    assert [f["field"] for f in fields["fields"]] == [newer.field_id]
    assert scene.field(wall.field_id) is None


def test_a_field_that_is_published_no_more_is_taken_away(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    old, new = at(wall, 1.0), at(wall, 2.0)
    scene.place(PlacedField(old, "old", b"x"), 0.0)
    scene.note("never came", "being fetched", 0.0)
    scene.place(PlacedField(new, "new", b"x"), 0.0)
    reader = board.read(lambda: None)
    told(reader)
    scene.keep({"new"}, 0.0)
    assert scene.field_ids == (new.field_id,)
    (said,) = told(reader)
    assert [field["tile"] for field in said["fields"]] == ["new"]
    assert said["notes"] == []
    scene.keep({"new"}, 0.0)
    assert told(reader) == []


def test_what_becomes_of_a_field_is_said_until_it_is_there(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    reader = board.read(lambda: None)
    scene.note("a", "being fetched", 0.0)
    assert told(reader)[0]["notes"] == [{"tile": "a", "text": "being fetched"}]
    scene.place(PlacedField(wall, "a", b""), 0.0)
    assert told(reader)[0]["notes"] == []


def test_a_camera_that_left_is_not_shown_to_those_who_come_later(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    early = board.read(lambda: None)
    picture = seen(wall)
    scene.show(picture, 0.0)
    scene.leave(picture.key, 0.0)
    assert [header["kind"] for header in told(early)] == ["departure"]
    assert told(board.read(lambda: None)) == []
    assert not scene.newest


def test_splats_are_made_for_the_page(wall: SplatField) -> None:
    assert PlacedField.of(wall, "a").spz[:2] == b"\x1f\x8b"


# --- the operator's table: which lights a tile has, and what its server learnt of them


OWN, DUSK, OLD = "a" * 64, "b" * 64, "c" * 64
TILE = Tile("west", OWN, 3, lights=(TileLight("h18", DUSK, 4, OWN, 2, 18.25),))
LEARNT = LearntLight("west", "h18", DUSK, 2, 1_767_290_400_000, 0.53)
NOTHING_LEARNT = {"learnt_ms": None, "saved_ratio": None, "withdrawn": False}


def test_each_light_has_a_row_with_what_was_learnt_of_it() -> None:
    own, dusk = tile_rows([TILE], [LEARNT])
    assert own == {
        "tile": "west", "light": "", "version": 3, "time_of_day_h": None, "passes": 0,
        **NOTHING_LEARNT,
    }  # fmt: skip
    assert dusk == {
        "tile": "west", "light": "h18", "version": 4, "time_of_day_h": 18.25, "passes": 2,
        "learnt_ms": 1_767_290_400_000, "saved_ratio": 0.53, "withdrawn": False,
    }  # fmt: skip


def test_what_was_withdrawn_saves_nothing() -> None:
    withdrawn = replace(LEARNT, light="", field_id=OLD, withdrawn=True)
    own, dusk = tile_rows([TILE], [withdrawn])
    assert (own["saved_ratio"], own["withdrawn"], own["passes"]) == (0.0, True, 0)
    assert dusk["learnt_ms"] is None


def test_a_version_published_by_hand_since_was_not_learnt() -> None:
    _, dusk = tile_rows([TILE], [replace(LEARNT, field_id=OLD)])
    assert {name: dusk[name] for name in NOTHING_LEARNT} == NOTHING_LEARNT
    assert dusk["passes"] == 2


def test_the_table_is_sent_again_only_when_it_changes() -> None:
    board = Board()
    reader, scene = board.read(lambda: None), TwinScene(board)
    sent = []
    for saved_ratio in (0.53, 0.53, 0.6):
        scene.show_tiles(tile_rows([TILE], [replace(LEARNT, saved_ratio=saved_ratio)]), 0.0)
        message = reader.take()
        sent.append(None if message is None else message.header["rows"][1]["saved_ratio"])
    assert sent == [0.53, None, 0.6]


def test_what_was_learnt_survives_the_wire_and_is_checked() -> None:
    assert learnt_of(learnt_message(LEARNT)) == LEARNT
    message = learnt_message(LEARNT)
    message.saved_ratio = float("nan")
    with pytest.raises(InvalidInput, match="saved_ratio"):
        learnt_of(message)


# --- every reader ends with the newest message of every key, however slowly it reads


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
