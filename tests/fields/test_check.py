"""A field put in each wrong convention is found out, named, and put right."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, SplatField
from rfcore.field.similarity import Similarity, moved
from rfcore.image import rgb_from_colour
from rfcore.raster.gaussians import Gaussians
from rfcore.views import PosedPicture
from rfedge.fields.check import (
    AS_GIVEN,
    AS_OPENGL,
    ModeFit,
    check_field,
    drawn_antialiased,
    in_drive_world,
    known_conventions,
    pairs_picture,
)

HALF = np.sqrt(0.5)
TURNED = (0.8, 0.6 * HALF, 0.0, 0.6 * HALF)
NERFSTUDIO = Similarity(Pose((0.3, -0.2, 0.1), TURNED), 0.02)
STILL = (1.0, 0.0, 0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)


def in_frame(field: SplatField, field_from_world: Similarity) -> SplatField:
    return SplatField(moved(field.gaussians, field_from_world), field.metadata)


def with_poses(pictures: list[PosedPicture], change) -> list[PosedPicture]:
    return [
        replace(p, camera=Camera(p.camera.intrinsics, change(p.camera.world_from_cam)))
        for p in pictures
    ]


def test_a_field_that_fits_is_not_searched_for(place):
    fit = check_field(place.field, place.pictures)
    assert (fit.convention, fit.fits, fit.tried) == (AS_GIVEN, True, 1)
    assert fit.psnr_db > 50


@pytest.mark.parametrize(
    ("field_from_world", "named"),
    [
        (Similarity(Pose(ORIGIN, STILL), 100.0), "the field is in centimetres"),
        (Similarity(Pose(ORIGIN, STILL), 1000.0), "the field is in millimetres"),
        (Similarity(Pose(ORIGIN, STILL), 0.01), "the field is in hundreds of metres"),
        (Similarity(Pose(ORIGIN, (0.0, 1.0, 0.0, 0.0))), "the field's axes are x, -y, -z of"),
        (Similarity(Pose(ORIGIN, (HALF, HALF, 0.0, 0.0))), "the field's axes are x, -z, y of"),
        (Similarity(Pose(ORIGIN, (HALF, 0.0, 0.0, -HALF))), "the field's axes are y, -x, z of"),
        (Similarity(Pose(ORIGIN, (0.5, 0.5, 0.5, 0.5))), "the field's axes are z, x, y of"),
        (
            Similarity(Pose(ORIGIN, (HALF, -HALF, 0.0, 0.0)), 100.0),
            "in centimetres, the field's axes are x, z, -y of",
        ),
    ],
)
def test_a_field_in_other_axes_or_units_is_named_and_put_right(place, field_from_world, named):
    wrong = in_frame(place.field, field_from_world)
    fit = check_field(wrong, place.pictures)
    assert fit.fits
    assert named in fit.convention.name
    assert fit.psnr_db > fit.as_given_db + 10
    assert check_field(in_drive_world(wrong, fit.convention), place.pictures).tried == 1


@pytest.mark.parametrize(
    ("field_from_world", "named"),
    [
        (NERFSTUDIO, "the field is in nerfstudio's frame"),
        (NERFSTUDIO.compose(NERFSTUDIO), "applied instead of undone"),
        (NERFSTUDIO.inverse(), "undone twice"),
        (
            Similarity(Pose((15.0, -10.0, 5.0), TURNED)),
            "in nerfstudio's frame, not scaled",
        ),
        (Similarity(Pose(ORIGIN, TURNED)), "turned as nerfstudio turns"),
        (
            NERFSTUDIO.compose(Similarity(Pose(ORIGIN, (HALF, HALF, 0.0, 0.0)))),
            "nerfstudio's frame, the field's axes are x, -z, y of the drive's world",
        ),
    ],
)
def test_nerfstudios_transform_is_tried_every_way(place, field_from_world, named):
    fit = check_field(in_frame(place.field, field_from_world), place.pictures, NERFSTUDIO)
    assert fit.fits
    assert named in fit.convention.name
    assert fit.psnr_db > 30


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda pose: pose.inverse(), "poses inverted"),
        (lambda pose: pose.compose(AS_OPENGL), "OpenGL camera axes"),
        (lambda pose: pose.compose(AS_OPENGL).inverse(), "poses inverted, OpenGL camera axes"),
    ],
)
def test_poses_of_another_convention_are_blamed_on_the_drive(place, change, named):
    fit = check_field(place.field, with_poses(place.pictures, change))
    assert fit.fits
    assert named == fit.convention.name
    assert fit.psnr_db > 40
    with pytest.raises(InvalidInput, match=f"drive's poses are to be changed: {named}"):
        in_drive_world(place.field, fit.convention)


def test_a_field_of_another_place_fits_nowhere(place):
    g = place.field.gaussians
    rng = np.random.default_rng(9)
    order = rng.permutation(len(g))
    other = Gaussians(g.means[order], g.quaternions, g.log_scales, g.opacity_logits, g.sh)
    fit = check_field(SplatField(other), place.pictures)
    assert not fit.fits
    assert fit.tried == len(list(known_conventions(None))) == 4 * 4 * 24


def test_pairs_show_the_camera_beside_the_render(place):
    rgb, values_db = pairs_picture(place.field, place.pictures, AS_GIVEN)
    assert rgb.shape == (4 * 64, 2 * 96, 3)
    assert len(values_db) == 4
    assert min(values_db) > 50
    np.testing.assert_array_equal(rgb[:64, :96], place.pictures[0].read())
    np.testing.assert_array_equal(rgb[-64:, :96], place.pictures[-1].read())


def test_a_drive_without_pictures_is_refused(place):
    with pytest.raises(InvalidInput, match="has no pictures"):
        check_field(place.field, [])


def tiny_splats(place, *, antialiased: bool) -> SplatField:
    """The cloud with splats smaller than a pixel, which both modes draw very differently."""
    splats = replace(place.field.gaussians, log_scales=place.field.gaussians.log_scales - 2.5)
    return SplatField(splats, FieldMetadata(antialiased=antialiased, held_out_psnr_db=30.0))


def pictures_of(field: SplatField, pictures: list[PosedPicture]) -> list[PosedPicture]:
    renders = [rgb_from_colour(field.render_colour(picture.camera)) for picture in pictures]
    return [
        replace(picture, read=lambda rgb=rgb: rgb)
        for picture, rgb in zip(pictures, renders, strict=True)
    ]


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("stated", [True, False])
def test_the_mode_that_the_pictures_were_drawn_in_fits(place, antialiased, stated):
    pictures = pictures_of(tiny_splats(place, antialiased=antialiased), place.pictures)
    fit = check_field(tiny_splats(place, antialiased=stated), pictures)
    assert fit.mode.antialiased == antialiased
    assert (fit.convention, fit.fits, fit.tried) == (AS_GIVEN, True, 1)
    assert (fit.psnr_db == fit.as_given_db) == (antialiased == stated)
    assert fit.psnr_db == (fit.mode.antialiased_db if antialiased else fit.mode.default_db)


@pytest.mark.parametrize(
    ("stated", "antialiased_db", "default_db", "fits"),
    [
        (False, 30.4, 30.0, False),
        (False, 30.6, 30.0, True),
        (True, 30.0, 30.4, True),
        (True, 30.0, 30.6, False),
        (True, 30.0, 20.0, True),
    ],
)
def test_the_stated_mode_is_believed_unless_the_other_is_clearly_better(
    stated, antialiased_db, default_db, fits
):
    mode = ModeFit(stated, antialiased_db, default_db)
    assert mode.antialiased is fits
    assert mode.psnr_db == (antialiased_db if fits else default_db)


def test_a_field_in_another_mode_forgets_what_was_measured_in_its_own(place):
    field = tiny_splats(place, antialiased=False)
    assert drawn_antialiased(field, False) is field
    other = drawn_antialiased(field, True)
    assert other.metadata.antialiased
    assert other.metadata.held_out_psnr_db is None
    np.testing.assert_array_equal(other.gaussians.means, field.gaussians.means)
