"""What the page is told of fields and cameras."""

from dataclasses import replace
from typing import Any

from rfcore.camera import TileOrigin
from rfcore.field import FieldMetadata, SplatField
from rfedge.twin.scene import Board, PlacedField, Reader, TwinScene
from wall_scene import seen, wall_field


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


def test_a_new_version_of_a_tile_takes_the_place_of_the_old(wall: SplatField) -> None:
    board = Board()
    scene = TwinScene(board)
    newer = wall_field(0.6)
    scene.place(PlacedField(wall, "a", b"x"), 0.0)
    scene.place(PlacedField(newer, "a", b"y"), 0.0)
    (fields,) = told(board.read(lambda: None))
    assert [f["field"] for f in fields["fields"]] == [newer.field_id]
    assert scene.field(wall.field_id) is None


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
