"""The deadline's controller with a fake clock: what is chosen, given up, and taken back when."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.deadline import DeadlineController, DeadlineRungs, Step
from rfcore.codec.sender.ladder import MeasuredRung, Rung
from rfcore.errors import InvalidInput
from rfcore.field import Quality

SLOW = MeasuredRung(Rung(), 80.0, 30.0, 0.0)
MIDDLE = MeasuredRung(Rung(references=1), 40.0, 25.0, 10.0)
FAST = MeasuredRung(Rung(Quality(0.25), 1, effort="fast"), 20.0, 12.0, 60.0)
RUNGS = (SLOW, MIDDLE, FAST)
PERIOD_S = 0.1


class Machine:
    """Codes a frame every 100 ms, ``slowness`` times the ladder's milliseconds each."""

    def __init__(self, deadline_ms: float) -> None:
        self.controller = DeadlineController(RUNGS, deadline_ms)
        self.now = 100.0
        self.steps: list[tuple[float, Step]] = []

    def drive(self, seconds: float, slowness: float) -> MeasuredRung:
        until = self.now + seconds
        while self.now < until:
            self.now += PERIOD_S
            rung = self.controller.current
            step = self.controller.measured(rung, rung.sender_ms * slowness, self.now)
            if step is not None:
                self.steps.append((self.now, step))
        return self.controller.current


@pytest.mark.parametrize(
    ("deadline_ms", "rung"), [(100, SLOW), (80, SLOW), (79, MIDDLE), (33, FAST), (5, FAST)]
)
def test_before_the_first_frame_the_ladders_own_times_decide(
    deadline_ms: float, rung: MeasuredRung
) -> None:
    assert DeadlineController(RUNGS, deadline_ms).current is rung


def test_the_first_frame_scales_the_ladder_to_this_machine() -> None:
    slow = Machine(100)
    assert slow.drive(PERIOD_S, 2.0) is MIDDLE
    quick = Machine(33)
    assert quick.drive(PERIOD_S, 0.25) is SLOW


def test_under_load_it_steps_down_at_once_and_up_again_after_a_while() -> None:
    machine = Machine(100)
    assert machine.drive(5, 1.0) is SLOW
    loaded_s = machine.now
    assert machine.drive(5, 1.6) is MIDDLE
    (down_s, down), *_ = machine.steps
    assert down.down
    assert down_s - loaded_s <= 5 * PERIOD_S, "a few frames are enough"
    calm_s = machine.now
    assert machine.drive(10, 1.0) is SLOW
    up_s, up = machine.steps[-1]
    assert not up.down
    assert 2.0 <= up_s - calm_s <= 4.0


def test_one_slow_frame_alone_changes_nothing() -> None:
    machine = Machine(100)
    machine.drive(2, 1.0)
    machine.drive(PERIOD_S, 1.5)
    assert machine.controller.late
    machine.drive(2, 1.0)
    assert machine.steps == []
    assert not machine.controller.late


def test_a_load_near_the_edge_does_not_make_it_alternate() -> None:
    machine = Machine(100)
    machine.drive(2, 1.0)
    machine.drive(300, 1.1)  # 88 ms: on time, but above the room, so never climbed to
    assert machine.steps == []
    machine.drive(3, 1.5)
    machine.drive(300, 1.1)
    assert len(machine.steps) == 1


def test_climbs_that_are_taken_back_become_rarer() -> None:
    machine = Machine(100)
    for _ in range(40):  # calm just long enough to climb, then loaded again
        while machine.controller.current is not SLOW:
            machine.drive(PERIOD_S, 1.0)
        machine.drive(1, 1.6)
    ups = [at for at, step in machine.steps if not step.down]
    gaps = [b - a for a, b in pairwise(ups)]
    assert gaps[-1] > 10 * gaps[0]
    assert gaps[-1] < 70, "but never stop"


def test_frames_without_the_field_say_only_that_they_were_late() -> None:
    """They leave out the render: a lower rung is not climbed from because of them."""
    machine = Machine(100)
    machine.drive(2, 1.6)
    controller = machine.controller
    assert controller.current is MIDDLE
    slowness = controller.slowness
    for k in range(100):
        assert controller.measured(MIDDLE, 5.0, machine.now + k, in_field=False) is None
    assert (controller.slowness, controller.current) == (slowness, MIDDLE)
    later = machine.now + 100
    steps = [controller.measured(MIDDLE, 250.0, later + k, in_field=False) for k in range(9)]
    assert [step.after for step in steps if step is not None] == [FAST]


@given(st.lists(st.floats(0.05, 20), min_size=1, max_size=60), st.floats(1, 500))
def test_whatever_the_load_the_rung_is_one_of_the_ladders(
    loads: list[float], deadline_ms: float
) -> None:
    machine = Machine(deadline_ms)
    for load in loads:
        assert machine.drive(PERIOD_S, load) in RUNGS
    for (_, a), (_, b) in pairwise(machine.steps):
        assert a.after is b.before


def test_a_frame_begun_before_the_last_change_does_not_change_it_again() -> None:
    controller = DeadlineController(RUNGS, 100)
    controller.measured(SLOW, 80, 0.0)
    step = next(filter(None, (controller.measured(SLOW, 200, 0.1 * k) for k in range(1, 9))))
    assert controller.measured(SLOW, 200, 1.0) is None
    assert controller.current is step.after


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_times_that_cannot_be_are_refused(bad: float) -> None:
    with pytest.raises(InvalidInput, match="deadline_ms"):
        DeadlineController(RUNGS, bad)
    with pytest.raises(InvalidInput, match="sender_ms"):
        DeadlineController(RUNGS, 10).measured(SLOW, bad, 0.0)


def test_a_controller_without_rungs_is_refused() -> None:
    with pytest.raises(InvalidInput, match="ladder: has no rungs"):
        DeadlineController((), 10)


def test_the_deadline_of_a_rig_is_that_of_all_its_cameras_together() -> None:
    controller = DeadlineController(RUNGS, 100.0)
    seen: list[float | None] = []
    rungs = DeadlineRungs(controller, lambda c, _: seen.append(c.slowness))
    for instant in (1, 2):
        for _ in range(4):
            rungs.coded(0.030, 100.0 + instant, instant, in_field=True)
    assert seen == [pytest.approx(4 * 30.0 / SLOW.sender_ms)]
    assert controller.late
    assert controller.current is not SLOW


def test_a_camera_that_stands_alone_is_measured_frame_by_frame() -> None:
    controller = DeadlineController(RUNGS, 100.0)
    seen: list[float | None] = []
    rungs = DeadlineRungs(controller, lambda c, _: seen.append(c.slowness))
    for _ in range(3):
        rungs.coded(0.080, 100.0, 0, in_field=True)
    assert seen == [1.0, 1.0, 1.0]
