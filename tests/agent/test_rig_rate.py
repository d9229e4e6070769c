"""A rig's cameras share one link: the delay is kept, the link is used, quality is even."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.link_world import LOWEST_CRF, ModelCoder, World
from cav_agent.frames import Capture, FrameResult, Outcome
from cav_agent.rate_control import BitDivision, RateControl
from cav_agent.session import AgentSession
from rfcore.link.shaper import Link, LinkProfile
from rfcore.wire.messages import FrameAddress, Hello

RATE_HZ = 5
CODING_S, ANSWERING_S = 0.02, 0.01
BYTES_AT_LOWEST = {"front": 24_000, "left": 12_000, "right": 12_000, "back": 6_000}
NAMES = tuple(BYTES_AT_LOWEST)
MAX_DELAY_S = 0.4


Drive = Callable[[float], list[FrameResult]]


@pytest.fixture
def drive(hello: Hello, make_capture: Callable[..., Capture]) -> Drive:
    """Return what drives for 30 s over a link of a rate."""

    def run(rate_bps: float) -> list[FrameResult]:
        (front,) = hello.cameras
        cameras = tuple(replace(front, camera_id=name) for name in NAMES)
        rig = replace(hello, cameras=cameras)
        session = AgentSession(rig, None, RateControl(MAX_DELAY_S), BitDivision({}))
        uplink: Link[FrameAddress] = Link(LinkProfile(rate_bps, 0.02, 2**40))
        world = World(session, uplink, ModelCoder(BYTES_AT_LOWEST, CODING_S, 0.14), ANSWERING_S)
        return world.drive([
            tuple(
                replace(make_capture(i, i / RATE_HZ), camera_id=name, instant=i + 1)
                for name in NAMES
            )
            for i in range(30 * RATE_HZ)
        ])  # fmt: skip

    return run


def settled(results: list[FrameResult]) -> list[FrameResult]:
    """Return what became of the pictures captured after 5 s."""
    return [result for result in results if result.capture.captured_s >= 5.0]


def acked(results: list[FrameResult], camera_id: str) -> list[FrameResult]:
    return [r for r in results if r.outcome is Outcome.ACKED and r.capture.camera_id == camera_id]


@pytest.mark.parametrize("rate_bps", [0.5e6, 1e6, 2e6])
def test_the_delay_is_kept_the_link_used_and_quality_even(drive: Drive, rate_bps: float) -> None:
    results = settled(drive(rate_bps))
    assert all(result.outcome is Outcome.ACKED for result in results)
    latencies_s = np.array([result.latency_s for result in results])
    assert np.mean(latencies_s <= MAX_DELAY_S) >= 0.98
    used_bps = 8 * sum(result.packet_bytes for result in results) / 25.0
    assert used_bps >= 0.9 * rate_bps, "0.82 to 0.88 where each frame counts as a packet"
    crf = {
        name: np.mean([r.encoded.crf for r in acked(results, name) if r.encoded]) for name in NAMES
    }
    assert max(crf.values()) - min(crf.values()) < 5.0
    assert min(crf.values()) > LOWEST_CRF, "the link is what limits them"


def test_a_link_that_is_wide_enough_costs_nothing(
    drive: Drive,
) -> None:
    results = settled(drive(20e6))
    assert all(result.outcome is Outcome.ACKED for result in results)
    assert {result.encoded.crf for result in results if result.encoded} == {LOWEST_CRF}


@pytest.mark.parametrize("rate_bps", [0.1e6, 0.5e6, 4e6])
def test_no_camera_is_dropped_for_another(drive: Drive, rate_bps: float) -> None:
    results = drive(rate_bps)
    counts = [len(acked(results, name)) for name in NAMES]
    assert max(counts) - min(counts) <= 1
    assert min(counts) > 0
