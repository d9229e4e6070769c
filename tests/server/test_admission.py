"""Who is let in at which rate, on a clock the test turns."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server.admission import ASSUMED_HZ, MIN_RELATIVE_CHANGE, REVIEW_S, Admission
from mec_server.config import AdmissionLimits
from mec_server.session import ServerSession
from rfcore.camera import Intrinsics
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.header import StreamHeader
from rfcore.errors import InvalidInput, LimitExceeded
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Hello, RendererContract, Welcome

SIZE_PX = (640, 360)
Let = Callable[[Admission, str], float]


def hello_of(hz: float, cameras: int = 1) -> Hello:
    width, height = SIZE_PX
    header = StreamHeader(CodecConfig(width, height), b"\x67" * 20, b"\x68" * 5)
    intrinsics = Intrinsics(width, height, 300.0, 300.0, 320.0, 180.0)
    described = tuple(CameraDescription(f"cam-{i}", intrinsics, header, hz) for i in range(cameras))
    return Hello("cav", described, ("ab" * 32,), RendererContract(RENDERER_CONTRACT, exact=True))


def server_where_frames_take(seconds: float, workers: int = 2, **limits: float) -> Admission:
    """A server with one vehicle, of which it has seen enough frames to know."""
    admission = Admission(AdmissionLimits(**{"load": 0.8, **limits}), workers)
    admission.enter("first", hello_of(1.0))
    for _ in range(1000):
        admission.worked("first", seconds)
    return admission


def test_who_fits_gets_the_rate_that_was_asked_for() -> None:
    admission = server_where_frames_take(0.02)
    assert admission.enter("second", hello_of(10.0)) == 10.0
    assert admission.reduced == 0


def test_the_last_one_gets_what_is_left() -> None:
    """1.6 workers are to be had; 1 Hz of 40 ms and 20 Hz leave (1.6 - 0.84) / 0.04 = 19 Hz."""
    admission = server_where_frames_take(0.04)
    assert admission.enter("second", hello_of(20.0)) == 20.0
    assert admission.enter("third", hello_of(30.0)) == pytest.approx(19.0, rel=1e-3)
    assert admission.reduced == 1
    assert admission.promised_share == pytest.approx(1.0, rel=1e-3)


def test_one_for_whom_too_little_is_left_is_told_when_to_come_again() -> None:
    admission = server_where_frames_take(0.04)
    admission.enter("second", hello_of(38.0))
    with pytest.raises(
        LimitExceeded, match=r"capacity: 2 vehicles leave 0.04 of 1.6 workers"
    ) as caught:
        admission.enter("third", hello_of(10.0))
    assert caught.value.retry_after_s == AdmissionLimits().retry_s
    assert admission.enter("slow", hello_of(1.0)) == 1.0, "less than the lowest rate, and it fits"


def test_capacity_is_what_frames_take_here_and_not_a_setting() -> None:
    def vehicles_of_10_hz(seconds: float) -> int:
        admission = server_where_frames_take(seconds, lowest_hz=10.0)
        count = 0
        while True:
            try:
                admission.enter(f"cav-{count}", hello_of(10.0))
            except LimitExceeded:
                return count
            count += 1

    assert [vehicles_of_10_hz(s) for s in (0.01, 0.02, 0.04)] == [15, 7, 3]


def test_cameras_count_one_by_one() -> None:
    admission = server_where_frames_take(0.04)
    assert admission.enter("four", hello_of(20.0, cameras=4)) == pytest.approx(9.75, rel=1e-3)


def test_the_first_vehicle_is_never_refused() -> None:
    admission = Admission(AdmissionLimits(load=0.01), 1)
    assert admission.enter("only", hello_of(30.0)) == AdmissionLimits().lowest_hz


def test_without_a_load_limit_whoever_comes_is_let_in() -> None:
    admission = Admission(AdmissionLimits(load=0.0), 1)
    assert [admission.enter(f"cav-{i}", hello_of(30.0)) for i in range(100)] == [0.0] * 100
    assert admission.promised_share == 0.0
    assert admission.reallocate_rates(100.0) == {}


def test_a_vehicle_that_says_no_rate_counts_with_the_usual_one_and_is_not_held_to_it() -> None:
    admission = server_where_frames_take(0.04)
    assert admission.enter("second", hello_of(0.0)) == 0.0
    assert admission.promised_share == pytest.approx(0.04 * (1 + ASSUMED_HZ) / 1.6, rel=1e-3)


def test_what_a_leaving_vehicle_had_goes_to_those_who_have_less_than_they_asked_for() -> None:
    admission = server_where_frames_take(0.04)
    admission.enter("second", hello_of(20.0))
    admission.enter("third", hello_of(30.0))
    assert admission.reallocate_rates(0.0) == {}
    admission.leave("second")
    assert admission.reallocate_rates(REVIEW_S / 2) == {}, "rates are reallocated once a second"
    assert admission.reallocate_rates(REVIEW_S) == {"third": 30.0}


def test_when_frames_become_dearer_the_last_ones_give_way() -> None:
    admission = server_where_frames_take(0.02)
    admission.enter("second", hello_of(30.0))
    admission.enter("third", hello_of(30.0))
    for _ in range(1000):
        for name in ("first", "second", "third"):
            admission.worked(name, 0.04)
    assert admission.promised_share > 1.0
    assert admission.reallocate_rates(0.0) == {"third": pytest.approx(9.0, rel=1e-3)}
    assert admission.promised_share == pytest.approx(1.0, rel=1e-3)


def test_one_slow_frame_is_an_accident() -> None:
    admission = server_where_frames_take(0.02)
    admission.enter("second", hello_of(70.0))
    before = admission.promised_share
    admission.worked("second", 10.0)
    assert admission.promised_share < 1.1 * before


asked = st.lists(st.tuples(st.floats(0.5, 60.0), st.integers(1, 4)), min_size=1, max_size=12)


@given(asked, st.floats(1e-3, 0.2))
def test_never_more_is_promised_than_may_be_beyond_the_lowest_rates(
    vehicles: list[tuple[float, int]], seconds: float
) -> None:
    admission = server_where_frames_take(seconds, workers=4)
    least = 0.0
    for i, (hz, cameras) in enumerate(vehicles):
        try:
            rate_hz = admission.enter(f"cav-{i}", hello_of(hz, cameras))
        except LimitExceeded:
            continue
        assert min(hz, 2.0) * (1 - 1e-9) <= rate_hz <= hz
        least += min(hz, 2.0) * cameras * seconds
    bound = max(1.0, least / (0.8 * 4) + 1.0)
    admission.reallocate_rates(0.0)
    assert admission.promised_share <= bound * (1 + MIN_RELATIVE_CHANGE)


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
