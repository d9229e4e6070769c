"""A quality is on the ladder or refused, and draws what its level is defined to draw."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FULL, Quality, SplatField, load_field, save_field
from rfcore.field.quality import DETAILS, LevelOfDetail, kept_of, splats_at_detail
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from tests.field.some import make_gaussians

CAMERA = Camera(Intrinsics(30, 20, 20.0, 20.0, 15.0, 10.0), Pose((0, 0, -4), (1, 0, 0, 0)))


@pytest.mark.parametrize("detail", [0, -1.0, 0.3, 1.5, float("nan")])
def test_a_share_between_two_levels_is_refused(detail):
    with pytest.raises(InvalidInput, match=r"quality\.detail: .*none of 1, 0\.5, 0\.25, 0\.1"):
        Quality(detail=detail)


@pytest.mark.parametrize("knob", [{"sh_degree": 4}, {"sh_degree": -1}, {"samples_per_ray": 0}])
def test_a_knob_out_of_range_is_refused_by_name(knob):
    with pytest.raises(InvalidInput, match=f"quality.{next(iter(knob))}"):
        Quality(**knob)


@pytest.mark.parametrize("count", [0, 1, 3, 9, 10, 11, 150_000, 10**7 + 3])
def test_a_level_holds_its_share_rounded_up(count):
    kept = [kept_of(count, detail) for detail in DETAILS]
    assert kept == [count, -(-count // 2), -(-count // 4), -(-count // 10)]


@pytest.mark.parametrize("detail", DETAILS)
@pytest.mark.parametrize("sh_degree", [None, 3, 2, 1, 0])
def test_a_field_draws_the_first_splats_with_the_first_bands(detail, sh_degree):
    g = make_gaussians(41, 2)
    kept, bands = kept_of(41, detail), (min(2 if sh_degree is None else sh_degree, 2) + 1) ** 2
    parts = (g.means, g.quaternions, g.log_scales, g.opacity_logits)
    shown = Gaussians(*(a[:kept] for a in parts), sh=np.ascontiguousarray(g.sh[:kept, :bands]))
    want = Rasterizer(shown).render(CAMERA)
    quality = Quality(detail, sh_degree)
    got = SplatField(g, threads=2).render(CAMERA, quality)
    assert want.colour.any()
    for name in ("colour", "depth", "opacity"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))
    colour = SplatField(g).render_colour(CAMERA, quality)
    np.testing.assert_array_equal(colour, want.colour)


def test_everything_is_drawn_unless_less_is_asked_for():
    field = SplatField(make_gaussians(20))
    assert splats_at_detail(field.gaussians, {}, 1.0) is field.gaussians, "and nothing is copied"
    assert field.render_colour(CAMERA).tobytes() == field.render_colour(CAMERA, FULL).tobytes()


def test_a_level_with_scales_and_opacities_of_its_own_is_drawn_with_them(tmp_path):
    g, other = make_gaussians(21, 1), make_gaussians(11, 1, seed=1)
    own = LevelOfDetail(other.log_scales, other.opacity_logits)
    save_field(SplatField(g, levels={0.5: own}), tmp_path / "a.rff")
    field = load_field(tmp_path / "a.rff")
    drawn = (g.means[:11], g.quaternions[:11], own.log_scales, own.opacity_logits, g.sh[:11])
    want = Rasterizer(Gaussians(*drawn)).render_colour(CAMERA)
    np.testing.assert_array_equal(field.render_colour(CAMERA, Quality(0.5)), want)
    np.testing.assert_array_equal(field.render_colour(CAMERA), Rasterizer(g).render_colour(CAMERA))
    plain = Rasterizer(splats_at_detail(g, {}, 0.25)).render_colour(CAMERA)
    np.testing.assert_array_equal(field.render_colour(CAMERA, Quality(0.25)), plain)


@pytest.mark.parametrize(
    ("detail", "count", "value", "named"),
    [
        (0.5, 10, 0.0, r"detail 0\.5: .*log_scales: shape \(10, 3\), expected \(11, 3\)"),
        (0.5, 11, np.nan, r"detail 0\.5: .*not finite"),
        (1.0, 21, 0.0, r"1\.0 is none of \(0\.5, 0\.25, 0\.1\)"),
    ],
)
def test_a_level_that_does_not_fit_is_refused_by_name(detail, count, value, named):
    own = LevelOfDetail(np.full((count, 3), value, np.float32), np.full(count, value, np.float32))
    with pytest.raises(InvalidInput, match=named):
        SplatField(make_gaussians(21), levels={detail: own})
