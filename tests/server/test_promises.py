"""Vehicles are let in at some rate or refused, on a clock the test turns."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server.config import AdmissionLimits
from mec_server.ledger.promises import (
    ASSUMED_HZ,
    DECAY_S,
    HEADROOM,
    MIN_RELATIVE_CHANGE,
    REVIEW_S,
    Promises,
)
from mec_server.session import ServerSession
from rfcore.camera import Intrinsics
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.errors import InvalidInput, LimitExceeded
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Hello, RendererContract, Welcome

SIZE_PX = (640, 360)
FIELD = "ab" * 32
SHARE = 0.5


def hello_of(hz: float, cameras: int = 1) -> Hello:
    width, height = SIZE_PX
    header = StreamHeader(CodecConfig(width, height), b"\x67" * 20, b"\x68" * 5)
    intrinsics = Intrinsics(width, height, 300.0, 300.0, 320.0, 180.0)
    described = tuple(CameraDescription(f"cam-{i}", intrinsics, header, hz) for i in range(cameras))
    return Hello("cav", described, (FIELD,), RendererContract(RENDERER_CONTRACT, exact=True))


def server_where_frames_take(seconds: float, workers: int = 2, **limits: float) -> Promises:
    """A server with one vehicle, of which it has seen enough frames to know."""
    promises = Promises(AdmissionLimits(**{"load": 0.8, **limits}), workers, SHARE)
    promises.enter("first", "first", hello_of(1.0), 0.0)
    for _ in range(1000):
        promises.worked("first", FIELD, seconds)
    return promises


def test_who_fits_gets_the_rate_that_was_asked_for() -> None:
    promises = server_where_frames_take(0.02)
    assert promises.enter("second", "second", hello_of(10.0), 0.0) == 10.0
    assert promises.reduced == 0


def test_the_last_one_gets_what_is_left() -> None:
    """1.6 workers are to be had; 1 Hz of 40 ms and 20 Hz leave (1.6 - 0.84) / 0.04 = 19 Hz."""
    promises = server_where_frames_take(0.04)
    assert promises.enter("second", "second", hello_of(20.0), 0.0) == 20.0
    assert promises.enter("third", "third", hello_of(30.0), 0.0) == pytest.approx(19.0, rel=1e-3)
    assert promises.reduced == 1
    assert promises.promised_share == pytest.approx(1.0, rel=1e-3)


def test_one_for_whom_too_little_is_left_is_told_when_to_come_again() -> None:
    promises = server_where_frames_take(0.04)
    promises.enter("second", "second", hello_of(20.0), 0.0)
    promises.enter("third", "third", hello_of(18.0), 0.0)
    with pytest.raises(
        LimitExceeded, match=r"capacity: 3 vehicles leave 0.04 of 1.6 workers"
    ) as caught:
        promises.enter("fourth", "fourth", hello_of(10.0), 0.0)
    assert caught.value.retry_after_s == AdmissionLimits().retry_s
    slow_hz = promises.enter("slow", "slow", hello_of(1.0), 0.0)
    assert slow_hz == pytest.approx(1.0), "less than the lowest rate, and it fits"


def test_capacity_is_what_frames_take_here_and_not_a_setting() -> None:
    def vehicles_of_10_hz(seconds: float) -> int:
        promises = server_where_frames_take(seconds, lowest_hz=10.0)
        count = 0
        while True:
            try:
                promises.enter(f"cav-{count}", f"cav-{count}", hello_of(10.0), 0.0)
            except LimitExceeded:
                return count
            count += 1

    assert [vehicles_of_10_hz(s) for s in (0.01, 0.02, 0.04)] == [15, 7, 3]


def test_cameras_count_one_by_one() -> None:
    promises = server_where_frames_take(0.04)
    assert promises.enter("four", "four", hello_of(20.0, cameras=4), 0.0) == pytest.approx(
        9.75, rel=1e-3
    )


def test_the_first_vehicle_is_never_refused() -> None:
    promises = Promises(AdmissionLimits(load=0.01), 1, SHARE)
    assert promises.enter("only", "only", hello_of(30.0), 0.0) == AdmissionLimits().lowest_hz


def test_without_a_load_limit_whoever_comes_is_let_in() -> None:
    promises = Promises(AdmissionLimits(load=0.0), 1, SHARE)
    assert [promises.enter(f"cav-{i}", f"cav-{i}", hello_of(30.0), 0.0) for i in range(100)] == [
        0.0
    ] * 100
    assert promises.promised_share == 0.0
    assert promises.reallocate_rates(100.0) == {}


def test_a_vehicle_that_says_no_rate_counts_with_the_usual_one_and_is_not_held_to_it() -> None:
    promises = server_where_frames_take(0.04)
    assert promises.enter("second", "second", hello_of(0.0), 0.0) == 0.0
    assert promises.promised_share == pytest.approx(0.04 * (1 + ASSUMED_HZ) / 1.6, rel=1e-3)


def test_what_a_leaving_vehicle_had_goes_to_those_who_have_less_than_they_asked_for() -> None:
    promises = server_where_frames_take(0.04)
    promises.enter("second", "second", hello_of(20.0), 0.0)
    assert promises.enter("third", "third", hello_of(30.0), 0.0) == pytest.approx(19.0, rel=1e-3)
    assert promises.reallocate_rates(0.0) == {}
    promises.leave("second")
    assert promises.reallocate_rates(REVIEW_S / 2) == {}, "rates are reallocated once a second"
    assert promises.reallocate_rates(REVIEW_S) == {"third": 30.0}


def test_when_frames_become_dearer_the_last_ones_give_way() -> None:
    promises = server_where_frames_take(0.02)
    promises.enter("second", "second", hello_of(20.0), 0.0)
    promises.enter("third", "third", hello_of(20.0), 0.0)
    for _ in range(1000):
        for name in ("first", "second", "third"):
            promises.worked(name, FIELD, 0.045)
    assert promises.promised_share > 1.0
    changed = promises.reallocate_rates(0.0)
    assert changed == {
        "second": pytest.approx(0.8 / 0.045, rel=1e-3),
        "third": pytest.approx((0.8 - 0.045) / 0.045, rel=1e-3),
    }, "its share of a half; what is left"
    assert promises.promised_share == pytest.approx(1.0, rel=1e-3)


# --- shares and decay


def test_nobody_is_kept_out_by_one_that_asks_for_everything() -> None:
    """It is lent what nobody else wants, and holds its share once somebody does."""
    promises = Promises(AdmissionLimits(load=0.8), 2, SHARE)
    greedy_hz = promises.enter("greedy", "greedy", hello_of(1000.0, cameras=16), 0.0)
    assert promises.promised_share == pytest.approx(1.0)
    assert promises.enter("cav-1", "cav-1", hello_of(10.0), 0.0) == 10.0
    changed = promises.reallocate_rates(0.0)
    assert changed["greedy"] < greedy_hz
    assert promises.promised_share == pytest.approx(1.0)


def test_streams_of_one_identity_share_what_it_may_have() -> None:
    promises = server_where_frames_take(0.04, lowest_hz=9.5)
    for number in range(3):
        promises.enter(f"s-{number}", "greedy", hello_of(10.0), 0.0)
    promises.enter("s-3", "greedy", hello_of(9.0), 0.0)
    with pytest.raises(LimitExceeded):
        promises.enter("s-4", "greedy", hello_of(10.0), 0.0)
    assert promises.enter("cav-1", "cav-1", hello_of(10.0), 0.0) == 10.0
    promises.reallocate_rates(0.0)
    assert promises.promised_to("cav-1") == pytest.approx(0.4, rel=1e-3)


def test_a_promise_that_is_not_used_decays_and_comes_back_when_it_is() -> None:
    promises = server_where_frames_take(0.04)
    promises.enter("idle", "idle", hello_of(20.0), 0.0)
    now = 0.0
    for _ in range(round(10 * DECAY_S)):
        now += 1.0
        for _ in range(2):
            promises.worked("idle", FIELD, 0.04)
        assert promises.reallocate_rates(now) == {}, "while nobody wants it, it is kept"
    full = 0.8 / 0.04
    assert promises.enter("second", "second", hello_of(full), now) == pytest.approx(full, rel=1e-3)
    third_hz = promises.enter("third", "third", hello_of(30.0), now)
    # "first" has sent nothing for all this time.
    assert third_hz == pytest.approx(40.0 - full - 2 * HEADROOM, rel=0.05)
    lowered = promises.reallocate_rates(now)
    assert lowered["idle"] == pytest.approx(2 * HEADROOM, rel=0.05)
    for _ in range(8):
        now += 1.0
        for _ in range(round(lowered["idle"])):
            promises.worked("idle", FIELD, 0.04)
        lowered |= promises.reallocate_rates(now)
    assert lowered["idle"] > 4.0, "it uses all it has, and gets more"


def test_frames_that_are_rejected_are_no_use_of_a_promise() -> None:
    """1.6 workers are to be had; 40 Hz of 40 ms. "junk" had its half of them."""
    promises = server_where_frames_take(0.04)
    assert promises.enter("junk", "junk", hello_of(20.0), 0.0) == 20.0
    for second in range(1, round(10 * DECAY_S)):
        for _ in range(20):
            promises.worked("junk", FIELD, 0.04, complete=False)
        promises.reallocate_rates(float(second))
    assert promises.enter("second", "second", hello_of(20.0), 10 * DECAY_S) == 20.0
    third_hz = promises.enter("third", "third", hello_of(30.0), 10 * DECAY_S)
    assert third_hz == pytest.approx(20.0, rel=0.02), "all that the second has left"


@pytest.mark.parametrize(("is_doubtful", "left_hz"), [(False, 0.0), (True, 10.0)])
def test_a_doubtful_identity_needs_nothing_until_it_uses_something(
    is_doubtful: bool, left_hz: float
) -> None:
    """0.8 workers are to be had: 20 Hz of 40 ms, what two vehicles of 10 Hz need."""
    promises = server_where_frames_take(0.04, workers=1)
    promises.leave("first")
    promises.enter("empty", "empty", hello_of(10.0), 0.0, is_doubtful=is_doubtful)
    assert promises.enter("second", "second", hello_of(10.0), 0.0) == 10.0
    if left_hz == 0.0:
        with pytest.raises(LimitExceeded):
            promises.enter("third", "third", hello_of(10.0), 0.0)
        return
    assert promises.enter("third", "third", hello_of(10.0), 0.0) == pytest.approx(left_hz)
    lowered = promises.reallocate_rates(1.0)
    assert lowered == {"empty": AdmissionLimits().lowest_hz}, "it stays, at the lowest rate"
    for _ in range(2):
        promises.worked("empty", FIELD, 0.04)
    promises.reallocate_rates(2.0)
    with pytest.raises(LimitExceeded, match=r"leave 0\.00"):
        promises.enter("fourth", "fourth", hello_of(10.0), 2.0)


def test_more_than_was_granted_is_not_used() -> None:
    """1.6 workers are to be had, 40 Hz of 40 ms; who asks for 1000 Hz is lent all of it."""
    promises = server_where_frames_take(0.04)
    promises.enter("greedy", "greedy", hello_of(1000.0), 0.0)
    later_s = 2 * DECAY_S
    for second in range(1, round(later_s)):
        promises.reallocate_rates(float(second))
    assert promises.enter("second", "second", hello_of(20.0), later_s) == 20.0
    third_hz = promises.enter("third", "third", hello_of(20.0), later_s)
    assert third_hz == pytest.approx(40.0 - 20.0 - 1.0 - 39.0 / math.e**2 * HEADROOM, rel=0.05)


def test_a_field_that_is_slow_to_render_is_known_by_the_next_vehicle() -> None:
    promises = server_where_frames_take(0.02)
    slow = "cd" * 32
    promises.enter("slow", "slow", hello_of(1.0), 0.0)
    for _ in range(1000):
        promises.worked("slow", slow, 1.5)
    with pytest.raises(LimitExceeded):
        promises.enter("second", "second", replace(hello_of(30.0), field_ids=(slow,)), 0.0)
    assert promises.enter("third", "third", hello_of(10.0), 0.0) == 10.0


def test_frames_that_were_rejected_do_not_make_others_seem_quick() -> None:
    promises = server_where_frames_take(0.04)
    for _ in range(1000):
        promises.worked("first", FIELD, 0.0, complete=False)
    assert promises.expected_s("first") == pytest.approx(0.04, rel=1e-3)
    for _ in range(1000):
        promises.worked("first", FIELD, 0.1, complete=False)
    assert promises.expected_s("first") == pytest.approx(0.1, rel=1e-3)
    promises.leave("first")
    promises.enter("second", "second", hello_of(10.0), 0.0)
    assert promises.expected_s("second") == pytest.approx(0.04, rel=1e-3), "nor slow"


def test_one_slow_frame_is_an_accident() -> None:
    promises = server_where_frames_take(0.02)
    promises.enter("second", "second", hello_of(70.0), 0.0)
    before = promises.promised_share
    promises.worked("second", FIELD, 10.0)
    assert promises.promised_share < 1.1 * before


asked = st.lists(st.tuples(st.floats(0.5, 60.0), st.integers(1, 4)), min_size=1, max_size=12)


@given(asked, st.floats(1e-3, 0.2))
def test_never_more_is_promised_than_may_be_beyond_the_lowest_rates(
    vehicles: list[tuple[float, int]], seconds: float
) -> None:
    promises = server_where_frames_take(seconds, workers=4)
    least = 0.0
    for i, (hz, cameras) in enumerate(vehicles):
        try:
            rate_hz = promises.enter(f"cav-{i}", f"cav-{i % 3}", hello_of(hz, cameras), 0.0)
        except LimitExceeded:
            continue
        assert min(hz, 2.0) * (1 - 1e-9) <= rate_hz <= hz * (1 + 1e-9)
        least += min(hz, 2.0) * cameras * seconds
    bound = max(1.0, least / (0.8 * 4) + 1.0)
    promises.reallocate_rates(0.0)
    assert promises.promised_share <= bound * (1 + MIN_RELATIVE_CHANGE)


@pytest.mark.parametrize(
    ("values", "named"),
    [({"load": 1.5}, "max-load"), ({"lowest_hz": 0.0}, "lowest-rate"), ({"retry_s": 0.0}, "retry")],
)
def test_limits_that_cannot_be_are_refused(values: dict[str, float], named: str) -> None:
    with pytest.raises(InvalidInput, match=named):
        AdmissionLimits(**values)


def test_a_granted_rate_is_in_the_welcome_and_a_new_one_in_another(hello: Hello) -> None:
    session = ServerSession("s-1", hello.field_ids, now=0.0)
    session.receive(replace(hello), 0.0)
    (job,) = session.jobs_to_start(0.0)
    session.grant(5.0)
    session.opened(job, 0.0)  # type: ignore[arg-type]
    assert session.messages_to_send(0.0)[0] == Welcome("s-1", exact=True, rate_hz=5.0)
    session.grant(8.0)
    assert session.messages_to_send(0.0) == [Welcome("s-1", exact=True, rate_hz=8.0)]
