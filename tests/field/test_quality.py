"""A quality is on the ladder or refused, and draws what its rung is defined to draw."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FULL, Quality, SplatField
from rfcore.field.detail import kept_of, rung
from rfcore.field.quality import DETAILS
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer

CAMERA = Camera(Intrinsics(30, 20, 20.0, 20.0, 15.0, 10.0), Pose((0, 0, -4), (1, 0, 0, 0)))


@pytest.mark.parametrize("detail", [0, -1.0, 0.3, 1.5, float("nan")])
def test_a_share_between_two_rungs_is_refused(detail: float) -> None:
    with pytest.raises(InvalidInput, match=r"quality\.detail: .*none of 1, 0\.5, 0\.25, 0\.1"):
        Quality(detail=detail)


@pytest.mark.parametrize("knob", [{"sh_degree": 4}, {"sh_degree": -1}, {"samples_per_ray": 0}])
def test_a_knob_out_of_range_is_refused_by_name(knob: dict[str, int]) -> None:
    with pytest.raises(InvalidInput, match=f"quality.{next(iter(knob))}"):
        Quality(**knob)


@pytest.mark.parametrize("count", [0, 1, 3, 9, 10, 11, 150_000, 10**7 + 3])
def test_a_rung_holds_its_share_rounded_up(count: int) -> None:
    kept = [kept_of(count, detail) for detail in DETAILS]
    assert kept == [count, -(-count // 2), -(-count // 4), -(-count // 10)]


@pytest.mark.parametrize("detail", DETAILS)
@pytest.mark.parametrize("sh_degree", [None, 3, 2, 1, 0])
def test_a_field_draws_the_first_splats_with_the_first_bands(
    make_gaussians, detail: float, sh_degree: int | None
) -> None:
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


def test_everything_is_drawn_unless_less_is_asked_for(make_gaussians) -> None:
    field = SplatField(make_gaussians(20))
    assert rung(field.gaussians, 1.0, 3) is field.gaussians, "the full rung copies nothing"
    assert field.render_colour(CAMERA).tobytes() == field.render_colour(CAMERA, FULL).tobytes()


def test_the_renderer_of_a_rung_is_made_once_and_only_when_asked_for(make_gaussians) -> None:
    field = SplatField(make_gaussians(20, 1))
    half = field.rasterizer(Quality(0.5))
    assert field.rasterizer(Quality(0.5, sh_degree=1)) is half, "the same rung by another name"
    assert field.rasterizer(Quality(0.5, sh_degree=3)) is half
    assert field.rasterizer() is not half
