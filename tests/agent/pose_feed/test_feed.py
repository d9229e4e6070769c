"""A feed as it goes on: what is used, at which time, what is told, and where the camera then is."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.pose_feed.feed import NS, QUIET_S, PoseFeed
from cav_agent.pose_feed.feed_poses import FeedPoses, TimeOffsetEstimator
from cav_agent.pose_feed.fix import CameraMount, FeedProblem, FieldPlacement, Fix
from cav_agent.pose_feed.json_lines import UNKNOWN_HEIGHT_STD_M
from cav_agent.pose_feed.sources import FeedKind, FeedSource, PoseFeedSettings, parse_source
from lab.localisation.pose_errors import ERROR_MODELS, PoseErrorModel
from lab.localisation.pose_feed import FeedPlan, feed_lines
from rfcore.camera import Pose, TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field import Bounds
from rfcore.geodesy import Anchor
from rfcore.motion import quaternion_from_vector, rotation_vector

NOW_NS = 1_700_000_000 * NS
ANCHOR = Anchor(48.137, 11.575, 519.0)
BOX = Bounds((-200.0, -200.0, -20.0), (200.0, 200.0, 50.0))


class Told:
    """Problems that a feed reported: every one, and those that begin."""

    def __init__(self) -> None:
        self.all: list[FeedProblem] = []
        self.begun: list[FeedProblem] = []
        self.texts: list[str] = []

    def __call__(self, problem: FeedProblem, text: str, begins: bool) -> None:
        self.all.append(problem)
        self.texts.append(text)
        if begins:
            self.begun.append(problem)


@pytest.fixture
def told() -> Told:
    return Told()


def line(time_s: float, x_m: float = 0.0, y_m: float = 0.0) -> bytes:
    values = {"time_s": time_s, "x_m": x_m, "y_m": y_m, "z_m": 0.0, "quaternion": [1, 0, 0, 0]}
    return json.dumps(values).encode() + b"\n"


def give(feed: PoseFeed, seconds: float, *, late_s: float = 0.1, x_m: float = 0.0) -> int:
    """Give a fix of so many seconds after ``NOW_NS`` that arrives ``late_s`` later."""
    return feed.receive(line(NOW_NS / NS + seconds, x_m), NOW_NS + round((seconds + late_s) * NS))


def test_each_fix_is_measured_once_and_not_before_its_time(told):
    feed = PoseFeed(told)
    reader = FeedPoses(feed, FieldPlacement(None, TileOrigin()))
    for n in range(4):
        give(feed, n, x_m=5.0 * n)
    first = reader.measurements_until(NOW_NS + NS)
    assert [m.position_m[0] for m in first] == [0.0, 5.0]
    assert reader.measurements_until(NOW_NS + NS) == []
    assert [m.time_ns for m in reader.measurements_until(NOW_NS + 9 * NS)] == [
        NOW_NS + 2 * NS,
        NOW_NS + 3 * NS,
    ]
    other = FeedPoses(feed, FieldPlacement(None, TileOrigin()))
    assert len(other.measurements_until(NOW_NS + 9 * NS)) == 4
    assert told.all == []


def test_times_that_go_back_are_refused_and_a_feed_that_begins_again_is_taken(told):
    feed = PoseFeed(told)
    assert give(feed, 10.0) == 1
    assert give(feed, 9.5) == 0
    assert give(feed, 10.5) == 1
    assert told.begun == [FeedProblem.BACKWARDS]
    assert [give(feed, 3.0 + n, late_s=8.0 + n) for n in range(4)] == [0, 0, 1, 1]
    assert told.begun == [FeedProblem.BACKWARDS, FeedProblem.CLOCK]
    assert told.all.count(FeedProblem.BACKWARDS) == 4


def test_the_same_fix_twice_is_no_problem(told):
    feed = PoseFeed(told)
    assert give(feed, 1.0) + give(feed, 1.0) == 1
    assert told.all == []


def test_a_jump_is_told_and_handed_on(told):
    feed = PoseFeed(told)
    assert give(feed, 0.0) + give(feed, 1.0, x_m=10.0) + give(feed, 2.0, x_m=500.0) == 3
    assert told.begun == [FeedProblem.JUMP]
    assert give(feed, 3.0, x_m=510.0) == 1
    assert told.all == [FeedProblem.JUMP]


@pytest.mark.parametrize(
    ("ahead_s", "words"), [(3600.0, "UTC+1 h"), (-5.5 * 3600, "UTC-5.5 h"), (17.0, "16.8 s ahead")]
)
def test_another_clock_is_told_with_its_zone_and_taken_away(told, ahead_s, words):
    feed = PoseFeed(told)
    reader = FeedPoses(feed, FieldPlacement(None, TileOrigin()))
    for n in range(5):
        give(feed, n + ahead_s, late_s=0.2 - ahead_s)
    assert told.all == [FeedProblem.CLOCK]
    assert words in told.texts[0]
    times_s = [(m.time_ns - NOW_NS) / NS for m in reader.measurements_until(NOW_NS + 9 * NS)]
    assert times_s == pytest.approx([n + 0.2 for n in range(5)])


def test_latency_below_two_seconds_is_not_taken_for_another_clock(told):
    feed = PoseFeed(told)
    reader = FeedPoses(feed, FieldPlacement(None, TileOrigin()))
    give(feed, 0.0, late_s=1.9)
    assert [m.time_ns for m in reader.measurements_until(NOW_NS + 9 * NS)] == [NOW_NS]
    assert told.all == []


def test_silence_is_told_once_and_again_after_the_feed_came_back(told):
    feed = PoseFeed(told)
    give(feed, 0.0)
    for n in range(20):
        feed.idle(NOW_NS + n * NS)
    assert told.all == [FeedProblem.SILENT]
    give(feed, 40.0)
    feed.idle(NOW_NS + 41 * NS)
    feed.idle(NOW_NS + round((44 + QUIET_S) * NS))
    assert told.begun == [FeedProblem.SILENT, FeedProblem.SILENT]


def test_a_feed_that_never_speaks_is_silent(told):
    feed = PoseFeed(told)
    feed.idle(NOW_NS)
    feed.idle(NOW_NS + 10 * NS)
    assert told.all == [FeedProblem.SILENT]


def test_a_position_beyond_the_fields_bounds_is_told_and_left_out(told):
    feed = PoseFeed(told)
    reader = FeedPoses(feed, FieldPlacement(None, TileOrigin()), BOX)
    for n, x_m in enumerate((0.0, 190.0, 300.0, 0.0)):
        give(feed, 10.0 * n, x_m=x_m)
    found = reader.measurements_until(NOW_NS + 99 * NS)
    assert [m.position_m[0] for m in found] == [0.0, 190.0, 0.0]
    assert told.begun == [FeedProblem.OUTSIDE]


def test_bad_lines_are_counted_and_the_next_one_is_used(told):
    feed = PoseFeed(told)
    feed.receive(b"$GPGGA,1*00\n" * 3 + b'{"time_s": NaN}\nnoise\n', NOW_NS)
    assert give(feed, 0.0) == 1
    assert told.begun == [FeedProblem.CHECKSUM, FeedProblem.MALFORMED]
    assert len(told.all) == 5


def test_a_position_on_the_earth_needs_the_fields_anchor(told):
    feed = PoseFeed(told)
    feed.receive(b'{"time_s": 1700000000, "latitude_deg": 48, "longitude_deg": 11}\n', NOW_NS)
    assert FeedPoses(feed, FieldPlacement(None, TileOrigin())).measurements_until(NOW_NS) == []
    assert told.begun == [FeedProblem.NO_ANCHOR]
    assert "rfedge field anchor" in told.texts[0]


# --- placing


def fix(**changes) -> Fix:
    values = {"geodetic": (48.137, 11.575, 519.0), "xyz_m": None, "position_std_m": (1.0, 2.0, 3.0)}
    return Fix(NOW_NS, **{**values, **changes})


@pytest.mark.parametrize(
    ("heading_deg", "ahead"),
    [(0.0, (0, 1, 0)), (90.0, (1, 0, 0)), (225.0, (-(0.5**0.5), -(0.5**0.5), 0))],
)
def test_a_camera_looks_along_the_heading_upright_and_stands_ahead_of_the_antenna(
    heading_deg, ahead
):
    place = FieldPlacement(ANCHOR, TileOrigin(), CameraMount((2.0, 0.0, 0.5)))
    measured = place.measurement(fix(heading_deg=heading_deg), NOW_NS)
    turn = Pose((0.0, 0.0, 0.0), measured.rotation)
    assert turn.apply((0, 0, 1)) == pytest.approx(ahead, abs=1e-9)
    assert turn.apply((0, 1, 0)) == pytest.approx((0, 0, -1), abs=1e-9)
    expected = [2.0 * a for a in ahead[:2]] + [0.5]
    assert measured.position_m == pytest.approx(expected, abs=1e-6)


def test_a_mount_turns_the_camera_to_the_left_then_down():
    turn = CameraMount(turned_deg=(90.0, 30.0, 0.0)).vehicle_from_cam
    s, c = math.sin(math.radians(30)), math.cos(math.radians(30))
    assert turn.apply((0, 0, 1)) == pytest.approx((0, c, -s))
    level = CameraMount(turned_deg=(0.0, 0.0, 90.0)).vehicle_from_cam
    assert level.apply((0, -1, 0)) == pytest.approx((0, -1, 0))  # up is now to the right


def test_without_a_direction_the_lever_arm_is_doubt():
    place = FieldPlacement(ANCHOR, TileOrigin(), CameraMount((3.0, 0.0, 0.0)))
    measured = place.measurement(fix(), NOW_NS)
    assert measured.rotation is None
    assert measured.position_m == pytest.approx((0, 0, 0), abs=1e-6)
    assert measured.position_std_m == pytest.approx((10**0.5, 13**0.5, 18**0.5))


def test_deviations_follow_the_axes_of_the_field():
    looking_north = quaternion_from_vector((-math.pi / 2, 0.0, 0.0))
    place = FieldPlacement(Anchor(48.137, 11.575, 519.0, looking_north), TileOrigin())
    assert place.measurement(fix(), NOW_NS).position_std_m == pytest.approx((1.0, 3.0, 2.0))


# --- the generator against the reader

POSES = [
    Pose((3.0 * n, 0.1 * n * n, 1.5), quaternion_from_vector((-math.pi / 2 + 0.01, 0.1, 0.02 * n)))
    for n in range(12)
]
TIMES_S = [0.5 * n for n in range(12)]
turned = st.tuples(*[st.floats(-3, 3)] * 3).map(quaternion_from_vector)


@pytest.mark.parametrize("form", ["geodetic", "xyz"])
@given(turn=turned, arm_m=st.tuples(*[st.floats(-3, 3)] * 3))
def test_what_the_generator_writes_comes_back_as_the_cameras_poses(form, turn, arm_m):
    anchor, origin = Anchor(48.137, 11.575, 519.0, turn), TileOrigin(1000.0, 2000.0, 0.0)
    mount = CameraMount(arm_m, (20.0, 5.0, -3.0))
    plan = FeedPlan(form, ERROR_MODELS["exact"], NOW_NS / NS, 1, anchor, origin, mount)
    told = Told()
    feed = PoseFeed(told, recorded=True)
    for _, text in feed_lines(POSES, TIMES_S, plan):
        feed.receive(text.encode(), NOW_NS)
    found = FeedPoses(feed, FieldPlacement(anchor, origin, mount)).measurements_until(
        NOW_NS + 99 * NS
    )
    assert told.all == []
    assert len(found) == len(POSES)
    for measured, pose in zip(found, POSES, strict=True):
        between = pose.inverse().compose(measured.world_from_cam)
        # four decimals of metres, nine of degrees (0.1 mm), nine of a quaternion
        assert math.hypot(*between.translation_m) < 5e-4
        assert math.hypot(*rotation_vector(between.rotation)) < 1e-7


def test_nmea_of_the_generator_comes_back_with_position_and_heading(told):
    plan = FeedPlan("nmea", ERROR_MODELS["exact"], NOW_NS / NS, anchor=ANCHOR)
    feed = PoseFeed(told, recorded=True)
    for _, text in feed_lines(POSES, TIMES_S, plan):
        feed.receive(text.encode(), NOW_NS)
    found = FeedPoses(feed, FieldPlacement(ANCHOR, TileOrigin())).measurements_until(
        NOW_NS + 99 * NS
    )
    assert told.all == []
    assert len(found) == len(POSES)
    for measured, pose in zip(found, POSES, strict=True):
        assert math.dist(measured.position_m, pose.translation_m) < 2e-3
        ahead = Pose((0, 0, 0), measured.rotation).apply((0, 0, 1))
        truth = Pose((0, 0, 0), pose.rotation).apply((0, 0, 1))
        turn = math.atan2(ahead[0], ahead[1]) - math.atan2(truth[0], truth[1])
        assert abs(math.degrees(turn)) < 1e-3


def test_the_same_seed_writes_the_same_feed():
    plan = FeedPlan("nmea", PoseErrorModel(noise_m=1.0, walk_m=2.0), 0.0, 7, ANCHOR)
    assert feed_lines(POSES, TIMES_S, plan) == feed_lines(POSES, TIMES_S, plan)


# --- the time offset


def drive(
    offset_s: float, noise_m: float, *, bends: bool, climbs_m: float = 0.0
) -> TimeOffsetEstimator:
    """A feed that is ``offset_s`` wrong and 2 m beside, over 20 s of a drive.

    ``climbs_m``: the road's height rises so far ever faster, and the feed knows no height.
    """
    rng = np.random.default_rng(4)

    def at(time_s: float) -> tuple[float, float, float]:
        speed = 8.0 * time_s + (12.0 * math.sin(0.5 * time_s) if bends else 0.0)
        height = climbs_m * (time_s / 20.0) ** 2
        return (speed, 6.0 * math.cos(0.4 * time_s) if bends else 0.0, height)

    estimator = TimeOffsetEstimator()
    for n in range(200):
        time_s = 0.1 * n
        if n % 5 == 0:
            x, y, z = np.array(at(time_s + offset_s)) + rng.normal(0, noise_m, 3) + [2.0, -1.0, 0.0]
            std_m = (noise_m, noise_m, UNKNOWN_HEIGHT_STD_M if climbs_m else noise_m)
            estimator.measured(time_s, (x, y, 0.0 if climbs_m else z), std_m)
        estimator.localised(time_s, at(time_s))
    return estimator


@pytest.mark.parametrize("offset_s", [-0.3, 0.0, 0.2])
def test_a_drive_that_bends_tells_how_late_the_feed_is(offset_s):
    found = drive(offset_s, 0.1, bends=True).offset()
    assert found is not None
    assert found.seconds == pytest.approx(offset_s, abs=5 * found.std_s + 0.01)
    assert found.std_s < 0.02


def test_a_height_that_the_feed_does_not_know_says_nothing_of_its_time():
    found = drive(0.2, 0.1, bends=True, climbs_m=60.0).offset()
    assert found is not None
    assert found.seconds == pytest.approx(0.2, abs=5 * found.std_s + 0.01)


def test_a_straight_drive_at_one_speed_does_not_tell_and_says_so():
    assert drive(0.2, 0.1, bends=False).offset() is None


# --- options


@pytest.mark.parametrize(
    ("text", "source"),
    [
        ("udp:127.0.0.1:5000", FeedSource(FeedKind.UDP, host="127.0.0.1", port=5000)),
        ("udp:[::1]:0", FeedSource(FeedKind.UDP, host="::1")),
        ("gpsd:localhost", FeedSource(FeedKind.GPSD, host="localhost", port=2947)),
    ],
)
def test_sources_are_parsed(text, source):
    assert parse_source(text) == source
    assert parse_source("serial:/dev/ttyUSB0:4800").baud == 4800
    assert str(parse_source("file:a:b.nmea").path) == "a:b.nmea"


@pytest.mark.parametrize(
    "text",
    ["", "a.nmea", "file:", "udp:5000", "udp:x:70000", "serial:/dev/x:1200", "gpsd:h:", "tcp:a:1"],
)
def test_other_sources_are_refused(text):
    with pytest.raises(InvalidInput):
        PoseFeedSettings(pose_feed=text)


def test_a_mount_that_is_no_mount_is_refused():
    for camera_at in ((math.nan, 0.0, 0.0), (100.0, 0.0, 0.0)):
        with pytest.raises(InvalidInput):
            PoseFeedSettings(camera_at=camera_at)
