"""A slimmed field has the splats asked for and shows what it can of the full one."""

import numpy as np
import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.field.importance import most_important_first, reordered, visible_area
from rfcore.field.store import encode_field
from rfcore.train.levels import LevelFitConfig, with_levels
from rfedge.fields.slim import slimmed
from rfedge.training.finish import SIZES, FieldSizer, SizeGoal


def error(field: SplatField, place) -> float:
    """Root mean square over the drive of the difference to the full field's picture."""
    cameras = [picture.camera for picture in place.pictures]
    differences = [field.render_colour(c) - place.field.render_colour(c) for c in cameras]
    return float(np.sqrt(np.mean(np.square(differences))))


@pytest.mark.parametrize("keep", [1, 30, 150, 299])
def test_as_many_splats_are_kept_as_asked_for(place, keep):
    small = slimmed(place.field, keep)
    assert small.primitives == keep
    assert small.metadata.held_out_psnr_db is None, "it was not measured"
    assert small.metadata.name == "cloud"


def test_keeping_all_keeps_the_picture(place):
    assert error(slimmed(place.field, 300), place) < 1e-3


def test_cameras_make_the_choice_better_and_fitting_better_still(place):
    cameras = [picture.camera for picture in place.pictures]
    blind = error(slimmed(place.field, 120), place)
    fitted = error(slimmed(place.field, 120, cameras, LevelFitConfig(iterations=90)), place)
    g = place.field.gaussians
    plain = SplatField(reordered(g, most_important_first(visible_area(g))[:120]))
    assert fitted < 0.8 * blind
    assert blind < 1.1 * error(plain, place)


@pytest.mark.parametrize("keep", [0, -1, 301])
def test_more_splats_than_there_are_or_none_are_refused(place, keep):
    with pytest.raises(InvalidInput, match=f"keep: {keep} is outside 1..300"):
        slimmed(place.field, keep)


def sizer(place) -> FieldSizer:
    config = LevelFitConfig(iterations=12)
    return FieldSizer(place.pictures, place.pictures, config, Console(quiet=True))


def size_bytes(field: SplatField) -> int:
    return len(encode_field(field))


def test_a_field_is_as_large_as_it_may_be(place):
    most = sizer(place).sized(place.field, SizeGoal())
    assert most.primitives == place.field.primitives
    assert most.metadata.held_out_psnr_db is None, "it was not measured"
    limit = size_bytes(most) * 3 // 4
    small = sizer(place).sized(place.field, SizeGoal(max_bytes=limit))
    assert limit / 2 < size_bytes(small) <= limit
    assert set(small.levels) == {0.5, 0.25, 0.1}
    assert error(most, place) < error(small, place) < 0.1


def test_levels_that_a_field_has_already_are_not_counted_twice(place):
    """They are fitted anew, so that a field is sized as the same splats without levels are."""
    leveled = with_levels(
        place.field, [p.camera for p in place.pictures], LevelFitConfig(iterations=2)
    )
    full = size_bytes(sizer(place).sized(place.field, SizeGoal()))
    bare = SplatField(leveled.gaussians, leveled.metadata)
    for share in range(70, 130, 4):
        goal = SizeGoal(max_bytes=full * share // 100)
        kept = [sizer(place).sized(field, goal).primitives for field in (leveled, bare)]
        assert kept[0] == kept[1]


def test_a_limit_no_size_keeps_is_refused_with_the_least_there_is(place):
    share = f"{SIZES[-1].share:.0%}"
    with pytest.raises(InvalidInput, match=f"max_mb: 900 bytes are too few: .* {share} of the"):
        sizer(place).sized(place.field, SizeGoal(max_bytes=900))
    with pytest.raises(InvalidInput, match=r"size\.passes: 0 is below 1"):
        SizeGoal(passes=0)


def test_the_more_passes_the_larger_the_field(place):
    """One pass of six small frames is worth few splats, a million passes are worth them all."""
    once, often = (
        sizer(place).sized(place.field, SizeGoal(passes=passes)) for passes in (1, 1_000_000)
    )
    assert size_bytes(once) < size_bytes(often)
    assert error(often, place) < error(once, place)
