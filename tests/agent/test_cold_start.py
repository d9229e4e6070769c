"""A vehicle fetches its field over the link that answers come by, on a virtual clock."""

from collections.abc import Callable

import numpy as np
import pytest

from agent.link_world import CHUNK_BYTES, LOWEST_CRF, Download, ModelCoder, World
from cav_agent.field_fetch import IN_FLIGHT_BYTES, FetchPace
from cav_agent.frames import Capture, FrameResult, Outcome
from cav_agent.rate_control import RateControl
from cav_agent.session import AgentSession
from rfcore.link.shaper import Link, LinkProfile
from rfcore.wire.messages import FrameAddress, Hello

RATE_HZ, MAX_DELAY_S, SECONDS = 10, 0.2, 30
CODING_S, ANSWERING_S = 0.03, 0.02
BYTES_AT_LOWEST = 7_000
FETCH_S = 6.0
"""Time that the field takes alone on its link."""
LINKS = {"thin": (2e6, 4e6, 0.015), "steady": (4e6, 4e6, 0.02), "wide": (32e6, 32e6, 0.01)}


def link(rate_bps: float, delay_s: float) -> Link[object]:
    return Link(LinkProfile(rate_bps, delay_s, 2**40))


class ColdStart:
    """A drive that begins while the field still arrives; ``share`` 0: the field is there."""

    def __init__(self, name: str, share: float, *, told: bool = True) -> None:
        up_bps, down_bps, delay_s = LINKS[name]
        self.uplink: Link[FrameAddress] = Link(LinkProfile(up_bps, delay_s, 2**40))
        self.downlink, self.down_bps = link(down_bps, delay_s), down_bps
        self.pace = FetchPace(share or 1.0, lambda: self.is_sending)
        self.is_sending = False
        window_bps = 8 * IN_FLIGHT_BYTES / (2 * delay_s + 8 * CHUNK_BYTES / down_bps)
        self.alone_bps = min(down_bps, window_bps)
        field_bytes = int(FETCH_S * self.alone_bps / 8) if share else 0
        self.download = Download(field_bytes, self.pace, delay_s)
        self.control = RateControl(MAX_DELAY_S, *([self.pace.wait_s] if told else []))

    def drive(self, hello: Hello, make_capture: Callable[..., Capture]) -> list[FrameResult]:
        """Fetch from second 0 on, send pictures from second 1 on."""

        def begun() -> None:
            self.is_sending = True

        session = AgentSession(hello, rate_control=self.control)
        coder = ModelCoder({"front": BYTES_AT_LOWEST}, CODING_S, spread=0.3)
        world = World(session, self.uplink, coder, ANSWERING_S, self.downlink, self.download)
        times = 1 + np.arange(SECONDS * RATE_HZ) / RATE_HZ
        return world.drive([(make_capture(i, float(t)),) for i, t in enumerate(times)], begun)


def crf(results: list[FrameResult], from_s: float, to_s: float = 1 + SECONDS) -> float:
    """Return the mean CRF of what was captured then; a picture that was not coded counts as 51."""
    captured = [r for r in results if from_s <= r.capture.captured_s < to_s]
    return float(np.mean([(r.encoded and r.encoded.crf) or 51.0 for r in captured]))


@pytest.mark.parametrize("name", LINKS)
def test_a_cold_start_is_at_the_links_quality_three_seconds_after_it_began(
    hello: Hello, make_capture: Callable[..., Capture], name: str
) -> None:
    """Also while the rest of the field arrives."""
    cold = ColdStart(name, 0.5)
    results = cold.drive(hello, make_capture)
    there = crf(ColdStart(name, 0).drive(hello, make_capture), 20)
    assert cold.download.ended_s is not None
    assert abs(crf(results, 1 + 3, 1 + 5) - there) <= 1
    assert abs(crf(results, 1 + 3) - there) <= 1
    in_time = [r.latency_s for r in results if r.outcome is Outcome.ACKED and r.latency_s]
    assert np.mean(np.array(in_time[10:]) <= MAX_DELAY_S) >= 0.95


@pytest.mark.parametrize("name", LINKS)
def test_a_download_without_rests_is_not_taken_for_a_bad_link(
    hello: Hello, make_capture: Callable[..., Capture], name: str
) -> None:
    """A controller that does not know of the download sends the smallest frames until its end."""
    cold, ignorant = ColdStart(name, 1.0), ColdStart(name, 1.0, told=False)
    results = cold.drive(hello, make_capture)
    ended_s = cold.download.ended_s
    assert ended_s is not None
    assert crf(results, 1, ended_s) <= LOWEST_CRF + 3
    assert crf(results, ended_s + 1, ended_s + 3) <= LOWEST_CRF + 1
    if name != "wide":
        assert crf(ignorant.drive(hello, make_capture), 2, ended_s) > LOWEST_CRF + 12


def test_a_link_that_collapses_during_a_download_is_noticed(
    hello: Hello, make_capture: Callable[..., Capture]
) -> None:
    """0.3 Mbit/s carry 3.75 kB ten times a second; frames of 7 kB would take 187 ms each."""
    cold = ColdStart("thin", 0.5)
    cold.uplink = Link(LinkProfile(0.3e6, 0.015, 2**40))
    results = [r for r in cold.drive(hello, make_capture) if r.outcome is Outcome.ACKED]
    assert cold.download.ended_s is not None
    during = [r for r in results if 3 < r.capture.captured_s < cold.download.ended_s]
    own_s = 8 * IN_FLIGHT_BYTES / cold.down_bps
    assert np.mean([r.latency_s <= MAX_DELAY_S + own_s for r in during if r.latency_s]) >= 0.9
    assert np.mean([r.packet_bytes for r in during]) < 5_000


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.8])
@pytest.mark.parametrize("name", LINKS)
def test_a_field_takes_its_share_of_the_link_while_pictures_are_sent(
    hello: Hello, make_capture: Callable[..., Capture], name: str, share: float
) -> None:
    cold = ColdStart(name, share)
    cold.drive(hello, make_capture)
    came = [(at_s, size) for at_s, size in cold.download.read if at_s >= 1.2]
    took_s = came[-1][0] - 1.2
    used = 8 * sum(size for _, size in came) / cold.alone_bps / took_s
    assert used == pytest.approx(share, rel=0.2)


def test_a_servers_time_is_not_the_paths(
    hello: Hello, make_capture: Callable[..., Capture]
) -> None:
    """It differs by 40 ms from frame to frame; as cost of the path that would be 1 kB a frame."""
    warm = ColdStart("thin", 0)
    session = AgentSession(hello, rate_control=warm.control)
    coder = ModelCoder({"front": BYTES_AT_LOWEST}, CODING_S, spread=0.3)
    world = World(session, warm.uplink, coder, (0.01, 0.05), warm.downlink)
    results = world.drive([(make_capture(i, 1 + i / RATE_HZ),) for i in range(100)])
    assert crf(results, 2, 11) <= LOWEST_CRF + 1
