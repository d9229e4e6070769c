"""Which agent sends which camera, on a clock the test turns."""

from dataclasses import replace

import pytest

from mec_server.ledger.budgets import Limit
from mec_server.ledger.entry import CAMERA_SILENT_S, ActiveCameras
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Hello


class Sender:
    """A stream that last sent something at ``heard_s``."""

    def __init__(self, agent: str, heard_s: float = 0.0) -> None:
        self.agent = agent
        self.heard_s = heard_s
        self.displaced: LimitExceeded | None = None

    def silent_s(self, now: float) -> float:
        return now - self.heard_s

    def displace(self, error: LimitExceeded) -> None:
        self.displaced = error


def slow(hello: Hello, rate_hz: float) -> Hello:
    return replace(hello, cameras=tuple(replace(c, rate_hz=rate_hz) for c in hello.cameras))


def test_another_agent_is_refused_while_the_first_sends(hello: Hello) -> None:
    cameras, first = ActiveCameras(), Sender("a")
    cameras.enter(hello, first, 0.0)
    first.heard_s = 99.0
    with pytest.raises(LimitExceeded, match="camera front of vehicle cav-1") as caught:
        cameras.enter(hello, Sender("b"), 99.0 + CAMERA_SILENT_S - 0.01)
    assert caught.value.limit == Limit.CAMERA_TAKEN
    assert caught.value.retry_after_s == CAMERA_SILENT_S
    assert first.displaced is None


def test_another_agent_takes_over_from_one_that_fell_silent(hello: Hello) -> None:
    cameras, first, second = ActiveCameras(), Sender("a"), Sender("b", CAMERA_SILENT_S)
    cameras.enter(hello, first, 0.0)
    cameras.enter(hello, second, CAMERA_SILENT_S)
    assert first.displaced is not None
    assert first.displaced.limit == Limit.CAMERA_TAKEN
    with pytest.raises(LimitExceeded):
        cameras.enter(hello, Sender("a"), CAMERA_SILENT_S + 0.1)
    assert second.displaced is None


def test_a_slow_camera_is_given_two_of_its_periods(hello: Hello) -> None:
    cameras, first = ActiveCameras(), Sender("a")
    cameras.enter(slow(hello, 0.2), first, 0.0)
    with pytest.raises(LimitExceeded) as caught:
        cameras.enter(hello, Sender("b"), CAMERA_SILENT_S + 9.9)
    assert caught.value.retry_after_s == CAMERA_SILENT_S + 10.0, "by then a dead one is replaced"
    cameras.enter(hello, Sender("b"), CAMERA_SILENT_S + 10.0)
    assert first.displaced is not None


def test_the_same_agent_other_vehicles_and_other_cameras_are_let_in(hello: Hello) -> None:
    cameras = ActiveCameras()
    front, rear = hello.cameras
    cameras.enter(replace(hello, cameras=(front,)), Sender("a"), 0.0)
    cameras.enter(hello, Sender("a"), 0.0)
    cameras.enter(replace(hello, vehicle_id="cav-2"), Sender("b"), 0.0)
    fresh = ActiveCameras()
    fresh.enter(replace(hello, cameras=(front,)), Sender("a"), 0.0)
    fresh.enter(replace(hello, cameras=(rear,)), Sender("b"), 0.0)


def test_a_camera_is_free_when_the_last_stream_of_its_agent_ended(hello: Hello) -> None:
    cameras = ActiveCameras()
    streams = [Sender("a"), Sender("a")]
    for stream in streams:
        cameras.enter(hello, stream, 0.0)
    cameras.leave(streams[0])
    with pytest.raises(LimitExceeded):
        cameras.enter(hello, Sender("b"), 0.0)
    cameras.leave(streams[1])
    cameras.enter(hello, Sender("b"), 0.0)
    cameras.leave(streams[1])
    with pytest.raises(LimitExceeded):
        cameras.enter(hello, Sender("c"), 0.0)


def test_one_camera_that_is_taken_refuses_the_whole_hello_and_displaces_nobody(
    hello: Hello,
) -> None:
    """ "front" of the Hello may be taken over, "rear" may not."""
    cameras = ActiveCameras()
    front, rear = hello.cameras
    silent, alive = Sender("a"), Sender("c", CAMERA_SILENT_S)
    cameras.enter(replace(hello, cameras=(front,)), silent, 0.0)
    cameras.enter(replace(hello, cameras=(rear,)), alive, CAMERA_SILENT_S)
    with pytest.raises(LimitExceeded, match="camera rear"):
        cameras.enter(hello, Sender("b"), CAMERA_SILENT_S)
    assert silent.displaced is None
