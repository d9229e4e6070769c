"""One stream is charged, and gives back, on a clock the test turns."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from mec_server.config import AdmissionLimits, IdentityBudget, ServerBudget
from mec_server.ledger.budgets import HELD, Resource, budgets_of
from mec_server.ledger.entry import (
    LEAST_BURST_FRAMES,
    RATE_MARGIN,
    RAW_BYTES_PER_PIXEL,
    UNSTATED_HZ,
    CameraMeter,
    EntryControl,
)
from mec_server.ledger.ledger import LONGER_BURST_S
from mec_server.ledger.peer_log import LINE_BURST, LINES_PER_S, LogLimiter
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Frame, Hello

GIB = 1 << 30


class Sender:
    """A stream of an agent of its own."""

    agent = "a"

    def silent_s(self, now: float) -> float:
        return now - now

    def displace(self, error: LimitExceeded) -> None:
        raise AssertionError(error)


def entry_control(**limits: float) -> EntryControl:
    budgets = budgets_of(IdentityBudget(), ServerBudget(), 2, GIB)
    return EntryControl(budgets, AdmissionLimits(**limits), 2, 0.5, 0.0)


def sent_in(seconds: float, meter: CameraMeter, hz: float, message_bytes: int = 10) -> int:
    """Return how many of ``hz`` frames a second the meter lets through."""
    passed = 0
    for number in range(round(seconds * hz)):
        try:
            meter.spend(message_bytes, number / hz)
        except LimitExceeded:
            continue
        passed += 1
    return passed


def test_a_camera_at_its_granted_rate_is_never_refused() -> None:
    assert sent_in(60.0, CameraMeter(640 * 360, 10.0, 0.0), 10.0) == 600
    assert sent_in(60.0, CameraMeter(640 * 360, 0.0, 0.0), UNSTATED_HZ) == 60 * UNSTATED_HZ


def test_a_camera_without_a_rate_gets_more_than_any_films_and_no_more() -> None:
    for meter in (CameraMeter(640 * 360, 0.0, 0.0), CameraMeter(640 * 360, 10.0, 0.0)):
        meter.grant(0.0, 0.0)
        passed = sent_in(30.0, meter, 1200.0)
        assert passed == pytest.approx(31 * UNSTATED_HZ * RATE_MARGIN, rel=0.05)


def test_a_camera_may_send_the_rate_that_it_states_where_none_is_granted(
    hello: Hello, make_frame: Callable[..., Frame]
) -> None:
    stated = replace(hello, cameras=(replace(hello.cameras[0], rate_hz=2 * UNSTATED_HZ),))
    frame = make_frame(0, camera_id=stated.cameras[0].camera_id)
    account = entry_control(load=0.0).open("s-1", "ipv4:peer", named=False, now=0.0)
    assert account.enter(stated, Sender(), 0.0) == 0.0, "no limit"
    for number in range(4 * round(UNSTATED_HZ)):
        account.spend_frame(frame, 10, number / (2 * UNSTATED_HZ))


def test_a_camera_beyond_its_granted_rate_gets_that_and_a_quarter() -> None:
    passed = sent_in(60.0, CameraMeter(640 * 360, 10.0, 0.0), 100.0)
    assert passed == pytest.approx(60 * 10 * RATE_MARGIN + 10 * RATE_MARGIN, abs=2)


def test_a_camera_that_sends_more_bytes_than_uncoded_pictures_have_is_refused() -> None:
    pixels = 100
    meter = CameraMeter(pixels, 1.0, 0.0)
    raw = round(RAW_BYTES_PER_PIXEL * pixels)
    for _ in range(LEAST_BURST_FRAMES // 2):
        meter.spend(2 * raw, 0.0)
    with pytest.raises(LimitExceeded, match=r"^camera_bytes: "):
        meter.spend(raw, 0.0)


def test_a_stream_gives_everything_back(hello: Hello) -> None:
    entry = entry_control()
    account = entry.open("s-1", "ipv4:peer", named=False, now=0.0)
    account.enter(hello, Sender(), 0.0)
    assert entry.ledger.held(Resource.STREAMS, hello.vehicle_id) == 1
    assert entry.ledger.held(Resource.STREAMS, "ipv4:peer") == 0
    assert entry.ledger.held(Resource.DECODERS) == len(hello.cameras)
    account.leave()
    assert entry.ledger.held(Resource.DECODERS) == 0
    assert entry.promises.promised_share == 0.0
    account.close()
    account.close()
    assert all(entry.ledger.held(resource) == 0 for resource in HELD)


def test_a_hello_that_is_refused_holds_nothing_but_its_stream(hello: Hello) -> None:
    entry = entry_control()
    other = entry.open("s-1", "cav-1", named=True, now=0.0)
    other.enter(hello, Sender(), 0.0)
    second = entry.open("s-2", "cav-2", named=True, now=0.0)
    another_agent = Sender()
    another_agent.agent = "b"
    with pytest.raises(LimitExceeded, match="camera_taken"):
        second.enter(hello, another_agent, 0.0)
    assert entry.ledger.held(Resource.DECODERS, "cav-2") == 0
    assert entry.promises.promised_to("cav-2") == 0.0
    second.close()
    assert entry.ledger.held(Resource.STREAMS) == 1


def test_worker_time_binds_only_while_others_stream(hello: Hello, make_frame: object) -> None:
    frame = make_frame(0)  # type: ignore[operator]
    entry = entry_control()
    account = entry.open("s-1", "greedy", named=True, now=0.0)
    account.enter(hello, Sender(), 0.0)
    account.worked("front", hello.field_ids[0], 60.0, 0.0)
    account.spend_frame(frame, 10, 0.0)
    other = entry.open("s-2", "modest", named=True, now=0.0)
    other.enter(replace(hello, vehicle_id="modest"), Sender(), 0.0)
    with pytest.raises(LimitExceeded, match="identity_worker_seconds"):
        account.spend_frame(frame, 10, 0.0)
    other.spend_frame(frame, 10, 0.0)
    other.leave()
    account.spend_frame(frame, 10, 0.0)


def test_who_was_alone_owes_nothing_when_somebody_comes(hello: Hello, make_frame: object) -> None:
    """A minute of a whole worker, of which its share is a half, and another vehicle connects."""
    frame = make_frame(0)  # type: ignore[operator]
    entry = entry_control()
    account = entry.open("s-1", "slow", named=True, now=0.0)
    account.enter(hello, Sender(), 0.0)
    for second in range(60):
        account.worked("front", hello.field_ids[0], 2.0, float(second))
    other = entry.open("s-2", "modest", named=True, now=60.0)
    other.enter(replace(hello, vehicle_id="modest"), Sender(), 60.0)
    account.spend_frame(frame, 10, 60.5)
    account.worked("front", hello.field_ids[0], 5.0, 60.5)
    with pytest.raises(LimitExceeded, match="identity_worker_seconds") as caught:
        account.spend_frame(frame, 10, 60.6)
    share = entry.ledger.budget(Resource.WORKER_SECONDS).identity
    since_its_last_s = 60.6 - 59.0
    assert caught.value.retry_after_s == pytest.approx(5.0 / share - since_its_last_s)


def test_frames_that_are_rejected_take_little_of_the_workers_while_others_stream(
    hello: Hello, make_frame: object
) -> None:
    frame = make_frame(0)  # type: ignore[operator]
    entry = entry_control()
    account = entry.open("s-1", "mallory", named=True, now=0.0)
    account.enter(hello, Sender(), 0.0)
    budget = entry.ledger.budget(Resource.REJECTED_SECONDS).identity
    burst_s = budget * LONGER_BURST_S[Resource.REJECTED_SECONDS]
    account.rejected(burst_s + 0.5, 0.0)
    account.spend_frame(frame, 10, 0.0)
    other = entry.open("s-2", "modest", named=True, now=0.0)
    other.enter(replace(hello, vehicle_id="modest"), Sender(), 0.0)
    with pytest.raises(LimitExceeded, match="identity_rejected_seconds") as caught:
        account.spend_frame(frame, 10, 0.0)
    assert caught.value.retry_after_s == pytest.approx(0.5 / budget)
    other.spend_frame(frame, 10, 0.0)
    account.spend_frame(frame, 10, 0.5 / budget + 0.01)


def test_work_for_who_caused_work_for_nothing_can_wait_until_that_is_made_up_for(
    hello: Hello,
) -> None:
    entry = entry_control()
    account = entry.open("s-1", "mallory", named=True, now=0.0)
    other = entry.open("s-2", "modest", named=True, now=0.0)
    assert not account.is_doubtful(0.0)
    account.enter(hello, Sender(), 0.0)
    account.rejected(0.06, 0.0)
    refilled_s = 0.06 / entry.ledger.budget(Resource.REJECTED_SECONDS).identity
    assert account.is_doubtful(0.9 * refilled_s)
    assert not account.is_doubtful(1.1 * refilled_s)
    account.opening_failed(10.0)
    assert account.is_doubtful(20.0)
    account.worked("front", hello.field_ids[0], 0.01, 20.0)
    assert not account.is_doubtful(20.0), "a picture pays for the opening"
    assert not other.is_doubtful(0.0)


def test_streams_that_open_decoders_and_give_no_picture_make_their_identity_wait(
    hello: Hello,
) -> None:
    entry = entry_control()

    def stream(number: int, *, gives_a_picture: bool) -> None:
        account = entry.open(f"s-{number}", "cav-1", named=True, now=0.0)
        account.enter(hello, Sender(), 0.0)
        account.take_decoders().release()
        if gives_a_picture:
            account.worked("front", hello.field_ids[0], 0.01, 0.0)
        account.ended(0.0)
        account.close()

    stream(0, gives_a_picture=False)
    stream(1, gives_a_picture=False)
    stream(2, gives_a_picture=True)
    for number in (3, 4, 5):
        stream(number, gives_a_picture=False)
    with pytest.raises(LimitExceeded, match="failed_openings: 3 openings"):
        stream(6, gives_a_picture=True)


def test_lines_beyond_the_burst_are_suppressed_counted_and_told_once() -> None:
    limiter = LogLimiter()
    answers = [limiter.admit("mallory", 0.0) for _ in range(150)]
    assert answers == [0] * round(LINE_BURST) + [None] * (150 - round(LINE_BURST))
    assert limiter.suppressed == 50
    assert limiter.admit("cav-1", 0.0) == 0
    later = 1.0 / LINES_PER_S + 1e-6
    assert limiter.admit("mallory", later) == 50
    for number in range(5000):
        limiter.admit(f"name-{number}", later)
    assert len(limiter._buckets) <= 1024, "names cost no memory"


def test_work_ahead_of_a_frame_is_charged_once_and_for_nothing_if_none_comes(
    hello: Hello,
) -> None:
    entry = entry_control()
    spent = entry.ledger.spent
    account = entry.open("s-1", "cav-1", named=True, now=0.0)
    account.enter(hello, Sender(), 0.0)
    usual_s = account.expected_s("front")
    account.prepared("front", 0.25 * usual_s, 0.0)
    assert account.expected_s("front") == pytest.approx(0.75 * usual_s)
    assert account.expected_s("rear") == usual_s
    whole_s = account.worked("front", hello.field_ids[0], 0.5 * usual_s, 0.0)
    assert whole_s == pytest.approx(0.75 * usual_s)
    assert spent(Resource.WORKER_SECONDS) == pytest.approx(whole_s)
    assert spent(Resource.REJECTED_SECONDS) == 0
    for _ in range(3):
        account.prepared("front", 0.1, 0.0)
    assert spent(Resource.WORKER_SECONDS) == pytest.approx(whole_s + 0.3)
    assert spent(Resource.REJECTED_SECONDS) == pytest.approx(0.2)
    assert account.is_doubtful(0.0)
    account.ended(0.0)
    assert spent(Resource.REJECTED_SECONDS) == pytest.approx(0.3), "as the frames would have been"


def test_poses_ahead_may_come_as_often_as_frames_and_take_none_of_theirs(
    hello: Hello, make_frame: Callable[..., Frame]
) -> None:
    frame = make_frame(0)
    account = entry_control().open("s-1", "cav-1", named=True, now=0.0)
    account.enter(hello, Sender(), 0.0)
    account.grant(2.0, 0.0)

    def taken(spend: Callable[[], None]) -> int:
        for number in range(10_000):
            try:
                spend()
            except LimitExceeded:
                return number
        raise AssertionError("no limit")

    poses = taken(lambda: account.spend_ahead(frame.ahead, 10, 1e3))
    frames = taken(lambda: account.spend_frame(frame, 10, 1e3))
    assert poses == frames
