"""When the live cameras of a rig are due together: in phase or not, with one late, or lost."""

import pytest

from cav_agent.live_cameras import InstantClock


@pytest.fixture
def clock() -> InstantClock:
    """Three cameras at 10 Hz that sent lately."""
    clock = InstantClock(3, 10.0)
    clock.taken([0.0, 0.0, 0.0])
    return clock


def test_nothing_is_due_without_a_frame(clock: InstantClock) -> None:
    assert clock.due_s([None, None, None]) is None


def test_an_instant_is_due_at_once_when_every_camera_has_a_new_frame(clock: InstantClock) -> None:
    assert clock.due_s([0.11, 0.10, 0.14]) == 0.10


def test_a_camera_that_is_late_is_waited_for_half_a_period(clock: InstantClock) -> None:
    assert clock.due_s([0.10, None, 0.12]) == pytest.approx(0.15)


def test_a_camera_that_was_lost_is_not_waited_for(clock: InstantClock) -> None:
    for at in (0.1, 0.2, 0.3, 0.4):
        clock.taken([at, None, at])
    assert clock.due_s([0.5, None, 0.5]) == 0.5
    assert clock.due_s([0.5, None, None]) == pytest.approx(0.55)
    clock.taken([0.5, 0.52, 0.5])
    assert clock.due_s([0.6, None, 0.6]) == pytest.approx(0.65)


def test_a_camera_that_never_sent_is_not_waited_for() -> None:
    assert InstantClock(2, 10.0).due_s([0.3, None]) == 0.3
