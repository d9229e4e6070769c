"""A camera finds itself in the sample's street, and says it is lost wherever it cannot."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose, Vec3
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import FULL, Quality, RadianceField, load_field, render_field_view
from rfcore.localise.agreement import agreement, near_on_the_spot
from rfcore.localise.alignment import Expected
from rfcore.localise.estimate import PosePrior, moved
from rfcore.localise.localiser import (
    Localised,
    Localiser,
    LocaliserSettings,
    Lost,
    Obstacle,
    median_depth,
)
from rfcore.localise.matching import Pyramid, grey, halved, structure
from rfcore.localise.track import Track, begin_track
from rfcore.localise.tracker import CARRY_ALIGNMENTS, full_range
from rfcore.motion import rotation_vector
from rfcore.views import FieldView, PosedPicture, View

pytestmark = pytest.mark.sample
SAMPLES = Path(__file__).parents[2] / "samples"
FEW = LocaliserSettings(most_hypotheses=3)
"""Settings of a search that is to end lost."""
START = ((1.4, 0.2, 1.4), (0.0, math.radians(3.0), 0.0))
"""2 m and 3 degrees off."""
U8 = NDArray[np.uint8]


@cache
def field() -> RadianceField:
    return load_field(SAMPLES / "fields/street.rff", threads=2)


@cache
def picture(number: int, drive: str = "empty") -> PosedPicture:
    return read_dataset(SAMPLES / f"street/transforms_drive_{drive}.json").pictures[number]


def search(
    number: int, rgb: U8 | None = None, *, around: Pose | None = None, drive: str = "empty"
) -> Localised | Lost:
    """Localise a picture of a drive, or another one in its place, from 2 m and 3 degrees off."""
    taken = picture(number, drive)
    pose = moved(taken.camera.world_from_cam if around is None else around, *START)
    lost = rgb is not None or around is not None
    localiser = Localiser(field(), taken.camera.intrinsics, FEW if lost else None)
    return localiser.localise(taken.read() if rgb is None else rgb, PosePrior(pose, 2.0, 3.0))


@pytest.mark.parametrize(
    ("number", "drive"), [(0, "empty"), (9, "empty"), (20, "empty"), (12, "vehicles")]
)
def test_a_start_2_m_and_3_degrees_off_finds_the_pose(number, drive):
    """Within 0.3 % of the median depth, which is 10.7 m, and 0.1 degrees."""
    answer = search(number, drive=drive)
    assert isinstance(answer, Localised)
    truth = picture(number, drive).camera
    error = truth.world_from_cam.inverse().compose(answer.world_from_cam)
    depth_m = median_depth(field().render(truth, FULL))
    assert math.hypot(*error.translation_m) < 0.003 * depth_m
    assert math.degrees(math.hypot(*rotation_vector(error.rotation))) < 0.1
    assert answer.solution.inliers > 50


def test_the_same_search_gives_the_same_bits():
    assert search(5) == search(5)


def test_a_black_picture_is_lost_before_anything_is_rendered():
    answer = search(3, np.zeros((360, 640, 3), np.uint8))
    assert answer == Lost(Obstacle.FEW_FEATURES, 0)


def test_noise_is_lost():
    noise = np.random.default_rng(2).integers(0, 256, (360, 640, 3), np.uint8)
    assert search(3, noise) == Lost(Obstacle.FEW_INLIERS, 3)


def test_a_street_that_is_nowhere_is_lost():
    """Mirrored: everything a street has, in no place of this one."""
    assert isinstance(search(3, np.ascontiguousarray(picture(3).read()[:, ::-1])), Lost)


def test_a_search_that_looks_the_other_way_is_lost():
    turned = moved(picture(3).camera.world_from_cam, (0.0, 0.0, 0.0), (0.0, math.pi, 0.0))
    assert isinstance(search(3, around=turned), Lost)


def test_a_pose_too_far_from_a_sure_prior_is_not_claimed():
    """Features find the pose 2 m away; a prior of 0.1 m refutes it."""
    taken = picture(9)
    prior = PosePrior(moved(taken.camera.world_from_cam, *START), 0.1, 3.0)
    answer = Localiser(field(), taken.camera.intrinsics, FEW).localise(taken.read(), prior)
    assert answer == Lost(Obstacle.IMPLAUSIBLE, 3)


@pytest.mark.parametrize("least", [{"least_agreement": 1e6}, {"least_on_the_spot": 1.1}])
def test_a_pose_that_looks_unlike_or_that_only_far_things_agree_with_is_not_claimed(least):
    taken = picture(9)
    prior = PosePrior(taken.camera.world_from_cam, 2.0, 3.0)
    strict = LocaliserSettings(most_hypotheses=2, **least)
    answer = Localiser(field(), taken.camera.intrinsics, strict).localise(taken.read(), prior)
    assert answer == Lost(Obstacle.UNLIKE, 2)


def on_the_spot(taken: PosedPicture, by_m: Vec3) -> float:
    pose = moved(taken.camera.world_from_cam, by_m)
    view = render_field_view(field(), Camera(taken.camera.intrinsics, pose))
    picture, drawn = (structure(halved(luma)) for luma in (grey(taken.read()), view.render.y))
    return near_on_the_spot(picture, drawn, view)


def test_near_things_tell_a_pose_from_one_decimetres_away_that_far_things_cannot():
    """The poses lie ahead and behind, where the middle of the picture hardly moves."""
    limit = LocaliserSettings().least_on_the_spot
    for taken in (picture(9), picture(12, "vehicles")):
        assert on_the_spot(taken, (0.0, 0.0, 0.0)) > 1.4 * limit
        for by_m in ((0.0, 0.0, 0.5), (0.0, 0.0, -0.5), (0.4, 0.0, 0.0)):
            assert on_the_spot(taken, by_m) < 0.7 * limit


CARRIED_OFF_M: tuple[Vec3, ...] = (
    *((0.0, 0.0, z) for z in (-1.0, -0.5, 0.5, 1.0, 1.5, 2.5)),
    *((x, 0.0, 0.0) for x in (-0.5, 0.5, 1.0)),
    *((x, 0.0, x) for x in (-0.7, 0.7)),
)
"""Errors of a pose that was carried over half a second by an uncertain motion."""


def carried(taken: PosedPicture, off_m: Vec3) -> Track | None:
    """Begin a track where a picture was not taken, as with a pose found in an earlier picture."""

    def render_at(pose: Pose) -> FieldView:
        return render_field_view(field(), Camera(taken.camera.intrinsics, pose).rounded())

    near = moved(taken.camera.world_from_cam, off_m, (0.0, math.radians(0.7), 0.0))
    expected, levels = Expected(0.4, math.radians(1.5)), Pyramid(full_range(grey(taken.read())))
    return begin_track(0, near, expected, levels, render_at, CARRY_ALIGNMENTS)


@pytest.mark.parametrize(("number", "drive"), [(9, "empty"), (21, "vehicles")])
def test_a_track_that_begins_metres_off_is_right_or_does_not_begin(number, drive):
    """Alignment and agreement alone would leave half of these tracks up to 2 m wrong."""
    taken = picture(number, drive)
    tracks = [carried(taken, off_m) for off_m in CARRIED_OFF_M]
    truth = taken.camera.world_from_cam
    off_m = [
        math.dist(truth.translation_m, track.view.camera.world_from_cam.translation_m)
        for track in tracks
        if track is not None
    ]
    assert max(off_m) < 0.1
    assert len(off_m) >= 3


class Emptiness:
    """A field with nothing in it."""

    def render(self, camera: Camera, _: Quality) -> View:
        size = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        nothing = np.zeros(size, np.float32)
        return View(np.zeros((*size, 3), np.float32), nothing, nothing)


def test_nothing_is_found_in_an_empty_field():
    taken = picture(3)
    prior = PosePrior(taken.camera.world_from_cam, 1.0, 1.0)
    answer = Localiser(Emptiness(), taken.camera.intrinsics, FEW).localise(taken.read(), prior)
    assert answer == Lost(Obstacle.FEW_INLIERS, 3)


def test_agreement_tells_the_place_from_one_beside_it_and_ignores_exposure():
    taken = picture(9)
    pose, rgb = taken.camera.world_from_cam, taken.read()
    intrinsics = taken.camera.intrinsics
    here = field().render(taken.camera, FULL)
    beside = field().render(Camera(intrinsics, moved(pose, (0.5, 0.0, 0.0))), FULL)
    darker = (0.4 * rgb).astype(np.uint8)
    limit = LocaliserSettings().least_agreement
    assert agreement(grey(rgb), here) > 5 * limit
    assert agreement(grey(darker), here) > 5 * limit
    assert agreement(grey(rgb), beside) < limit


def test_noise_agrees_with_nothing():
    """Gaussian chance of a thousand draws stays below five standard deviations."""
    view = field().render(picture(9).camera, FULL)
    rng = np.random.default_rng(4)
    noises = [rng.integers(0, 256, (360, 640), np.uint8) for _ in range(5)]
    assert max(agreement(noise, view) for noise in noises) < 5.0


def test_a_picture_of_another_size_is_refused():
    localiser = Localiser(field(), Intrinsics(64, 36, 32, 32, 32, 18))
    prior = PosePrior(Pose.identity(), 1.0, 1.0)
    with pytest.raises(InvalidInput, match=r"uint8 \(360, 640, 3\) must be uint8 \(36, 64, 3\)"):
        localiser.localise(picture(3).read(), prior)


def test_a_setting_of_zero_is_refused():
    with pytest.raises(InvalidInput, match=r"localiser.inlier_px: 0 must be above 0"):
        LocaliserSettings(inlier_px=0)
