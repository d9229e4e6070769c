"""A slimmed field has the splats asked for and shows what it can of the full one."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.field.importance import most_important_first, reordered, visible_area
from rfcore.train.levels import LevelFitConfig
from rfedge.fields.slim import slimmed


def error(field: SplatField, place) -> float:
    """Root mean square over the drive of the difference to the full field's picture."""
    cameras = [picture.camera for picture in place.pictures]
    differences = [field.render_colour(c) - place.field.render_colour(c) for c in cameras]
    return float(np.sqrt(np.mean(np.square(differences))))


@pytest.mark.parametrize("keep", [1, 30, 150, 299])
def test_as_many_splats_are_kept_as_asked_for(place, keep: int) -> None:
    small = slimmed(place.field, keep)
    assert small.primitives == keep
    assert small.metadata.held_out_psnr_db is None, "it was not measured"
    assert small.metadata.name == "cloud"


def test_keeping_all_keeps_the_picture(place) -> None:
    assert error(slimmed(place.field, 300), place) < 1e-3


def test_cameras_make_the_choice_better_and_fitting_better_still(place) -> None:
    cameras = [picture.camera for picture in place.pictures]
    blind = error(slimmed(place.field, 120), place)
    fitted = error(slimmed(place.field, 120, cameras, LevelFitConfig(iterations=90)), place)
    g = place.field.gaussians
    plain = SplatField(reordered(g, most_important_first(visible_area(g))[:120]))
    assert fitted < 0.8 * blind
    assert blind < 1.1 * error(plain, place)


@pytest.mark.parametrize("keep", [0, -1, 301])
def test_more_splats_than_there_are_or_none_are_refused(place, keep: int) -> None:
    with pytest.raises(InvalidInput, match=f"keep: {keep} is outside 1..300"):
        slimmed(place.field, keep)
