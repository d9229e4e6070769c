"""What one vehicle may use, on a clock the test turns."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server.config import VehicleQuota
from mec_server.quotas import (
    BARRED_S,
    CAMERA_SILENT_S,
    MAX_LOST_DECODERS,
    ActiveCameras,
    Limit,
    Quotas,
    TokenBucket,
)
from rfcore.errors import InvalidInput, LimitExceeded
from rfcore.wire.messages import Hello

times = st.lists(st.tuples(st.floats(0, 2), st.floats(0.1, 20)), max_size=60)


@given(times)
def test_a_bucket_never_lets_more_through_than_its_rate_one_burst_and_one_message(
    steps: list[tuple[float, float]],
) -> None:
    bucket, now, taken = TokenBucket(10.0, 0.0), 0.0, 0.0
    for pause_s, amount in steps:
        now += pause_s
        taken += amount if bucket.take(amount, now) else 0.0
        assert taken <= 10.0 * now + 10.0 + 20.0 + 1e-6


def test_a_vehicle_within_its_rate_is_never_refused() -> None:
    allowance = Quotas(VehicleQuota(frames_per_s=20, bytes_per_s=20_000)).enter("cav-1", 0.0)
    for i in range(1000):
        allowance.spend(1000, i / 20)


@pytest.mark.parametrize(
    ("message_bytes", "limit"), [(1, Limit.FRAME_RATE), (100_000, Limit.BYTE_RATE)]
)
def test_the_rate_that_is_exceeded_is_named_and_holds_for_all_streams_together(
    message_bytes: int, limit: Limit
) -> None:
    quotas = Quotas(VehicleQuota(frames_per_s=20, bytes_per_s=100_000))
    one, two = quotas.enter("cav-1", 0.0), quotas.enter("cav-1", 0.0)
    for _ in range(20 if limit is Limit.FRAME_RATE else 1):
        one.spend(message_bytes, 0.0)
    with pytest.raises(LimitExceeded, match=rf"^{limit}: more than ") as caught:
        one.spend(message_bytes, 0.0)
    assert caught.value.limit == limit
    with pytest.raises(LimitExceeded):
        two.spend(message_bytes, 0.0)
    quotas.enter("cav-2", 0.0).spend(message_bytes, 0.0)
    two.spend(message_bytes, 1.0)


def test_streams_of_one_vehicle_are_counted_and_given_back() -> None:
    quotas = Quotas(VehicleQuota(streams=2))
    first, _ = quotas.enter("cav-1", 0.0), quotas.enter("cav-1", 0.0)
    with pytest.raises(LimitExceeded, match=r"^vehicle_streams: .* 2 streams open, 2 may be"):
        quotas.enter("cav-1", 0.0)
    quotas.enter("cav-2", 0.0)
    first.leave()
    quotas.enter("cav-1", 0.0)


def test_who_costs_three_decoders_in_a_minute_stays_out_for_it_and_then_comes_back() -> None:
    quotas = Quotas(VehicleQuota())
    allowance = quotas.enter("cav-1", 0.0)
    for i in range(MAX_LOST_DECODERS - 1):
        allowance.lost_decoder(float(i))
    with pytest.raises(LimitExceeded, match=r"^lost_decoders: .* cost 3 decoders within 60 s"):
        allowance.lost_decoder(10.0)
    allowance.leave()
    with pytest.raises(LimitExceeded):
        quotas.enter("cav-1", BARRED_S - 0.1)
    quotas.enter("cav-1", BARRED_S)


def test_a_decoder_lost_now_and_then_bars_nobody() -> None:
    allowance = Quotas(VehicleQuota()).enter("cav-1", 0.0)
    for i in range(20):
        allowance.lost_decoder(i * BARRED_S / (MAX_LOST_DECODERS - 1))


def test_vehicles_that_left_cost_no_memory() -> None:
    quotas = Quotas(VehicleQuota())
    for i in range(100):
        quotas.enter(f"cav-{i}", 0.0).leave()
    quotas.enter("cav-last", 0.0)
    assert list(quotas._accounts) == ["cav-last"]


@pytest.mark.parametrize("change", [{"streams": 0}, {"frames_per_s": 0.0}, {"bytes_per_s": 0.0}])
def test_a_quota_that_lets_nobody_in_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(InvalidInput, match=rf"^quota\.{next(iter(change))}: "):
        VehicleQuota(**change)  # type: ignore[arg-type]


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
    """Of the Hello, "front" may be taken over, "rear" not."""
    cameras = ActiveCameras()
    front, rear = hello.cameras
    silent, alive = Sender("a"), Sender("c", CAMERA_SILENT_S)
    cameras.enter(replace(hello, cameras=(front,)), silent, 0.0)
    cameras.enter(replace(hello, cameras=(rear,)), alive, CAMERA_SILENT_S)
    with pytest.raises(LimitExceeded, match="camera rear"):
        cameras.enter(hello, Sender("b"), CAMERA_SILENT_S)
    assert silent.displaced is None
