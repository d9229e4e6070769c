"""The camera where a feed says that it is: between fixes, after the last, before the first."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cav_agent.frames import Capture
from cav_agent.pose_feed.feed import NS, PoseFeed
from cav_agent.pose_feed.feed_poses import LONGEST_CARRY_S, FeedPoses
from cav_agent.pose_feed.fix import FieldPlacement
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.errors import RfedgeError
from rfcore.views import PosedPicture

CAMERA = Camera(Intrinsics(4, 4, 2, 2, 2, 2), Pose.identity())


def capture(time_s: float) -> Capture:
    picture = PosedPicture("p", CAMERA, lambda: np.zeros((4, 4, 3), np.uint8), round(time_s * NS))
    return Capture("front", round(10 * time_s), picture, 0.0, 77)


def followed(*fixes: dict[str, object], recorded: bool = True) -> FeedPoses:
    feed = PoseFeed(lambda *_: None, recorded=recorded)
    for fix in fixes:
        feed.receive(json.dumps({"y_m": 0, "z_m": 0, **fix}).encode() + b"\n", 0)
    return FeedPoses(feed, FieldPlacement(None, TileOrigin()), rate_hz=10.0)


def fix(time_s: float, x_m: float, **more: object) -> dict[str, object]:
    return {"time_s": time_s, "x_m": x_m, "quaternion": [1, 0, 0, 0], **more}


def east_m(feed: FeedPoses, time_s: float) -> float:
    return feed.prior(round(time_s * NS)).world_from_cam.translation_m[0]


def test_between_sparse_fixes_the_last_velocity_is_carried_on_and_then_held():
    feed = followed(fix(1, 10.0), fix(2, 18.0))
    assert east_m(feed, 1.5) == 10.0
    assert east_m(feed, 2.5) == pytest.approx(22.0)
    assert east_m(feed, 3.0) == pytest.approx(26.0)
    assert east_m(feed, 60.0) == pytest.approx(18.0 + 8.0 * LONGEST_CARRY_S)


def test_a_jump_is_no_velocity():
    feed = followed(fix(1, 0.0), fix(2, 500.0))
    assert east_m(feed, 3.0) == 500.0


def test_without_a_direction_the_last_one_stays():
    feed = followed(fix(1, 0.0), {"time_s": 2, "x_m": 1})
    at_first = feed.prior(1 * NS).world_from_cam.rotation
    assert feed.prior(2 * NS).world_from_cam.rotation == at_first


@pytest.mark.parametrize("fixes", [(), (fix(5, 0.0),), ({"time_s": 0, "x_m": 1},)])
def test_before_the_first_pose_there_is_none(fixes):
    with pytest.raises(RfedgeError, match="has not said where the camera is"):
        followed(*fixes).camera(capture(1.0))


def test_a_drive_that_begins_again_reads_its_feed_again():
    feed = followed(*(fix(n, 3.0 * n) for n in range(5)))
    first = [east_m(feed, 0.5 * n) for n in range(8)]
    assert [east_m(feed, 0.5 * n) for n in range(8)] == first


def test_deviations_are_those_of_the_feed_without_an_unknown_height():
    prior = followed(fix(0, 0.0, covariance_m2=[4, 9, 2500], rotation_std_deg=2)).prior(0)
    assert (prior.position_m, prior.rotation_deg) == (3.0, 2.0)


def test_a_live_feed_goes_by_the_time_of_capture():
    assert followed(recorded=False).time_ns(capture(3.0)) == 77
    assert followed().time_ns(capture(3.0)) == 3 * NS


def test_the_camera_is_rounded_as_it_is_sent():
    camera = followed(fix(0, 0.1)).camera(capture(0.0))
    assert camera == camera.rounded()


def test_measurements_come_once_and_again_when_the_drive_begins_again():
    feed = followed(*(fix(n, 3.0 * n) for n in range(4)))
    counts = [len(feed.measurements(capture(time_s))) for time_s in (0, 2, 2, 3, 0, 1)]
    assert counts == [1, 2, 0, 1, 1, 1]


def test_a_feed_that_is_late_is_known_from_where_the_field_says_the_camera_was():
    """A vehicle that speeds up; the feed stamps each position 0.2 s too early."""
    feed = followed(*(fix(n, 2.0 * (n + 0.2) ** 2) for n in range(12)))
    assert feed.offset_s() is None
    for tenth in range(1, 111):
        time_s = tenth / 10
        feed.measurements(capture(time_s))
        feed.localised(round(time_s * NS), (2.0 * time_s**2, 0.0, 0.0))
    assert feed.offset_s() == pytest.approx(0.2, abs=0.02)
