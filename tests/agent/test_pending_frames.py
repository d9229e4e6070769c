"""Frames wait for the encoder, then for an answer; the next is predicted from one of them."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.config import AgentLimits
from cav_agent.frames import Capture, FrameResult, Outcome
from cav_agent.pending_frames import (
    AHEAD_TRY_EVERY,
    SLOWEST_BPS,
    AheadSwitch,
    AnswerTimeout,
    FramesInFlight,
    PredictionChain,
    WaitingInstants,
)
from rfcore.errors import RejectReason
from rfcore.wire.messages import Ack, FrameAddress, Nack, StageTimes

MakeCapture = Callable[..., Capture]
LIMITS = AgentLimits(answer_s=5.0)
CAMERAS = ("a", "b", "c")


# --- pictures that wait for the encoder


class World:
    """Instants of three cameras, of which those in ``may`` may send."""

    def __init__(self, make_capture: MakeCapture) -> None:
        self.may = set(CAMERAS)
        self.waiting = WaitingInstants(1, lambda camera_id: camera_id in self.may)
        self._make = make_capture

    def offer(self, instant: int) -> list[tuple[str, int]]:
        captures = tuple(
            replace(self._make(instant), camera_id=camera_id, instant=instant)
            for camera_id in CAMERAS
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


# --- how long an answer may take


def test_a_first_answer_may_take_the_longest_time_allowed() -> None:
    timeout = AnswerTimeout(LIMITS)
    assert timeout.timeout_s(1000) == 5.0
    timeout.answered(0.05)
    timeout.reset()
    assert timeout.timeout_s(1000) == 5.0


def test_a_small_frame_of_a_quick_server_is_given_up_after_little_more_than_a_second() -> None:
    timeout = AnswerTimeout(LIMITS)
    timeout.answered(0.1)
    assert timeout.timeout_s(3000) == pytest.approx(LIMITS.stall_s + 0.08 + 0.2)


@given(st.lists(st.floats(0, 3), min_size=1), st.integers(0, 200_000))
def test_what_was_usual_and_what_the_slowest_link_takes_is_always_waited_for(
    usual_s: list[float], size_bytes: int
) -> None:
    timeout = AnswerTimeout(LIMITS)
    for spent_s in usual_s:
        timeout.answered(spent_s)
    needed_s = 8 * size_bytes / SLOWEST_BPS + max(usual_s[-8:])
    assert min(5.0, needed_s) <= timeout.timeout_s(size_bytes) <= 5.0


# --- frames without an answer


def address(sequence: int, epoch: int = 0) -> FrameAddress:
    return FrameAddress("front", epoch, sequence)


@pytest.fixture
def in_flight(make_capture: MakeCapture) -> FramesInFlight:
    """Three frames of 1 kB, encoded at seconds 1, 2 and 3; the longest wait is 5 s."""
    frames = FramesInFlight(LIMITS)
    for sequence in range(3):
        result = FrameResult(make_capture(sequence), Outcome.LOST, packet_bytes=1000)
        frames.add(address(sequence), result, None, 1.0 + sequence)
    return frames


def test_the_oldest_frame_is_overdue_first(in_flight: FramesInFlight) -> None:
    assert in_flight.timeout_at() == 6.0
    assert in_flight.longest_wait_s(6.5) == 5.5
    in_flight.pop(address(0))
    assert in_flight.timeout_at() == 7.0


def test_a_frame_may_take_longer_behind_others_on_a_slow_link(
    make_capture: MakeCapture,
) -> None:
    frames = FramesInFlight(AgentLimits(answer_s=60.0))
    large = FrameResult(make_capture(0), Outcome.LOST, packet_bytes=37_500)  # 1 s at the slowest
    frames.add(address(0), large, None, 0.0)
    frames.acked(Ack(address(0), StageTimes(), b""), 0.5)
    frames.pop(address(0))
    for sequence in (1, 2):
        frames.add(address(sequence), large, None, 10.0)
    waits = [LIMITS.stall_s + behind + 2 * 0.5 for behind in (1.0, 2.0)]
    assert frames.timeout_at() == pytest.approx(10.0 + waits[0])
    frames.pop(address(1))
    assert frames.timeout_at() == pytest.approx(10.0 + waits[1])


@pytest.mark.parametrize(
    ("nack", "sequences"),
    [
        (Nack(address(1), RejectReason.CRC_MISMATCH, "crc"), [1]),
        (Nack(address(1), RejectReason.SEQUENCE_GAP, "lost", count=2), [1, 2]),
        (Nack(address(0, epoch=1), RejectReason.STALE_EPOCH, "old"), []),
        (Nack(FrameAddress("rear", 0, 1), RejectReason.CRC_MISMATCH, "crc"), []),
        (Nack(FrameAddress("", 0, 0), RejectReason.INVALID_ARGUMENT, "garbage"), [0, 1, 2]),
    ],
)
def test_a_refusal_is_about_the_frames_it_names_or_about_all_if_it_could_not_read_them(
    in_flight: FramesInFlight, nack: Nack, sequences: list[int]
) -> None:
    assert [a.sequence for a, _ in in_flight.refused_by(nack)] == sequences


# --- what the next frame is predicted from


def test_an_epoch_without_a_packet_is_used_again() -> None:
    chain = PredictionChain(4)
    chain.restart()
    assert chain.epoch == 4
    chain.started()
    chain.restart()
    assert chain.epoch == 5


# --- poses ahead of their frames


def poses_sent(
    switch: AheadSwitch,
    capture: Capture,
    frames: int,
    won_ms: float = 20.0,
    waited_ms: float = 0.0,
    s_per_byte: float = 2e-6,
) -> int:
    """Send frames of changing sizes; return how many had a pose ahead."""
    sent = 0
    for number in range(frames):
        ahead_bytes = 14 if switch.next() else 0
        sent += ahead_bytes > 0
        size_bytes = 600 + 50 * (number % 5) + ahead_bytes
        times = StageTimes(
            queue_ns=round(1e6 * waited_ms), ahead_ns=round(1e6 * won_ms) if ahead_bytes else 0
        )
        result = FrameResult(
            capture,
            Outcome.ACKED,
            packet_bytes=size_bytes,
            ahead_bytes=ahead_bytes,
            server=times,
            link_s=0.05 + size_bytes * s_per_byte,
        )
        switch.answered(result)
    return sent


TRIED = 100 // AHEAD_TRY_EVERY


@pytest.mark.parametrize(
    ("link", "least", "most"),
    [
        ({}, 100, 100),
        ({"won_ms": 0.0}, TRIED, 4 + TRIED),
        ({"waited_ms": 20.0}, TRIED, 4 + TRIED),
        ({"s_per_byte": 8 / 64e3}, 100, 100),
        ({"s_per_byte": 8 / 16e3}, TRIED, 4 + TRIED),
    ],
    ids=["pays", "server full", "frame waited for it", "slow link", "too slow a link"],
)
def test_poses_are_sent_ahead_as_long_as_that_pays(
    make_capture: MakeCapture, link: dict[str, float], least: int, most: int
) -> None:
    assert least <= poses_sent(AheadSwitch(True), make_capture(0), 100, **link) <= most


def test_a_server_that_has_room_again_is_found(make_capture: MakeCapture) -> None:
    switch = AheadSwitch(True)
    poses_sent(switch, make_capture(0), 100, won_ms=0.0)
    assert poses_sent(switch, make_capture(0), AHEAD_TRY_EVERY + 10) >= 10


def test_a_frame_that_was_refused_after_its_pose_lets_the_next_go_without(
    make_capture: MakeCapture,
) -> None:
    switch = AheadSwitch(True)
    poses_sent(switch, make_capture(0), 10)
    switch.failed()
    assert not switch.next()
    assert poses_sent(switch, make_capture(0), AHEAD_TRY_EVERY + 10) >= 10


def test_none_is_sent_ahead_where_none_is_wanted(make_capture: MakeCapture) -> None:
    assert poses_sent(AheadSwitch(False), make_capture(0), 100) == 0
