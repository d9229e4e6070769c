"""A comparison of coders whose curves are known by algebra."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import Clip, CodedClip
from rfedge.evaluate.compare.measure import compare_rows, quality_rows
from rfedge.evaluate.compare.rows import BEST, BEST_OF_ANY_CPU
from rfedge.evaluate.performance import (
    ROUNDS,
    TIMED_REPEATS,
    CpuTime,
    Performance,
    perform,
    time_in_turns,
)
from rfedge.evaluate.rate_curve import LPIPS, SSIM
from rfedge.jobs import CellStore

PLANE = np.zeros((2, 2), np.uint8)
CLIP = Clip("street", 10.0, [I420(PLANE, PLANE[:1, :1], PLANE[:1, :1])], "digest", 27.5)


def performance(name, rate_factor, cpu_ms, frames=10, first=5):
    """Nine points, 28..44 dB, each of ``rate_factor`` times a common exponential rate; the first
    frame of a clip takes ``first`` times the others' bytes."""
    clips = []
    for point in range(9):
        db = 44 - 2 * point
        rate = round(1000 * rate_factor * np.exp(0.25 * (db - 28)))
        mse = np.full(frames, 255.0**2 / 10 ** (db / 10))
        sizes = np.full(frames, rate)
        sizes[0] *= first
        clips.append(CodedClip(point, sizes, mse, np.full(frames, 0.9), cpu_ms * frames))
    return Performance(name, tuple(clips), cpu_ms)


OURS = performance("ours", 0.5, cpu_ms=50)
FAMILIES = {
    "x264-lowdelay": [performance("x264", 1.0, cpu_ms=10)],
    "svtav1-lowdelay": [
        performance("p10", 0.9, cpu_ms=20),
        performance("p8", 0.8, cpu_ms=49),
        performance("p4", 0.4, cpu_ms=51),
    ],
    "x265-lowdelay": [performance("slow", 0.3, 99), performance("fast", 0.7, 60)],
}


@pytest.fixture(scope="module")
def rows():
    return {
        row.rival: row
        for row in compare_rows(CLIP, OURS, FAMILIES)
        if row.window_db == (32.0, 35.0)
    }


def test_a_family_is_represented_by_its_strongest_of_no_more_processor_time(rows):
    assert rows["svtav1-lowdelay"].rival_setting == "p8"


def test_a_family_that_is_always_slower_is_represented_by_its_quickest(rows):
    assert rows["x265-lowdelay"].rival_setting == "fast"


def test_the_best_comparable_rival_never_took_more_processor_time(rows):
    best = rows[BEST]
    assert best.rival_setting == "p8"
    assert best.bd_rate_percent == pytest.approx(100 * (0.5 / 0.8 - 1), abs=0.1)
    assert best.rival_cpu_ms <= best.cpu_ms


def test_the_best_of_all_may_take_any_processor_time(rows):
    best = rows[BEST_OF_ANY_CPU]
    assert best.rival_setting == "slow"
    assert best.bd_rate_percent == pytest.approx(100 * (0.5 / 0.3 - 1), abs=0.1)


def test_a_rival_is_comparable_by_the_time_of_both_ends():
    """Quicker to send and slower to receive than ours, 61 ms to our 60: not comparable."""
    ours = replace(OURS, cpu=CpuTime(50, 10, 59, 62))
    rival = performance("x264", 0.8, cpu_ms=1)
    rows = compare_rows(CLIP, ours, {"x264": [replace(rival, cpu=CpuTime(1, 60, 61, 61))]})
    assert BEST not in {row.rival for row in rows}
    rows = compare_rows(CLIP, ours, {"x264": [replace(rival, cpu=CpuTime(1, 58, 59, 61))]})
    best = next(row for row in rows if row.rival == BEST)
    assert best.both_ends_ms == (60, 59, 62)
    assert best.rival_both_ends_ms == (59, 59, 61)


def with_ssim(each, factor):
    """The same clips with SSIMs that rise evenly in decibels, their bytes times ``factor``."""
    decibels = np.linspace(16, 7, len(each.clips))
    clips = tuple(
        replace(clip, ssim=np.full(10, 1 - 10 ** (-db / 10)), frame_bytes=clip.frame_bytes * factor)
        for clip, db in zip(each.clips, decibels, strict=True)
    )
    return replace(each, clips=clips)


def test_by_ssim_the_figure_is_the_ratio_of_rates_too():
    ours, theirs = with_ssim(OURS, 1), with_ssim(OURS, 4)
    (row,) = quality_rows(SSIM, CLIP, ours, {"x264-ssim": [theirs]})
    assert row.bd_rate_percent == pytest.approx(-75)
    assert row.window == SSIM.window


def test_by_lpips_less_is_better():
    """Distances that fall from point to point: the figure is the ratio of the rates again."""

    def with_lpips(each, factor):
        clips = sorted(each.clips, key=lambda clip: clip.bytes_per_frame())
        notes = [{"lpips": (9, *[0.4 / 1.5**k] * 9)} for k in range(len(clips))]
        pairs = zip(clips, notes, strict=True)
        made = (replace(c, notes=n, frame_bytes=c.frame_bytes * factor) for c, n in pairs)
        return replace(each, clips=tuple(made))

    ours, theirs = with_lpips(OURS, 1), with_lpips(OURS, 4)
    (row,) = quality_rows(LPIPS, CLIP, ours, {"x264": [theirs]})
    assert row.bd_rate_percent == pytest.approx(-75)


def test_by_ssim_a_curve_that_does_not_span_the_window_has_no_row():
    low = replace(
        OURS, clips=tuple(replace(c, ssim=c.ssim * 0.9) for c in with_ssim(OURS, 1).clips)
    )
    assert quality_rows(SSIM, CLIP, low, {"x264-ssim": [with_ssim(OURS, 1)]}) == []


def test_the_first_frame_is_told_apart_from_the_steady_state(rows):
    row = rows["x264-lowdelay"]
    assert row.rival_first_frame_bytes == 2 * row.first_frame_bytes
    assert row.saving_percent_at_db["33"] == pytest.approx(50, abs=0.1)


def test_what_the_first_frame_takes_does_not_count_in_the_steady_state():
    """A stream sends it once: 40 times the bytes there change no figure but its own column."""
    heavy = {"x264-lowdelay": [performance("x264", 1.0, cpu_ms=10, first=40)]}
    (row, *_) = compare_rows(CLIP, OURS, heavy)
    assert row.bd_rate_percent == pytest.approx(-50, abs=0.1)
    assert row.ci95 == pytest.approx([-50, -50], abs=0.1)
    assert row.saving_percent_at_db["33"] == pytest.approx(50, abs=0.1)
    assert row.rival_first_frame_bytes == pytest.approx(16 * row.first_frame_bytes, rel=1e-3)


def test_quality_of_the_first_frame_does_not_count_either():
    clips = []
    for clip in OURS.clips:
        mse = clip.luma_mse.copy()
        mse[0] = 1e4
        clips.append(CodedClip(clip.point, clip.frame_bytes, mse, clip.ssim, clip.cpu_ms))
    ours = Performance("ours", tuple(clips), 50)
    np.testing.assert_allclose(ours.steady.psnr_db, OURS.steady.psnr_db)


def test_a_window_that_is_asked_for_is_the_only_one():
    rows = compare_rows(CLIP, OURS, FAMILIES, [(36.0, 39.0)])
    assert {tuple(row.window_db) for row in rows} == {(36.0, 39.0)}
    assert [row.rival for row in rows] == [*FAMILIES, BEST, BEST_OF_ANY_CPU]


def test_a_window_that_must_be_spanned_and_is_not_is_an_error():
    with pytest.raises(InvalidInput, match=r"20\.\.25 dB is not within the curve's 28\.00"):
        compare_rows(CLIP, OURS, FAMILIES, [(20.0, 25.0)])


def test_a_family_of_nobody_is_an_error():
    with pytest.raises(InvalidInput, match="at least one setting"):
        compare_rows(CLIP, OURS, {"x265-lowdelay": []})


def test_without_a_comparable_rival_there_is_no_best_one():
    slow = {"x265-lowdelay": [performance("slow", 0.3, 99)]}
    assert BEST not in {row.rival for row in compare_rows(CLIP, OURS, slow)}


def test_a_wider_window_is_left_out_where_a_field_shows_more_before_a_bit_is_sent():
    good = Performance("good", tuple(clip for clip in OURS.clips if clip.luma_mse[0] < 42), 50)
    assert good.steady.psnr_db[0] > 30
    rows = compare_rows(CLIP, good, {"x264-lowdelay": FAMILIES["x264-lowdelay"]})
    assert {tuple(row.window_db) for row in rows} == {(32.0, 35.0), (35.0, 38.0)}
    assert set(rows[0].saving_percent_at_db) == {"33", "35"}


class Counting:
    """A coder that counts how often it is asked."""

    name = "counting"
    points = (1.0, 2.0)

    def __init__(self, version):
        self.version = version
        self.calls = 0
        self.cpu_ms = 1.0

    def code(self, _frames, _rate_hz, point):
        self.calls += 1
        return CodedClip(point, np.array([9]), np.array([point]), np.ones(1), self.cpu_ms)


def test_what_was_coded_once_is_not_coded_again(tmp_path):
    store, coders = CellStore(tmp_path), [Counting("a"), Counting("a"), Counting("b")]
    for coder in coders:
        perform(CLIP, coder, store)
    assert [coder.calls for coder in coders] == [2 + TIMED_REPEATS, 0, 2 + TIMED_REPEATS]


def test_processor_time_can_be_taken_anew_without_coding_again(tmp_path):
    store, coder = CellStore(tmp_path), Counting("a")
    before = perform(CLIP, coder, store)
    calls = coder.calls
    coder.cpu_ms = 0.5
    after = perform(CLIP, coder, store, retime=True)
    assert coder.calls == calls + TIMED_REPEATS
    assert after.clips[0].frame_bytes == before.clips[0].frame_bytes
    assert after.cpu_ms_per_frame == before.cpu_ms_per_frame / 2


def test_all_coders_take_turns_and_their_times_are_kept(tmp_path):
    store, order = CellStore(tmp_path), []

    class Watched(Counting):
        def code(self, frames, rate_hz, point):
            order.append(self.name)
            return replace(super().code(frames, rate_hz, point), receiver_cpu_ms=3.0)

    first, second = Watched("a"), Watched("a")
    second.name, second.cpu_ms = "second", 7.0
    coded = [(coder, perform(CLIP, coder, store, timed=False)) for coder in (first, second)]
    order.clear()
    timed = time_in_turns(CLIP, coded, store, (32.0, 35.0))
    assert order == ["counting", "second"] * ROUNDS
    assert [each.cpu for each in timed] == [
        CpuTime(1.0, 3.0, 4.0, 4.0),
        CpuTime(7.0, 3.0, 10.0, 10.0),
    ]
    assert [each.both_ends_ms for each in timed] == [4.0, 10.0]
    again = time_in_turns(CLIP, coded, store, (32.0, 35.0))
    assert again == timed
    assert len(order) == 2 * ROUNDS
    time_in_turns(CLIP, coded, store, (32.0, 35.0), retime=True)
    assert len(order) == 4 * ROUNDS
