"""A lossy link and who predicts from what over it, by hand-made fates and by statistics."""

from random import Random

import pytest

from rfcore.errors import InvalidInput
from rfedge.experiments.robust.lossy_link import DATAGRAM_BYTES, Bursts, Feedback, Lossy, Policy


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
