"""The operator's table: which lights a tile has, and what its server learnt of them."""

from dataclasses import replace

import pytest

from rfcore.errors import InvalidInput
from rfcore.wire.tiles import LearntLight, Tile, TileLight, learnt_message, learnt_of
from rfedge.twin.scene import Board, TwinScene
from rfedge.twin.server_source import tile_rows

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
