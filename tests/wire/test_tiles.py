"""Tiles travel unchanged, and wrong ones are named."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.wire.tiles import PREVIEW, Area, Tile, TileLight, tile_message, tile_of
from rfcore.wire.v1 import field_pb2 as pb

ID = "ab" * 32
metres = st.floats(-1e7, 1e7, allow_nan=False)


@given(metres, metres, st.floats(1e-3, 1e6), st.floats(1e-3, 1e6), st.floats(0, 1e6))
def test_a_tile_travels_unchanged(
    east_m: float, north_m: float, wide_m: float, deep_m: float, margin_m: float
) -> None:
    area = Area((east_m, north_m), (east_m + wide_m, north_m + deep_m))
    tile = Tile("west", ID, 3, area, margin_m)
    assert tile_of(pb.Tile.FromString(tile_message(tile).SerializeToString())) == tile


def test_a_tile_without_area_is_everywhere() -> None:
    tile = tile_of(tile_message(Tile("street", ID)))
    assert tile.area is None
    assert tile.reaches(1e9, -1e9)


def test_distance_is_to_the_nearest_point_of_the_area() -> None:
    area = Area((0.0, 0.0), (10.0, 10.0))
    assert area.distance_m(5, 5) == 0
    assert area.distance_m(13, 14) == 5
    assert Tile("west", ID, 1, area, 5.0).reaches(13, 14)
    assert not Tile("west", ID, 1, area, 4.9).reaches(13, 14)


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        (pb.Tile(name="a/b", field_id=ID, version=1), "tile.name"),
        (pb.Tile(name="a", field_id="x", version=1), "tile.field_id"),
        (pb.Tile(name="a", field_id=ID), "tile.version: 0 is below 1"),
        (pb.Tile(name="a", field_id=ID, version=1, margin_m=math.nan), "tile.margin_m"),
        (pb.Tile(name="a", field_id=ID, version=1, area=pb.Area()), "is not south-west of"),
        (pb.Tile(name="a", field_id=ID, version=1, area=pb.Area(east_m=math.inf)), "be finite"),
    ],
)
def test_a_wrong_tile_is_refused_by_name(message: pb.Tile, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem):
        tile_of(message)


def test_a_preview_is_a_light_of_its_own_kind() -> None:
    small, dusk = TileLight(PREVIEW, "cd" * 32, 2), TileLight("dusk", "ef" * 32, 3)
    tile = tile_of(tile_message(Tile("west", ID, lights=(small, dusk))))
    assert tile.preview == small
    assert tile.other_lights == (dusk,)
    assert tile.renderable_ids == (ID, small.field_id, dusk.field_id)
    assert Tile("west", ID, lights=(dusk,)).preview is None
