"""A codec's points are extended until they span a window; its time is the least of a few runs."""

import math

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import Clip, CodedClip
from rfedge.evaluate.performance import (
    TIMED_FRAMES,
    TIMED_REPEATS,
    CpuTime,
    Performance,
    WindowNotReached,
    perform,
    seconds_left,
    spanning_points,
    time_in_turns,
)
from rfedge.evaluate.runner import clip_key, coded_clip
from rfedge.jobs import CellStore

PLANE = np.zeros((2, 2), np.uint8)
FRAME = I420(PLANE, PLANE[:1, :1], PLANE[:1, :1])
CLIP = Clip("street", 10.0, [FRAME] * 4, "digest", None)
SPREAD_DB = 1.0


def mse(db):
    return 255.0**2 / 10 ** (db / 10)


class Ideal:
    """Codes CRF c to 60 - c dB; the frames after the first lie ``SPREAD_DB`` around that."""

    name = "ideal"
    version = "test"

    def __init__(self, points, floor_db=-math.inf):
        self.points = points
        self.floor_db = floor_db
        self.coded = []

    def code(self, frames, _rate_hz, point):
        self.coded.append(point)
        spread = np.linspace(-SPREAD_DB, SPREAD_DB, max(1, len(frames) - 1))
        qualities = [60.0, *np.maximum(60 - point + spread, self.floor_db)][: len(frames)]
        sizes = np.full(len(frames), round(1e6 / point))
        return CodedClip(
            point, sizes, np.array([mse(db) for db in qualities]), np.ones(len(frames)), 1.0
        )


class Bounded(Ideal):
    limits = (1.0, 51.0)


@pytest.fixture
def store(tmp_path):
    return CellStore(tmp_path / "cells")


def test_points_that_span_the_window_are_left_alone(store):
    coder = Bounded((20.0, 24.0, 28.0))
    assert spanning_points(CLIP, coder, store, (33, 38)) == coder.points
    assert set(coder.coded) == {20.0, 28.0}, "only the ends are coded"


def test_points_are_added_beyond_both_ends_until_every_frame_spans_the_window(store):
    points = spanning_points(CLIP, Bounded((26.0, 28.0, 30.0)), store, (28, 36))
    # 22 gives 37..39 dB a frame, 24 but 35..37; 34 gives 25..27, 32 but 27..29.
    assert points == (22.0, 24.0, 26.0, 28.0, 30.0, 32.0, 34.0)


def test_points_end_at_the_limits_of_the_codec(store):
    points = spanning_points(CLIP, Bounded((45.0, 48.0)), store, (9.5, 12))
    assert points == (45.0, 48.0, 51.0), "one frame at CRF 51 has 10 dB, the clip 9"


@pytest.mark.parametrize(
    ("window", "floor_db", "nearest"),
    [
        ((60, 70), -math.inf, (48, 58)),
        ((-5, 30), -math.inf, (10, 39)),
        ((32, 35), 36.5, (36.5, 39)),
        ((5, 70), 36.5, (36.5, 58)),
    ],
)
def test_a_window_beyond_the_limits_is_refused_with_the_nearest_that_works(
    store, window, floor_db, nearest
):
    with pytest.raises(WindowNotReached, match=r"ideal reaches on street") as caught:
        spanning_points(CLIP, Bounded((20.0, 30.0), floor_db), store, window)
    assert caught.value.nearest_db == pytest.approx(nearest)
    points = spanning_points(CLIP, Bounded((20.0, 30.0), floor_db), store, nearest)
    qualities = [coded_clip(CLIP, Bounded(points, floor_db), p, store) for p in points]
    assert qualities[-1].psnr_db() <= nearest[0] <= nearest[1] <= qualities[0].psnr_db()


def test_a_field_that_beats_the_window_is_found_at_the_ends(store):
    coder = Bounded((20.0, 24.0), floor_db=36.5)
    with pytest.raises(InvalidInput, match=r"32\.\.35 dB is not within the 36\.50\.\."):
        spanning_points(CLIP, coder, store, (32, 35))
    assert len(coder.coded) <= 9, "the ends alone are coded"


def test_a_codec_without_limits_is_asked_for_its_own_points_only(store):
    coder = Ideal((20.0, 24.0, 28.0))
    assert spanning_points(CLIP, coder, store, (33, 38)) == coder.points
    with pytest.raises(InvalidInput, match="points 20 to 28"):
        spanning_points(CLIP, coder, store, (30, 38))
    assert set(coder.coded) == {20.0, 28.0}


def test_a_performance_over_a_window_holds_the_added_points_and_codes_each_once(store):
    coder = Bounded((24.0, 26.0, 28.0))
    made = perform(CLIP, coder, store, window_db=(29.5, 36.5))
    assert [clip.point for clip in made.clips] == [22.0, 24.0, 26.0, 28.0, 30.0, 32.0]
    assert made.steady.spans((29.5, 36.5))
    times = {clip.point: coder.coded.count(clip.point) for clip in made.clips}
    timed = {point for point, count in times.items() if count == 1 + TIMED_REPEATS}
    assert len(timed) == 1, "the others are coded once"
    assert timed <= {26.0, 28.0}, "timed near the middle of the window, 33 dB"
    assert sum(times.values()) == len(made.clips) + TIMED_REPEATS


class Timed(Ideal):
    """Takes another time whenever it is asked."""

    def __init__(self, times_ms):
        super().__init__((27.0,))
        self.times_ms = list(times_ms)

    def code(self, frames, rate_hz, point):
        coded = super().code(frames, rate_hz, point)
        return CodedClip(point, coded.frame_bytes, coded.luma_mse, coded.ssim, self.times_ms.pop(0))


def test_processor_time_is_that_of_the_least_disturbed_run(store):
    coder = Timed([99.0, 12.0, 4.0, 8.0])
    made = perform(CLIP, coder, store)
    assert coder.times_ms == []
    assert made.cpu_ms_per_frame == 4.0 / len(CLIP.frames)


def test_processor_time_in_turns_is_that_of_the_median_round(store):
    coder = Timed([1.0, 99.0, 4.0, 5.0, 3.0, 8.0])
    coded = [(coder, perform(CLIP, coder, store, timed=False))]
    (timed,) = time_in_turns(CLIP, coded, store, (32.0, 35.0))
    count = len(CLIP.frames)
    assert timed.cpu == CpuTime(5.0 / count, None, 3.0 / count, 99.0 / count)


def test_processor_time_is_taken_over_the_beginning_of_a_long_clip(store):
    clip = Clip("street", 10.0, [FRAME] * (TIMED_FRAMES + 5), "digest", None)
    lengths = []

    class Watched(Ideal):
        def code(self, frames, rate_hz, point):
            lengths.append(len(frames))
            return super().code(frames, rate_hz, point)

    perform(clip, Watched((27.0,)), store)
    assert lengths == [TIMED_FRAMES + 5] + [TIMED_FRAMES] * TIMED_REPEATS


def test_nothing_is_left_to_do_when_every_point_is_coded(store):
    coder = Bounded((20.0, 24.0))
    assert seconds_left(CLIP, [coder], store) > 0
    perform(CLIP, coder, store)
    coder.coded.clear()
    assert seconds_left(CLIP, [coder], store) == 0
    assert coder.coded == []


def test_the_nearest_clip_is_nearest_in_decibels():
    clips = tuple(Ideal((p,)).code([FRAME] * 4, 10, p) for p in (20.0, 30.0))
    made = Performance("ideal", clips, 1.0)
    assert made.nearest(30).point == 30.0
    assert made.nearest(45).point == 20.0


def test_clips_are_kept_under_the_name_of_all_they_depend_on(store):
    coder = Bounded((20.0, 24.0))
    perform(CLIP, coder, store)
    assert store.has(clip_key(CLIP, coder, 24.0))
    for other in (
        Clip("alley", 10.0, CLIP.frames, "digest", None),
        Clip("street", 30.0, CLIP.frames, "digest", None),
        Clip("street", 10.0, CLIP.frames, "other", None),
    ):
        assert not store.has(clip_key(other, coder, 24.0))
