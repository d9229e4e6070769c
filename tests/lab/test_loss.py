"""A lossy link and who predicts from what over it: hand-made fates, statistics and real clips."""

import itertools
from dataclasses import replace
from random import Random

import numpy as np
import pytest

from lab.robust.lossy_link import (
    DATAGRAM_BYTES,
    Bursts,
    Crossing,
    Feedback,
    FrameCoder,
    Lossy,
    Outcome,
    Policy,
    delta_crossing,
    x264_crossing,
)
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfedge.evaluate.clips import read_drive
from rfedge.evaluate.field_coder import render_clip


@pytest.mark.parametrize(("share", "length"), [(0.01, 1.0), (0.05, 2.0), (0.2, 4.0)])
def test_losses_have_the_declared_share_and_length(share, length):
    link = Lossy(Bursts(share, length), Random(1))
    lost = [not link.delivers(1) for _ in range(400_000)]
    bursts = sum(b and not a for a, b in zip([False, *lost], lost, strict=False))
    assert sum(lost) / len(lost) == pytest.approx(share, rel=0.05)
    assert sum(lost) / bursts == pytest.approx(length, rel=0.05)


def test_a_large_frame_is_lost_more_often_than_a_small_one():
    def arrived(size_bytes):
        link = Lossy(Bursts(0.05), Random(2))
        return sum(link.delivers(size_bytes) for _ in range(20_000)) / 20_000

    assert arrived(DATAGRAM_BYTES) == pytest.approx(0.95, abs=0.01)
    assert arrived(20 * DATAGRAM_BYTES) < 0.7
    assert arrived(DATAGRAM_BYTES + 1) < arrived(DATAGRAM_BYTES)


def test_without_loss_everything_arrives():
    link = Lossy(Bursts(0.0), Random(3))
    assert all(link.delivers(10**6) for _ in range(100))


@pytest.mark.parametrize("bad", [{"share": -0.1}, {"share": 0.5}, {"share": 0.1, "length": 0.5}])
def test_a_loss_that_cannot_be_is_refused(bad):
    with pytest.raises(InvalidInput, match=r"loss\."):
        Bursts(**bad)


def bases(policy, rtt_s, fates):
    """Return the base of each frame at 10 Hz, and of one more."""
    feedback = Feedback(10.0, rtt_s)
    chosen = []
    for good in fates:
        chosen.append(feedback.base(policy))
        feedback.sent(good)
    return [*chosen, feedback.base(policy)]


def test_without_loss_the_last_sent_is_the_frame_before_at_any_distance():
    assert bases(Policy.LAST_SENT, 0.5, [True] * 5) == [None, 0, 1, 2, 3, 4]


def test_the_last_acked_is_a_round_trip_old():
    assert bases(Policy.LAST_ACKED, 0.05, [True] * 4) == [None, 0, 1, 2, 3]
    assert bases(Policy.LAST_ACKED, 0.25, [True] * 5) == [None, None, None, 0, 1, 2]


def test_the_last_acked_passes_over_what_was_lost():
    assert bases(Policy.LAST_ACKED, 0.05, [True, False, False, True]) == [None, 0, 0, 0, 3]


def test_after_bad_news_the_last_sent_goes_back_once_and_then_on():
    """Frame 2 is lost; 3 and 4 build on it in vain; the gap shows with frame 3, so 5 goes back."""
    fates = [True, True, False, False, False, True, True]
    assert bases(Policy.LAST_SENT, 0.15, fates) == [None, 0, 1, 2, 3, 1, 5, 6]


def test_render_only_needs_nobody():
    assert bases(Policy.RENDER_ONLY, 0.05, [True] * 3) == [None] * 4


@pytest.fixture(scope="module")
def drive(thumbnail):
    """Thirty frames: the drive forth and back."""
    read = read_drive(thumbnail.drive)
    order = [*range(5), *range(3, 0, -1)] * 4
    return replace(
        read,
        pictures=[read.pictures[k] for k in order[:30]],
        frames=[read.frames[k] for k in order[:30]],
    )


@pytest.fixture(scope="module")
def coder(drive, thumbnail):
    seen = render_clip(load_field(thumbnail.field), drive.cameras)
    return FrameCoder(drive.frames, seen, "fast", 30.0)


def crossing_of(drive, share, rtt_s=0.05, seed=1):
    return Crossing(drive.frames, 10.0, "ultrafast", 30.0, Bursts(share), rtt_s, seed)


def fates(crossing, sizes):
    """Return which frames of these sizes the link itself delivers; the first always arrives."""
    link = crossing.link()
    return [link.delivers(size) or index == 0 for index, size in enumerate(sizes)]


@pytest.mark.parametrize("policy", Policy)
def test_over_a_link_that_loses_nothing_every_frame_is_new(drive, coder, policy):
    outcome = delta_crossing(crossing_of(drive, 0.0), coder, policy)
    assert all(outcome.new)
    assert len(outcome.frame_bytes) == len(outcome.ssim) == len(drive.frames)
    assert min(outcome.ssim) > 0.8


@pytest.mark.parametrize("seed", range(3))
def test_frames_that_need_the_field_alone_are_new_exactly_when_they_arrive(drive, coder, seed):
    crossing = crossing_of(drive, 0.3, seed=seed)
    outcome = delta_crossing(crossing, coder, Policy.RENDER_ONLY)
    arrived = fates(crossing, outcome.frame_bytes)
    assert not all(arrived)
    assert list(outcome.new) == arrived


@pytest.mark.parametrize("policy", Policy)
def test_no_frame_is_new_that_did_not_arrive(drive, coder, policy):
    crossing = crossing_of(drive, 0.3)
    outcome = delta_crossing(crossing, coder, policy)
    arrived = fates(crossing, outcome.frame_bytes)
    assert all(there for new, there in zip(outcome.new, arrived, strict=True) if new)


def test_what_is_predicted_from_a_lost_frame_is_not_shown(drive, coder):
    """Sent on without an answer for 20 frames: all after the first loss are useless."""
    crossing = crossing_of(drive, 0.3, rtt_s=2.0)
    outcome = delta_crossing(crossing, coder, Policy.LAST_SENT)
    arrived = fates(crossing, outcome.frame_bytes)
    lost = arrived.index(False)
    assert outcome.new[:lost] == (True,) * lost
    assert not any(outcome.new[lost : lost + 15])
    assert any(arrived[lost : lost + 15])


def test_a_frame_that_is_not_new_shows_the_one_before(drive, coder):
    outcome = delta_crossing(crossing_of(drive, 0.3), coder, Policy.RENDER_ONLY)
    perfect = delta_crossing(crossing_of(drive, 0.0), coder, Policy.RENDER_ONLY)
    stale = [k for k, new in enumerate(outcome.new) if not new]
    assert all(outcome.ssim[k] < perfect.ssim[k] for k in stale)
    fresh = [k for k, new in enumerate(outcome.new) if new]
    assert [outcome.ssim[k] for k in fresh] == [perfect.ssim[k] for k in fresh]


def test_the_last_acked_frame_is_always_there_to_predict_from(drive, coder):
    crossing = crossing_of(drive, 0.3, rtt_s=0.25)
    outcome = delta_crossing(crossing, coder, Policy.LAST_ACKED)
    assert list(outcome.new) == fates(crossing, outcome.frame_bytes)


def test_the_same_seed_gives_the_same_outcome_and_another_one_another(drive, coder):
    first, again, other = (
        delta_crossing(crossing_of(drive, 0.3, seed=seed), coder, Policy.RENDER_ONLY)
        for seed in (1, 1, 2)
    )
    assert first == again
    assert first.new != other.new


@pytest.mark.parametrize("idr_on_nack", [True, False])
def test_x264_over_a_link_that_loses_nothing_shows_every_frame(drive, idr_on_nack):
    outcome = x264_crossing(crossing_of(drive, 0.0), idr_on_nack=idr_on_nack)
    assert all(outcome.new)
    assert min(outcome.ssim) > 0.7


def test_x264_answers_bad_news_with_a_picture_of_its_own(drive):
    lossless, lossy = (
        x264_crossing(crossing_of(drive, share), idr_on_nack=True) for share in (0.0, 0.3)
    )
    news = list(lossy.new).index(False) + 2  # the gap shows one frame later, within 0.1 s
    assert lossless.frame_bytes[:news] == lossy.frame_bytes[:news]
    assert lossy.frame_bytes[news] > 3 * lossless.frame_bytes[news]
    assert list(lossy.new) == fates(crossing_of(drive, 0.3), lossy.frame_bytes)
    assert np.mean(lossy.ssim) < np.mean(lossless.ssim)


def test_a_row_leaves_the_first_frame_out_and_counts_what_is_not_new():
    outcome = Outcome((9000, 100, 300), (True, False, True), (1.0, 0.5, 0.9))
    row = outcome.row(10.0)
    assert row["kbps"] == pytest.approx(8e-3 * 200 * 10)
    assert row["ssim"] == pytest.approx(0.7)
    assert (row["not_new"], row["frames"]) == (1, 2)
    assert 0.5 <= row["ssim_p5"] <= row["ssim"]


def test_news_of_a_loss_comes_once_the_next_frame_shows_the_gap():
    feedback = Feedback(10.0, 0.05)
    heard = []
    for good in (True, False, True, True):
        feedback.sent(good)
        heard.append(feedback.known_bad())
    assert heard == [[], [], [1], [1]]
    assert feedback.news_of_loss(1)
    assert not feedback.news_of_loss(2)


@pytest.mark.parametrize("policy", [Policy.LAST_SENT, Policy.LAST_ACKED])
def test_whatever_is_lost_a_base_lies_before_its_frame(policy):
    for lost in itertools.product([True, False], repeat=6):
        for index, base in enumerate(bases(policy, 0.15, [True, *lost])):
            assert base is None or 0 <= base < index
