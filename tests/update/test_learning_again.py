"""A tile that is learnt about again: lasting change, a light twice, room for new archives."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from mec_server.tile_history import read_histories
from rfcore.field import SplatField


def with_poster(field: SplatField, left_m: float) -> SplatField:
    """The wall with a part 1.5 m wide painted anew, as nobody's light would."""
    splats = field.gaussians
    x = splats.means[:, 0]
    sh = splats.sh.copy()
    sh[(x > left_m) & (x < left_m + 1.5)] = np.float32([0.9, -0.9, 0.6])
    return SplatField(replace(splats, sh=sh))


def bytes_of(street: Any, field_id: str) -> int:
    size: int = (street.fields / f"{field_id}.rff").stat().st_size
    return size


def test_what_changed_for_good_becomes_the_tiles_own_field(street, noon, make_pass):
    changed = with_poster(noon, -0.7)
    street.record(make_pass(changed, "a"))
    street.record(make_pass(changed, "b", 0.15))
    street.rounds().run()
    west = street.west()
    assert (west.current, west.tile("west").lights) == (2, ())
    (learnt,) = read_histories(street.recordings)["west"].learnt
    assert (learnt.light, learnt.replaced_id) == ("", street.noon_id)
    assert learnt.field_id == west.tile("west").field_id != street.noon_id
    assert learnt.saved_percent > 10
    assert west.version(2).label.passes == 2
    assert west.version(2).label.time_of_day_h is None, "what lasts is of no hour"


@pytest.mark.usefixtures("learnt_before")
def test_passes_that_teach_nothing_new_of_a_light_publish_nothing(at_dusk, dusk, make_pass):
    at_dusk.rounds().run()
    west = at_dusk.west()
    (light,) = west.tile("west").lights
    for identity, shift_m in (("c", 0.05), ("d", 0.1)):
        at_dusk.record(make_pass(dusk, identity, shift_m), light.field_id)
    with capture_logs() as lines:
        at_dusk.rounds().run()
    assert [line["reason"] for line in lines if line["event"] == "update not kept"] == [
        "no better than the light's field"
    ]
    assert at_dusk.west() == west


@pytest.mark.usefixtures("learnt_before")
def test_a_light_is_learnt_again_where_the_street_has_changed_and_its_old_archive_makes_room(
    at_dusk, dusk, make_pass, monkeypatch
):
    """Three times: the first archive is deleted for the third, since only two fit."""
    at_dusk.rounds().run()
    monkeypatch.undo()  # learn for real from here on
    (first,) = at_dusk.west().tile("west").lights
    most = 2 * bytes_of(at_dusk, first.field_id) + bytes_of(at_dusk, first.field_id) // 2
    lights = [first]
    for left_m in (-0.7, -0.3):
        changed = with_poster(dusk, left_m)
        for identity, shift_m in (("c", 0.05), ("d", 0.1)):
            at_dusk.record(make_pass(changed, identity, shift_m), lights[-1].field_id)
        at_dusk.rounds(max_bytes=most).run()
        lights += at_dusk.west().tile("west").lights
    assert [light.name for light in lights] == ["h17"] * 3
    assert len({light.field_id for light in lights}) == 3
    history = read_histories(at_dusk.recordings)["west"]
    assert [one.replaced_id for one in history.learnt] == [
        at_dusk.noon_id,
        *(light.field_id for light in lights[:2]),
    ]
    there = [(at_dusk.fields / f"{light.field_id}.rff").exists() for light in lights]
    assert there == [False, True, True]
