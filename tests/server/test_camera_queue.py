"""The order of one camera's frames: each is answered once, and credit counts the answers."""

from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mec_server.camera_queue import (
    MAX_GAP,
    CameraQueue,
    SequenceGap,
    SessionCameras,
)
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.wire.messages import MAX_EPOCH_STEP, Credit, Frame, FrameAddress, Hello

MakeFrame = Callable[..., Frame]
WINDOW = 2

arrivals = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 12), st.booleans()), max_size=40
).map(lambda frames: sorted(frames, key=lambda frame: frame[0]))
"""(epoch, sequence, whether it decodes); epochs never fall, sequences are lost and repeated."""


def reconstruct(queue: CameraQueue, frame: Frame) -> list[SequenceGap]:
    """Take a frame through the queue, as one that decodes."""
    queue.admit(frame, 0.0)
    assert queue.start() is not None
    queue.check(frame)
    return queue.succeed()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arrivals)
@example([(0, 1, False), (0, 0, True), (0, 2, True)])
def test_each_frame_is_answered_once_and_credit_counts_the_answers(
    make_frame: MakeFrame, arrived: list[tuple[int, int, bool]]
) -> None:
    queue, answers = CameraQueue(WINDOW), 0
    good: list[tuple[int, int]] = []
    nacked: set[tuple[int, int]] = set()
    for epoch, sequence, decodes in arrived:
        frame = make_frame(sequence, epoch)
        queue.admit(frame, 0.0)
        assert queue.start() is not None
        answers += 1
        try:
            queue.check(frame)
        except PacketRejected:
            queue.fail()
            assert (epoch, sequence) <= max(good), "only what came too late is out of order here"
            continue
        if decodes:
            for gap in queue.succeed():
                missing = {(epoch, gap.first + i) for i in range(gap.count)}
                assert not missing & nacked, "it was answered already"
                assert not missing & set(good)
                assert max(missing) < (epoch, sequence)
                nacked |= missing
                answers += gap.count
            good.append((epoch, sequence))
        else:
            queue.fail()
            nacked.add((epoch, sequence))
        assert queue.granted == WINDOW + answers
    assert good == sorted(set(good)), "in order, none twice"
    for epoch in {epoch for epoch, _ in good}:
        last = max(sequence for e, sequence in good if e == epoch)
        assert {(epoch, n) for n in range(last + 1)} <= {*good, *nacked}, "none is forgotten"


@pytest.mark.parametrize(
    ("epoch", "sequence", "reason"),
    [
        (5, 3, RejectReason.STALE_SEQUENCE),
        (5, 2, RejectReason.STALE_SEQUENCE),
        (4, 9, RejectReason.STALE_EPOCH),
        (5, 4 + MAX_GAP + 1, RejectReason.INVALID_ARGUMENT),
        (5 + MAX_EPOCH_STEP + 1, 0, RejectReason.INVALID_ARGUMENT),
        (6, MAX_GAP + 1, RejectReason.INVALID_ARGUMENT),
    ],
)
def test_a_frame_out_of_order_is_refused_with_the_reason(
    make_frame: MakeFrame, epoch: int, sequence: int, reason: RejectReason
) -> None:
    queue = CameraQueue(WINDOW)
    reconstruct(queue, make_frame(3, epoch=5))
    with pytest.raises(PacketRejected) as caught:
        queue.check(make_frame(sequence, epoch))
    assert caught.value.reason is reason


@pytest.mark.parametrize(
    ("epoch", "sequence"),
    [(5, 4), (5, 4 + MAX_GAP), (6, 0), (6, MAX_GAP), (5 + MAX_EPOCH_STEP, 0)],
)
def test_a_frame_at_the_limit_is_taken(make_frame: MakeFrame, epoch: int, sequence: int) -> None:
    queue = CameraQueue(WINDOW)
    reconstruct(queue, make_frame(3, epoch=5))
    gaps = reconstruct(queue, make_frame(sequence, epoch))
    before = sequence - (4 if epoch == 5 else 0)
    assert sum(gap.count for gap in gaps) == before
    assert (queue.epoch, queue.last_good) == (epoch, sequence)


def test_a_frame_that_failed_moves_neither_epoch_nor_sequence(make_frame: MakeFrame) -> None:
    queue = CameraQueue(WINDOW)
    reconstruct(queue, make_frame(0, epoch=1))
    queue.admit(make_frame(7, epoch=9), 0.0)
    queue.start()
    queue.fail()
    assert (queue.epoch, queue.last_good) == (1, 0)
    assert reconstruct(queue, make_frame(1, epoch=1)) == []


def test_gaps_are_runs_around_what_was_answered(make_frame: MakeFrame) -> None:
    queue = CameraQueue(WINDOW)
    queue.refuse(0, 3)
    assert reconstruct(queue, make_frame(6)) == [SequenceGap(0, 3), SequenceGap(4, 2)]


def test_an_answer_without_a_running_frame_is_a_programming_error() -> None:
    with pytest.raises(AssertionError, match="without a running frame"):
        CameraQueue(WINDOW).succeed()


def test_before_hello_there_are_no_cameras(make_frame: MakeFrame) -> None:
    cameras = SessionCameras(WINDOW)
    cameras.refuse(FrameAddress("front", 0, 0))
    assert not cameras.are_busy
    assert cameras.credits() == []
    assert list(cameras.started()) == []
    assert cameras.position(FrameAddress("front", 0, 0)) == (0, None)
    with pytest.raises(InvalidInput, match="frame: came before Welcome"):
        cameras.queue_of(make_frame(0))


def test_credits_are_given_for_the_cameras_that_were_answered(hello: Hello) -> None:
    cameras = SessionCameras(WINDOW)
    cameras.open(hello)
    cameras.refuse(FrameAddress("rear", 0, 0))
    assert cameras.credits({"rear"}) == [Credit("rear", 3)]
    assert cameras.credits(set()) == []
    assert cameras.credits({""}) == cameras.credits() == [Credit("front", 2), Credit("rear", 3)]
