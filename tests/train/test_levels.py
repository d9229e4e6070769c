"""A fitted level shows the full field better than a prefix; the full level stays as it was."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, Quality, SplatField
from rfcore.field.quality import DETAILS
from rfcore.raster.gaussians import Gaussians
from rfcore.train.levels import LevelFitConfig, with_levels

INTRINSICS = Intrinsics(60, 40, 40.0, 40.0, 30.0, 20.0)
CAMERAS = [Camera(INTRINSICS, Pose((x / 4, 0, 0), (1, 0, 0, 0))) for x in range(-3, 4)]


@pytest.fixture(scope="module")
def field() -> SplatField:
    rng = np.random.default_rng(0)
    n = 500
    arrays = {
        "means": rng.uniform((-3, -2, 4), (3, 2, 5), (n, 3)),
        "quaternions": np.tile([1.0, 0, 0, 0], (n, 1)),
        "log_scales": np.full((n, 3), np.log(0.2)),
        "opacity_logits": np.full(n, 1.0),
        "sh": np.tile(rng.uniform(-1, 1, (1, 1, 3)), (n, 1, 1)),
    }
    gaussians = Gaussians(**{name: a.astype(np.float32) for name, a in arrays.items()})
    return SplatField(gaussians, FieldMetadata("patch", antialiased=True))


def error(field: SplatField, full: SplatField, detail: float) -> float:
    """Root mean square over the cameras of the difference to the full field's picture."""
    differences = [field.render_colour(c, Quality(detail)) - full.render_colour(c) for c in CAMERAS]
    return float(np.sqrt(np.mean(np.square(differences))))


def test_fitted_levels_show_the_full_field_better_than_prefixes(field):
    steps: list[tuple[int, int]] = []
    plain = with_levels(field, CAMERAS, LevelFitConfig(iterations=0))
    fitted = with_levels(
        field,
        CAMERAS,
        LevelFitConfig(iterations=60),
        lambda done, total: steps.append((done, total)),
    )
    assert error(fitted, field, 1.0) < 1e-3, "order aside, the full level is the field"
    for detail in DETAILS[1:]:
        assert error(fitted, field, detail) < 0.7 * error(plain, field, detail)
    assert steps == [(i + 1, 180) for i in range(180)]
    assert fitted.metadata == field.metadata


def test_the_same_field_and_cameras_give_the_same_levels(field):
    ids = {
        with_levels(field, CAMERAS, LevelFitConfig(iterations=3, threads=threads)).field_id
        for threads in (1, 3)
    }
    assert len(ids) == 1


def test_levels_share_the_time_that_is_left_and_end_with_it(field):
    """Twelve seconds for three levels, and each look at the clock takes half a second."""
    left, steps = iter(np.arange(12.0, -12.0, -0.5)), []
    config = LevelFitConfig(iterations=60)
    timed = with_levels(
        field, CAMERAS, config, lambda done, _: steps.append(done), left_s=lambda: next(left)
    )
    of_level = [sum(low < step <= low + 60 for step in steps) for low in (0, 60, 120)]
    assert all(5 <= count <= 8 for count in of_level)
    plain = with_levels(field, CAMERAS, LevelFitConfig(iterations=0))
    for detail in DETAILS[1:]:
        assert error(timed, field, detail) < error(plain, field, detail)


def test_an_empty_field_has_empty_levels():
    nothing = Gaussians(*(np.zeros((0, *s), "f4") for s in ((3,), (4,), (3,), (), (1, 3))))
    empty = with_levels(SplatField(nothing), CAMERAS)
    assert not empty.render_colour(CAMERAS[0], Quality(0.1)).any()


@pytest.mark.parametrize("wrong", [{"iterations": -1}, {"widening": 0.0}, {"opacity_rate": 2.0}])
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(InvalidInput, match=f"levels.{next(iter(wrong))}"):
        LevelFitConfig(**wrong)
