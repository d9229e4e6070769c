"""Skies: finite light, the sun where it was declared, clouds that leave it free."""

import math

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from streetgen.geometry.cloud import cumulus, sunwards_depth, with_sun_free
from streetgen.geometry.sky import (
    NOON,
    Daylight,
    clear_radiance,
    directions,
    horizontal_irradiance,
    overcast_sky,
    sun_disc_sr,
    sun_radiance,
    sunny_sky,
    towards,
    with_ground,
)

CLOUDLESS = Daylight(azimuth_deg=35.0, elevation_deg=52.0, turbidity=3.0, cover=0.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_pixels_look_where_the_sky_says():
    view = directions(4)
    assert view.shape == (4, 8, 3)
    up = math.cos(0.5 / 4 * math.pi)
    level = math.sin(0.5 / 4 * math.pi)
    first = (level * math.cos(0.5 / 4 * math.pi), level * math.sin(0.5 / 4 * math.pi), up)
    np.testing.assert_allclose(view[0, 0], first, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(view, axis=2), 1.0, rtol=1e-6)


def test_a_uniform_sky_gives_pi_times_its_radiance():
    """The midpoint rule on 64 rows is off by (pi / 128)^2 / 6 of it."""
    uniform = np.full((64, 128, 3), 2.0, np.float32)
    np.testing.assert_allclose(horizontal_irradiance(uniform), 2 * np.pi, rtol=1e-3)


def test_the_ground_reflects_what_it_receives():
    ground = with_ground(np.full((64, 128, 3), 2.0, np.float32), np.array([np.pi, 0.0, 0.0]))
    assert (ground[:32] == 2.0).all()
    np.testing.assert_allclose(ground[32:, :, 0], 0.15 * 3, rtol=1e-3)
    np.testing.assert_allclose(ground[32:, :, 1], 0.15 * 2, rtol=1e-3)


def test_a_clear_sky_is_brightest_around_the_sun_and_blue_opposite_to_it():
    sun = towards(35.0, 52.0)
    view = directions(90)
    seen = clear_radiance(view, sun, 2.5)[:40]
    brightest = np.unravel_index(int(seen.sum(axis=2).argmax()), seen.shape[:2])
    assert math.degrees(math.acos(min(float(view[brightest] @ np.array(sun)), 1.0))) < 3.0
    red, _, blue = clear_radiance(np.array([towards(215.0, 45.0)], np.float32), sun, 2.5)[0]
    assert blue > 2 * red


def test_the_suns_light_is_that_of_a_clear_day():
    """CIE: about 100 klux on a level surface under a high sun, four fifths of it direct."""
    direct = np.mean(sun_radiance(60.0, 2.5)) * sun_disc_sr(0.53) * math.sin(math.radians(60.0))
    diffuse = horizontal_irradiance(clear_radiance(directions(64), towards(0.0, 60.0), 2.5)).mean()
    assert 70 < direct < 110
    assert 10 < diffuse < 40


def test_a_low_sun_is_redder_and_weaker():
    high, low = np.array(sun_radiance(60.0, 3.0)), np.array(sun_radiance(5.0, 3.0))
    assert (low < 0.5 * high).all()
    assert low[0] / low[2] > 3 * high[0] / high[2]


@pytest.mark.parametrize("day", [CLOUDLESS, Daylight(205.0, 6.0, 2.5, 0.0), Daylight(0, 90, 8, 0)])
def test_a_sky_is_finite_and_its_sun_is_where_it_was_declared(day):
    sky = sunny_sky(day, rng(), height=32)
    assert np.isfinite(sky.radiance).all()
    assert sky.radiance.min() >= 0
    assert sky.sun_towards == towards(day.azimuth_deg, day.elevation_deg)
    assert max(sky.sun_radiance) > 1000 * sky.radiance.max()


def test_a_white_sheet_is_exposed_as_declared():
    sky = sunny_sky(CLOUDLESS, rng(), height=32)
    sun_klux = np.array(sky.sun_radiance) * sun_disc_sr(sky.sun_diameter_deg)
    received = horizontal_irradiance(sky.radiance) + sun_klux * 0.5 * (1 + sky.sun_towards[2])
    assert received.mean() / np.pi * sky.exposure == pytest.approx(CLOUDLESS.white, rel=1e-6)


def test_clouds_cover_their_share_and_leave_the_sun_free():
    sun = towards(NOON.azimuth_deg, NOON.elevation_deg)
    clouds = with_sun_free(cumulus(rng(), 0.4), sun)
    covered = (clouds.density.max(axis=2) > 0).mean()
    assert covered == pytest.approx(0.4, abs=1e-3)
    seen_at = np.round(np.array(sun[:2]) / sun[2] * 1100.0 / (9000.0 / 320)).astype(int) % 320
    assert sunwards_depth(clouds, sun)[seen_at[0], seen_at[1], 0] < 0.01


def test_a_sky_with_clouds_is_not_blank_and_the_same_for_a_seed():
    one, other = (sunny_sky(NOON, rng(), height=48).radiance for _ in range(2))
    assert (one == other).all()
    clear = sunny_sky(CLOUDLESS, rng(), height=48).radiance
    changed = (np.abs(one - clear).max(axis=2) > 0.2 * clear.max(axis=2))[:22]
    assert 0.2 < changed.mean() < 0.9


def test_an_overcast_sky_has_no_sun_and_is_brighter_overhead():
    sky = overcast_sky(0.22, 0.8, rng(), height=64)
    assert max(sky.sun_radiance) == 0
    assert 2.0 < sky.radiance[:6].mean() / sky.radiance[28:31].mean() < 4.0
    assert sky.radiance[:20].std() > 0.1
    white = horizontal_irradiance(sky.radiance).mean() / np.pi * sky.exposure
    assert white == pytest.approx(0.8, rel=1e-6)


def test_edges_of_clouds_are_wider_than_a_pixel_of_the_sky():
    """A step from cloud to sky within one pixel would be a block in a picture that is finer.

    The middle of an edge over three pixels, blurred over three, changes by a third of it at most.
    """
    sky = sunny_sky(NOON, rng(), height=256).radiance[40:120].mean(axis=2)
    across = np.abs(np.diff(sky, axis=1, append=sky[:, :1])), np.abs(np.diff(sky, axis=0))
    for steps in across:
        assert steps.max() < 0.5 * (sky.max() - sky.min())


def test_a_sky_has_no_seam_where_its_columns_meet():
    for sky in (sunny_sky(NOON, rng(), height=128), overcast_sky(0.3, 1.0, rng(), height=128)):
        upper = sky.radiance[:60]
        seam = np.abs(upper[:, 0] - upper[:, -1]).mean()
        beside = np.abs(np.diff(upper, axis=1)).mean(axis=(0, 2))
        assert seam <= beside.max()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"elevation_deg": 0.5}, "elevation_deg: is 0.5, outside 1..90"),
        ({"turbidity": math.nan}, "turbidity: is nan, outside"),
        ({"cover": 1.5}, "cover: is 1.5, outside 0..0.9"),
    ],
)
def test_a_light_that_cannot_be_is_refused(change, said):
    values = {"azimuth_deg": 0.0, "elevation_deg": 30.0, "turbidity": 3.0, "cover": 0.3}
    with pytest.raises(InvalidInput, match=said):
        Daylight(**(values | change))
    with pytest.raises(InvalidInput, match="lower than 1 degree"):
        clear_radiance(directions(4), towards(0.0, -3.0), 3.0)
