"""When pictures are captured, on a clock that the test holds."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.capture_schedule import Lockstep, Realtime
from cav_agent.frames import Capture, EndReason, FrameResult, Outcome
from rfcore.errors import InvalidInput, RejectReason, RfedgeError

MakeCapture = Callable[..., Capture]
End = Callable[..., None]


@pytest.fixture
def end(make_capture: MakeCapture) -> End:
    """Return what ends pictures of a schedule."""

    def run(schedule: Lockstep, *how: Any) -> None:
        schedule.ended(FrameResult(make_capture(0), *how))

    return run


def test_realtime_captures_at_its_rate_and_does_not_drift() -> None:
    schedule = Realtime(3, rate_hz=10.0)
    assert schedule.next_capture(100.0) == 0
    assert schedule.next_capture(100.05) is None
    assert schedule.get_timer() == pytest.approx(100.1)
    assert schedule.next_capture(100.17) == 1
    assert schedule.get_timer() == pytest.approx(100.2), "lateness does not move the next"
    assert schedule.next_capture(100.2) == 2
    assert schedule.finished
    assert schedule.get_timer() is None


@given(st.integers(1, 20), st.floats(0.5, 100), st.lists(st.floats(0, 5), max_size=40))
def test_realtime_captures_each_picture_once_and_never_early(
    pictures: int, rate_hz: float, steps: list[float]
) -> None:
    schedule, now, captured = Realtime(pictures, rate_hz), 0.0, []
    for step in steps:
        while (index := schedule.next_capture(now)) is not None:
            assert now * rate_hz >= index - 1e-9
            captured.append(index)
        now += step
    assert captured == list(range(len(captured)))


def test_a_loop_begins_again() -> None:
    schedule = Realtime(2, rate_hz=1.0, loop=True)
    assert [schedule.next_capture(float(t)) for t in range(5)] == [0, 1, 0, 1, 0]
    assert not schedule.finished


def test_lockstep_waits_for_the_answer(end: End) -> None:
    schedule = Lockstep(2)
    assert schedule.next_capture(0.0) == 0
    assert schedule.next_capture(9.0) is None
    end(schedule, Outcome.ACKED)
    assert schedule.next_capture(9.0) == 1
    end(schedule, Outcome.NACKED, RejectReason.CRC_MISMATCH)
    assert schedule.finished


def test_lockstep_captures_a_lost_picture_again(end: End) -> None:
    schedule = Lockstep(2)
    assert schedule.next_capture(0.0) == 0
    end(schedule, Outcome.LOST, EndReason.STREAM_LOST)
    assert schedule.next_capture(1.0) == 0


def test_lockstep_gives_up_a_picture_that_is_always_lost(end: End) -> None:
    schedule = Lockstep(2)
    for _ in range(4):
        schedule.next_capture(0.0)
        end(schedule, Outcome.LOST, EndReason.NO_ANSWER, "within 5 s")
    schedule.next_capture(0.0)
    with pytest.raises(RfedgeError, match=r"000.png was lost 5 times: no_answer: within 5 s"):
        end(schedule, Outcome.LOST, EndReason.NO_ANSWER, "within 5 s")


def test_lockstep_stops_at_a_picture_that_cannot_be_coded(end: End) -> None:
    schedule = Lockstep(2)
    schedule.next_capture(0.0)
    with pytest.raises(RfedgeError, match=r"000.png could not be coded: not a readable picture"):
        end(schedule, Outcome.DROPPED, EndReason.NOT_CODED, "not a readable picture")


def test_lockstep_does_not_give_up_a_picture_that_was_dropped_to_stop(end: End) -> None:
    schedule = Lockstep(2)
    for _ in range(4):
        schedule.next_capture(0.0)
        end(schedule, Outcome.LOST, EndReason.NO_ANSWER)
    schedule.next_capture(0.0)
    end(schedule, Outcome.DROPPED, EndReason.STOPPING)
    assert not schedule.finished


def test_lockstep_captures_a_picture_again_that_waited_too_long(end: End) -> None:
    schedule = Lockstep(2)
    schedule.next_capture(0.0)
    end(schedule, Outcome.DROPPED, EndReason.TOO_LATE)
    assert schedule.next_capture(1.0) == 0


def test_an_empty_drive_and_a_senseless_rate_are_refused() -> None:
    with pytest.raises(InvalidInput, match="drive: has no pictures"):
        Lockstep(0)
    with pytest.raises(InvalidInput, match=r"rate: 0.0 Hz"):
        Realtime(1, 0.0)


@pytest.mark.parametrize(("limit_hz", "captured"), [(0.0, 20), (10.0, 20), (5.0, 10), (4.0, 8)])
def test_a_granted_rate_is_kept_on_average_and_the_drive_goes_on_at_its_own_speed(
    limit_hz: float, captured: int
) -> None:
    schedule = Realtime(20, 10.0)
    schedule.limit(limit_hz)
    seen = [(k, index) for k in range(200) if (index := schedule.next_capture(k / 100)) is not None]
    assert len(seen) == captured
    assert all(abs(index / 10 - k / 100) <= 0.0101 for k, index in seen)
    assert schedule.finished


def test_a_rate_that_is_granted_later_is_kept_from_then_on() -> None:
    schedule = Realtime(40, 10.0)
    first = [schedule.next_capture(k / 10) for k in range(10)]
    schedule.limit(2.0)
    then = [schedule.next_capture(k / 10) for k in range(10, 40)]
    assert first == list(range(10))
    assert [i for i in then if i is not None] == [10, 14, 19, 24, 29, 34, 39]


def test_lockstep_of_a_rig_waits_for_every_camera(end: End) -> None:
    schedule = Lockstep(2, cameras=3)
    assert schedule.next_capture(0.0) == 0
    for _ in range(2):
        end(schedule, Outcome.ACKED)
        assert schedule.next_capture(1.0) is None
    end(schedule, Outcome.ACKED)
    assert schedule.next_capture(2.0) == 1


def test_lockstep_takes_an_instant_again_of_which_a_picture_was_lost(end: End) -> None:
    schedule = Lockstep(2, cameras=2)
    assert schedule.next_capture(0.0) == 0
    end(schedule, Outcome.LOST, EndReason.STREAM_LOST)
    end(schedule, Outcome.ACKED)
    assert schedule.next_capture(1.0) == 0


def test_a_camera_whose_picture_cannot_be_coded_does_not_end_the_drive(end: End) -> None:
    schedule = Lockstep(2, cameras=2)
    assert schedule.next_capture(0.0) == 0
    end(schedule, Outcome.DROPPED, EndReason.NOT_CODED)
    end(schedule, Outcome.ACKED)
    assert schedule.next_capture(1.0) == 1
    end(schedule, Outcome.DROPPED, EndReason.NOT_CODED)
    with pytest.raises(RfedgeError, match="could not be coded"):
        end(schedule, Outcome.DROPPED, EndReason.NOT_CODED)
