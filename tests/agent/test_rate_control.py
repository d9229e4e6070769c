"""The delay is kept and quality falls: the vehicle's session over links on a virtual clock."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agent.link_world import LOWEST_CRF, ModelCoder, World
from cav_agent.frames import Capture, FrameResult, Outcome
from cav_agent.rate_control import LEAST_CAMERA_SHARE, BitDivision, RateControl
from cav_agent.session import AgentSession
from rfcore.errors import InvalidInput
from rfcore.link.plan import read_link
from rfcore.link.shaper import Delivery, Link, LinkParts, LinkProfile
from rfcore.wire.messages import (
    FrameAddress,
    Hello,
)

RATE_HZ = 10
CODING_S = 0.04
ANSWERING_S = 0.02
BYTES_AT_LOWEST = 20_000


class Steps:
    """A link whose rate changes at given seconds: ``rates`` are (from second, bits per second)."""

    def __init__(self, *rates: tuple[float, float]) -> None:
        self._rates = rates
        self._busy_until_s = 0.0

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        start_s = max(at_s, self._busy_until_s)
        now_s, left_bits = start_s, 8.0 * size_bytes
        ends = [from_s for from_s, _ in self._rates[1:]] + [float("inf")]
        for (_, rate_bps), end_s in zip(self._rates, ends, strict=True):
            possible = max(0.0, end_s - now_s) * rate_bps
            if left_bits <= possible:
                self._busy_until_s = now_s + left_bits / rate_bps
                break
            left_bits, now_s = left_bits - possible, max(now_s, end_s)
        return start_s, self._busy_until_s


@dataclass(frozen=True)
class Picture:
    """The fate of one captured picture."""

    captured_s: float
    delay_s: float | None
    crf: float | None
    payload_bytes: int = 0


def _picture(result: FrameResult) -> Picture:
    delay_s = result.latency_s if result.outcome is Outcome.ACKED else None
    size_bytes = len(result.packet.payload) if result.packet else 0
    crf = result.encoded.crf if result.encoded else None
    return Picture(result.capture.captured_s, delay_s, crf, size_bytes)


@pytest.fixture
def drive_over(hello: Hello, make_capture: Callable[..., Capture]) -> Callable[..., list[Picture]]:
    def run(
        uplink: Link[FrameAddress], max_delay_s: float | None = 0.2, seconds: float = 40.0
    ) -> list[Picture]:
        control = None if max_delay_s is None else RateControl(max_delay_s)
        coder = ModelCoder({"front": BYTES_AT_LOWEST}, CODING_S, spread=0.3)
        world = World(AgentSession(hello, rate_control=control), uplink, coder, ANSWERING_S)
        captures = [(make_capture(i, i / RATE_HZ),) for i in range(int(seconds * RATE_HZ))]
        return list(map(_picture, world.drive(captures)))

    return run


def link(*rates: tuple[float, float]) -> Link[FrameAddress]:
    profile = LinkProfile(1e6, 0.02, 2**40)
    return Link(profile, LinkParts(Steps(*rates)))


def kept(pictures: list[Picture], limit_s: float) -> float:
    """Return the share of coded pictures whose answer came in time."""
    delays = [picture.delay_s for picture in pictures if picture.delay_s is not None]
    return float(np.mean(np.array(delays) <= limit_s))


def between(pictures: list[Picture], from_s: float, to_s: float) -> list[Picture]:
    return [picture for picture in pictures if from_s <= picture.captured_s < to_s]


def crf_of(pictures: list[Picture]) -> float:
    return float(np.mean([picture.crf for picture in pictures if picture.crf is not None]))


SETTLING_S = 1.0


def test_a_rate_that_collapses_costs_quality_and_not_time(
    drive_over: Callable[..., list[Picture]],
) -> None:
    """10 -> 0.3 Mbit/s at 10 s, back at 25 s. At 0.3 a frame of 200 ms less 80 ms of way and work
    has 4.5 kB of its 20, and 10 Hz leave 3.75 kB: 14.5 of CRF."""
    pictures = drive_over(link((0, 10e6), (10, 0.3e6), (25, 10e6)))
    fast, slow = between(pictures, 2, 10), between(pictures, 10 + SETTLING_S, 25)
    assert kept(fast, 0.2) >= 0.99
    assert kept(slow, 0.2) >= 0.99
    assert crf_of(fast) == LOWEST_CRF
    assert LOWEST_CRF + 14.5 < crf_of(slow) < LOWEST_CRF + 22
    coded = [picture for picture in slow if picture.delay_s is not None]
    assert len(coded) >= 0.95 * len(slow), "quality falls before the frame rate does"
    assert crf_of(between(pictures, 25 + 3, 40)) == LOWEST_CRF
    dropped = [picture for picture in pictures if picture.delay_s is None]
    assert all(picture.payload_bytes == 0 for picture in dropped), "only before encoding"


def test_without_control_the_same_collapse_is_seconds_of_delay(
    drive_over: Callable[..., list[Picture]],
) -> None:
    pictures = drive_over(link((0, 10e6), (10, 0.3e6), (25, 10e6)), max_delay_s=None)
    assert kept(between(pictures, 10 + SETTLING_S, 25), 0.2) == 0.0


def test_a_link_that_is_wide_enough_costs_nothing(
    drive_over: Callable[..., list[Picture]],
) -> None:
    pictures = drive_over(link((0, 20e6)))
    assert kept(pictures, 0.2) == 1.0
    assert crf_of(between(pictures, 1.5, 40)) == LOWEST_CRF


@settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # it holds no state
)
@given(rate_bps=st.floats(0.3e6, 30e6), max_delay_ms=st.integers(160, 1000))
def test_whatever_the_rate_the_delay_is_kept(
    drive_over: Callable[..., list[Picture]], rate_bps: float, max_delay_ms: int
) -> None:
    pictures = drive_over(link((0, rate_bps)), max_delay_ms / 1e3, seconds=20)
    assert kept(between(pictures, SETTLING_S, 20), max_delay_ms / 1e3) >= 0.99


def test_wider_links_give_better_pictures(drive_over: Callable[..., list[Picture]]) -> None:
    crfs = [crf_of(between(drive_over(link((0, r))), 3, 40)) for r in (0.3e6, 0.6e6, 1.2e6, 2.4e6)]
    assert crfs == sorted(crfs, reverse=True)
    assert all(a - b > 3 for a, b in itertools.pairwise(crfs)), "double the rate, 6 of CRF less"


def test_an_outage_drops_pictures_before_they_are_coded(
    drive_over: Callable[..., list[Picture]],
) -> None:
    pictures = drive_over(link((0, 4e6), (10, 1.0), (12, 4e6)))
    late = [p for p in pictures if p.delay_s is not None and p.delay_s > 0.2]
    assert len(late) <= 3, "those that were on their way when it began"
    assert kept(between(pictures, 12 + SETTLING_S, 40), 0.2) >= 0.99


def test_a_recorded_drive_is_kept_within_a_second(
    drive_over: Callable[..., list[Picture]],
) -> None:
    plan = read_link(Path("samples/links/drive.toml")).uplink.unbounded()
    pictures = drive_over(plan.link(), 1.0, seconds=60)
    assert kept(between(pictures, SETTLING_S, 60), 1.0) >= 0.99


def test_when_a_recorded_link_stops_only_what_is_on_its_way_is_late(
    drive_over: Callable[..., list[Picture]],
) -> None:
    """The sample stops for up to 0.9 s, about every third second, as cells change. Nobody can tell
    before; two frames may be on their way, and the next waits for their answers."""
    plan = read_link(Path("samples/links/drive.toml")).uplink.unbounded()
    pictures = between(drive_over(plan.link(), 0.5, seconds=60), SETTLING_S, 60)
    coded = [picture.delay_s > 0.5 for picture in pictures if picture.delay_s is not None]
    assert not any(map(all, zip(coded, coded[1:], coded[2:], strict=False)))


def test_what_can_never_be_in_time_is_still_sent_small(
    drive_over: Callable[..., list[Picture]],
) -> None:
    """20 ms of the 50 are left for 100 of way and work: no frame is in time, some still arrive."""
    pictures = drive_over(link((0, 1e6)), 0.05)
    assert kept(pictures, 0.05) == 0.0
    assert max(p.payload_bytes for p in pictures[5:]) < 1000


@pytest.mark.parametrize("max_delay_s", [0.0, 0.009, 61.0, float("nan"), float("inf")])
def test_a_delay_that_cannot_be_is_refused(max_delay_s: float) -> None:
    with pytest.raises(InvalidInput, match=r"max_delay: .* outside 10..60000 ms"):
        RateControl(max_delay_s)


# --- processors are not the link

IDLE = LinkProfile(100e6, 0.005, 2**40)


def drive_with(
    hello: Hello,
    make_capture: Callable[..., Capture],
    coder: ModelCoder,
    answering_s: tuple[float, float],
    **world: Any,
) -> list[Picture]:
    """Drive for 30 s over an idle link within 200 ms."""
    session = AgentSession(hello, rate_control=RateControl(0.2))
    captures = [(make_capture(i, i / RATE_HZ),) for i in range(30 * RATE_HZ)]
    results = World(session, Link(IDLE), coder, answering_s, **world).drive(captures)
    return list(map(_picture, results))


@pytest.mark.parametrize(("coding_s", "answering_s"), [(0.12, 0.06), (0.19, 0.19), (0.03, 0.4)])
def test_slow_processors_lower_no_quality(
    hello: Hello, make_capture: Callable[..., Capture], coding_s: float, answering_s: float
) -> None:
    coder = ModelCoder({"front": BYTES_AT_LOWEST}, coding_s, spread=0.3)
    answering = (0.8 * answering_s, 1.2 * answering_s)
    pictures = drive_with(hello, make_capture, coder, answering)
    coded = [p.crf for p in between(pictures, SETTLING_S, 30) if p.crf is not None]
    assert len(coded) > 50
    assert max(coded) == LOWEST_CRF


class RepairedLink(Link[FrameAddress]):
    """2 Mbit/s on which one packet in ``1 / share`` is lost: TCP repairs it within 50 ms if enough
    others follow, else after its timeout, and what is behind waits."""

    def __init__(self, share: float) -> None:
        super().__init__(LinkProfile(2e6, 0.02, 2**40))
        self._share, self._random, self._last_s = share, Random(4), 0.0

    def push(
        self, item: FrameAddress, size_bytes: int, now: float, *rest: Any
    ) -> Delivery[FrameAddress]:
        delivery = super().push(item, size_bytes, now, *rest)
        packets = -(-size_bytes // 1448)
        late_s = 0.0
        if self._random.random() < 1 - (1 - self._share) ** packets:
            late_s = 0.05 if packets > 3 and self._random.random() < 0.5 else 0.24
        self._last_s = max(self._last_s, delivery.due_s + late_s)
        return replace(delivery, due_s=self._last_s)


@pytest.mark.parametrize("share", [0.01, 0.05])
@pytest.mark.parametrize(("coding_s", "answering_s"), [(0.02, 0.01), (0.2, 0.1)])
def test_losses_that_tcp_repairs_lower_no_quality(
    hello: Hello,
    make_capture: Callable[..., Capture],
    share: float,
    coding_s: float,
    answering_s: float,
) -> None:
    """Smaller frames would not be lost less often, nor repaired sooner."""
    coder = ModelCoder({"front": 7000}, coding_s, spread=0.3)
    session = AgentSession(hello, rate_control=RateControl(0.5))
    answering = (0.8 * answering_s, 1.2 * answering_s)
    world = World(session, RepairedLink(share), coder, answering)
    captures = [(make_capture(i, i / 5),) for i in range(90 * 5)]
    pictures = between(list(map(_picture, world.drive(captures))), 10, 90)
    assert np.median([p.crf for p in pictures if p.crf is not None]) < LOWEST_CRF + 1
    assert kept(pictures, 0.5) > 0.7


@pytest.mark.parametrize("at_server", [False, True])
def test_a_single_late_frame_costs_no_quality(
    hello: Hello, make_capture: Callable[..., Capture], at_server: bool
) -> None:
    """It takes 1.1 s in the processor of one of the ends."""
    slow = {100: 1.1}
    coder = ModelCoder({"front": BYTES_AT_LOWEST}, CODING_S, 0.3, slow_s={} if at_server else slow)
    answering = ANSWERING_S, ANSWERING_S
    slow_server = slow if at_server else {}
    pictures = drive_with(hello, make_capture, coder, answering, slow_s=slow_server)
    late = [p for p in pictures if p.delay_s is not None and p.delay_s > 1]
    assert late
    after_s = max(p.captured_s + (p.delay_s or 0) for p in late)
    assert crf_of(between(pictures, after_s, 30)) == LOWEST_CRF


def test_answers_that_wait_for_the_processor_lower_no_quality(
    hello: Hello, make_capture: Callable[..., Capture]
) -> None:
    """The agent cannot tell this wait from the link's: 2 to 28 ms beside six busy loops on two
    cores."""
    random = Random(3)
    coder = ModelCoder({"front": BYTES_AT_LOWEST}, 0.12, spread=0.3)
    waits = partial(random.uniform, 0.002, 0.03)
    pictures = drive_with(hello, make_capture, coder, (0.05, 0.09), taken_s=waits)
    assert crf_of(between(pictures, SETTLING_S, 30)) <= LOWEST_CRF + 1


# --- the division of an instant's bytes among cameras

NAMES = [f"cam{i}" for i in range(18)]

cameras = st.lists(st.sampled_from(NAMES), min_size=1, max_size=18, unique=True)
codings = st.lists(
    st.tuples(st.sampled_from(NAMES), st.integers(0, 1_000_000), st.floats(1.0, 51.0)), max_size=60
)
priorities = st.dictionaries(st.sampled_from(NAMES), st.floats(0.1, 10.0))


@given(cameras, codings, priorities, st.floats(1.0, 1e9))
def test_shares_sum_to_the_budget_and_none_starves(
    names: list[str], coded: list[tuple[str, int, float]], weights: dict[str, float], total: float
) -> None:
    division = BitDivision(weights)
    for coding in coded:
        division.coded(*coding)
    shares = division.divide(total, names)
    assert set(shares) == set(names)
    assert sum(shares.values()) == pytest.approx(total, rel=1e-9)
    assert min(shares.values()) >= LEAST_CAMERA_SHARE * total / len(names) * (1 - 1e-9)


@given(codings, st.floats(1.0, 1e9))
def test_a_single_camera_gets_everything(coded: list[tuple[str, int, float]], total: float) -> None:
    division = BitDivision({})
    for coding in coded:
        division.coded(*coding)
    assert division.divide(total, ["cam0"]) == {"cam0": pytest.approx(total)}


def test_before_anything_was_coded_all_get_the_same() -> None:
    assert BitDivision({}).divide(300.0, ["a", "b", "c"]) == pytest.approx(
        {"a": 100.0, "b": 100.0, "c": 100.0}
    )


def test_a_camera_that_needs_more_at_the_same_crf_gets_more() -> None:
    division = BitDivision({})
    division.coded("still", 1000, 30.0)
    division.coded("moving", 3000, 30.0)
    shares = division.divide(4000.0, ["still", "moving"])
    assert shares["still"] < 2000.0 < shares["moving"]


def test_bytes_at_another_crf_are_compared_at_one() -> None:
    division = BitDivision({})
    division.coded("a", 1000, 30.0)
    division.coded("b", 500, 36.0)
    shares = division.divide(1000.0, ["a", "b"])
    assert shares["a"] == pytest.approx(shares["b"])


def test_priority_weighs() -> None:
    shares = BitDivision({"front": 3.0}).divide(1000.0, ["front", "rear"])
    assert shares["front"] == pytest.approx(
        1000 * (LEAST_CAMERA_SHARE / 2 + (1 - LEAST_CAMERA_SHARE) * 0.75)
    )


@pytest.mark.parametrize("priority", [0.0, -1.0, float("nan"), float("inf")])
def test_a_priority_that_is_none_is_refused(priority: float) -> None:
    with pytest.raises(InvalidInput, match="priority"):
        BitDivision({"front": priority})
