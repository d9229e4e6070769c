"""Instants that wait: begun ones are finished, the newest wins, one stuck camera holds up none."""

from collections.abc import Callable

import pytest

from cav_agent.frames import Capture
from cav_agent.waiting_instants import WaitingInstants

MakeCapture = Callable[..., Capture]
CAMERAS = ("a", "b", "c")


class World:
    """Instants of three cameras, of which those in ``may`` may send."""

    def __init__(self, make_capture: MakeCapture) -> None:
        self.may = set(CAMERAS)
        self.waiting = WaitingInstants(1, lambda camera_id: camera_id in self.may)
        self._make = make_capture

    def offer(self, instant: int) -> list[tuple[str, int]]:
        captures = tuple(
            Capture(
                made.index,
                made.picture,
                made.captured_s,
                made.capture_time_ns,
                camera_id=camera_id,
                instant=instant,
            )
            for camera_id in CAMERAS
            for made in [self._make(instant)]
        )
        return names(self.waiting.offer(captures))

    def begin(self) -> list[tuple[str, int]] | None:
        """Begin the next instant if it may; return what is left out of it."""
        return names(self.waiting.begin()) if self.waiting.startable() else None

    def take(self) -> tuple[str, int] | None:
        capture = self.waiting.next()
        return None if capture is None else (capture.camera_id, capture.instant)


def names(captures: list[Capture]) -> list[tuple[str, int]]:
    return [(capture.camera_id, capture.instant) for capture in captures]


@pytest.fixture
def world(make_capture: MakeCapture) -> World:
    return World(make_capture)


def test_an_instant_that_was_begun_is_finished_before_a_newer_one(world: World) -> None:
    world.offer(1)
    assert world.begin() == []
    assert world.take() == ("a", 1)
    assert world.offer(2) == []
    assert world.begin() is None
    assert [world.take(), world.take(), world.take()] == [("b", 1), ("c", 1), None]
    assert world.begin() == []
    assert world.take() == ("a", 2)


def test_the_newest_instant_takes_the_place_of_one_that_waits_as_a_whole(world: World) -> None:
    world.offer(1)
    assert world.offer(2) == [("a", 1), ("b", 1), ("c", 1)]
    assert world.begin() == []
    assert world.take() == ("a", 2)


def test_an_instant_waits_until_all_its_cameras_may_send(world: World) -> None:
    world.may = {"a", "c"}
    world.offer(1)
    assert world.begin() is None
    world.may.add("b")
    assert world.begin() == []


def test_a_camera_that_may_not_send_costs_the_others_one_instant(world: World) -> None:
    world.may = {"a", "c"}
    world.offer(1)
    assert world.offer(2) == [("a", 1), ("b", 1), ("c", 1)]
    for instant in (3, 4, 5):
        assert world.begin() == [("b", instant - 1)]
        assert [world.take(), world.take()] == [("a", instant - 1), ("c", instant - 1)]
        assert world.offer(instant) == []
    world.may.add("b")
    assert world.begin() == []


def test_a_link_on_which_none_may_send_leaves_nobody_out(world: World) -> None:
    world.may = set()
    world.offer(1)
    world.offer(2)
    world.may = {"a", "b"}
    assert world.begin() is None
    world.may = set(CAMERAS)
    assert world.begin() == []


def test_what_was_begun_gives_way_when_a_connection_was_lost(world: World) -> None:
    world.offer(1)
    world.begin()
    world.take()
    world.may = set()
    assert world.offer(2) == [("b", 1), ("c", 1)]


def test_clear_returns_everything(world: World) -> None:
    world.offer(1)
    world.begin()
    world.take()
    world.offer(2)
    cleared = names(world.waiting.clear())
    assert cleared == [("b", 1), ("c", 1), ("a", 2), ("b", 2), ("c", 2)]
    assert not world.waiting
