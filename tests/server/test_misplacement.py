"""A picture whose pose is wrong is told by where it would fit the field."""

import math

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import read_dataset
from rfcore.field import RadianceField, load_field
from rfcore.perception.composition import MISPLACED_RAD, MISPLACED_TRUST, compose, live_picture
from rfcore.perception.contacts import detect
from rfcore.perception.ground import FieldGround
from rfcore.perception.misplacement import misplacement_rad
from rfcore.perception.objects import LEAST_TRUST, ObjectTracker
from rfcore.views import PosedPicture
from rfedge.samples import sample_path
from server.test_composition import PILLAR, WALL, at, joined

STREET = joined(WALL, PILLAR)
K = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)
NO_CHANGE_RAD = 0.002


def green(camera: Camera) -> np.ndarray:
    return STREET.render(camera).colour[..., 1].clip(0, 1) * np.float32(255)


def misplaced(seen_from: Camera, stated: Camera) -> float:
    depth = STREET.render(stated).depth
    return misplacement_rad(green(seen_from), green(stated), depth, K)


def test_a_picture_at_its_pose_is_where_it_is() -> None:
    assert misplaced(at(0.0), at(0.0)) < NO_CHANGE_RAD
    rng = np.random.default_rng(1)
    noisy = green(at(0.0)) + rng.normal(scale=4, size=(64, 96)).astype(np.float32)
    noisy[20:40, 30:50] = 255  # a thing that the field does not have
    found = misplacement_rad(noisy, green(at(0.0)), STREET.render(at(0.0)).depth, K)
    assert found < 5 * NO_CHANGE_RAD


@pytest.mark.parametrize("yaw_rad", [-0.08, 0.04, 0.08])
def test_a_turn_is_told_by_its_angle(yaw_rad: float) -> None:
    """Along the middle row a turn by yaw moves everything by tan(yaw), further out by more."""
    assert misplaced(at(0.0, yaw_rad), at(0.0)) == pytest.approx(abs(yaw_rad), rel=0.5)


def test_a_move_that_a_turn_hides_is_told_by_what_is_nearer() -> None:
    """0.3 m aside and a turn that keeps the wall, 4 m away, where it was; the pillar is at 2 m."""
    assert misplaced(at(0.3, -math.atan(0.3 / 4)), at(0.0)) > MISPLACED_RAD / 2


def test_a_picture_that_fits_nowhere_and_one_without_a_field_are_not_misplaced() -> None:
    rng = np.random.default_rng(3)
    noise = rng.uniform(0, 255, (64, 96)).astype(np.float32)
    view = STREET.render(at(0.0))
    assert misplacement_rad(noise, green(at(0.0)), view.depth, K) < MISPLACED_RAD
    assert misplacement_rad(noise, green(at(0.0)), np.zeros_like(view.depth), K) == 0.0
    tiny = Intrinsics(4, 3, 3.0, 3.0, 2.0, 1.5)
    four = np.zeros((3, 4), np.float32)
    assert misplacement_rad(four, four, four + 1, tiny) == 0.0


@pytest.fixture(scope="module")
def field() -> RadianceField:
    return load_field(sample_path("fields/street.rff"))


def drive(name: str) -> tuple[PosedPicture, ...]:
    return read_dataset(sample_path(f"street/transforms_drive_{name}.json")).pictures


def off(camera: Camera, right_m: float, yaw_degrees: float) -> Camera:
    """``camera`` moved to its right and turned to its right."""
    turn = math.radians(yaw_degrees) / 2
    moved = Pose((right_m, 0.0, 0.0), (math.cos(turn), 0.0, math.sin(turn), 0.0))
    return Camera(camera.intrinsics, camera.world_from_cam.compose(moved))


WRONG = [(0.5, 1.0), (0.5, -1.0), (-0.5, 1.0), (1.0, 2.0), (1.0, -2.0), (-1.0, 2.0)]


@pytest.mark.sample
@pytest.mark.parametrize("name", ["empty", "vehicles"])
@pytest.mark.parametrize(("right_m", "yaw_degrees"), WRONG)
def test_what_a_wrong_pose_shows_is_doubtful(
    field: RadianceField, name: str, right_m: float, yaw_degrees: float
) -> None:
    """Also where one error hides most of the other. Notices leave out what is doubtful."""
    tracker, ground = ObjectTracker(), FieldGround(field.render)
    for number, picture in enumerate(drive(name)[:12:4]):
        camera = off(picture.camera, right_m, yaw_degrees)
        live = live_picture(camera, picture.read(), field.render(camera))
        assert live.trust <= MISPLACED_TRUST
        tracker.take(detect(live, ground), ("wrong", "front"), 0.1 * number, live.rules_out)
    found = tracker.confirmed(0.2)
    assert all(each.is_doubtful for each in found)


@pytest.mark.sample
@pytest.mark.parametrize("name", ["empty", "vehicles"])
@pytest.mark.parametrize(("right_m", "yaw_degrees"), [(0.0, 0.0), (0.05, 0.1), (-0.05, 0.1)])
def test_a_pose_that_is_right_or_nearly_so_is_trusted(
    field: RadianceField, name: str, right_m: float, yaw_degrees: float
) -> None:
    for picture in drive(name)[::6]:
        camera = off(picture.camera, right_m, yaw_degrees)
        live = live_picture(camera, picture.read(), field.render(camera))
        assert live.trust > LEAST_TRUST


@pytest.mark.sample
@pytest.mark.parametrize(("right_m", "yaw_degrees"), WRONG)
def test_an_honest_vehicle_outvotes_one_with_a_wrong_pose(
    field: RadianceField, right_m: float, yaw_degrees: float
) -> None:
    """On the empty street, 10 m behind and with an older picture, it leaves the field as it is."""
    pictures = drive("empty")
    wrong, honest = pictures[12], pictures[8]
    view = field.render(wrong.camera)
    false = off(wrong.camera, right_m, yaw_degrees)
    live = [
        (live_picture(false, wrong.read(), field.render(false)), 0.1),
        (live_picture(honest.camera, honest.read(), field.render(honest.camera)), 0.5),
    ]
    alone = compose(wrong.camera, view, live[:1], 2.0, ["wrong"])
    both = compose(wrong.camera, view, live, 2.0, ["wrong", "honest"])
    own = np.rint(view.colour.clip(0, 1) * 255)
    both_see = np.isfinite(alone.age_s) & np.isfinite(compose(
        wrong.camera, view, live[1:], 2.0, ["honest"]).age_s)  # fmt: skip
    changed = both_see & (np.abs(alone.rgb - own).max(axis=2) > 16)
    assert changed.sum() > 1000
    left = np.abs(both.rgb - own).max(axis=2)[changed] > 16
    assert left.mean() < 0.1
