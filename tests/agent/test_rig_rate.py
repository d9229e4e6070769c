"""A rig's cameras share one link: the delay is kept, the link is used, quality is even."""

import heapq
import itertools
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random

import numpy as np
import pytest

from cav_agent.frames import Capture, EncodedFrame, EncodeJob, FrameResult, Outcome
from cav_agent.rate_control import BitDivision, RateControl
from cav_agent.session import AgentSession
from rfcore.camera import Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.link import LinkProfile
from rfcore.link.shaper import Link
from rfcore.wire.messages import Ack, Credit, Frame, FrameAddress, Hello, StageTimes, Welcome

RATE_HZ = 5
CODING_S, ANSWERING_S = 0.02, 0.01
LOWEST_CRF = 23.0
BYTES_AT_LOWEST = {"front": 24_000, "left": 12_000, "right": 12_000, "back": 6_000}
NAMES = tuple(BYTES_AT_LOWEST)
MAX_DELAY_S = 0.4


@dataclass
class ModelCoder:
    """Each camera's rate halves every 6 CRF and strays by a tenth."""

    random: Random
    sequences: dict[str, int]

    def __call__(self, job: EncodeJob) -> EncodedFrame:
        camera_id = job.capture.camera_id
        most = BYTES_AT_LOWEST[camera_id]
        crf = LOWEST_CRF
        if job.budget is not None:
            wanted = LOWEST_CRF + 6 * np.log2(most / job.budget.target_bytes)
            crf = min(51.0, max(LOWEST_CRF, wanted))
        size_bytes = int(most * 2 ** ((LOWEST_CRF - crf) / 6 + self.random.uniform(-0.14, 0.14)))
        digest, payload = b"d" * 16, bytes(size_bytes)
        sequence = self.sequences[camera_id]
        self.sequences[camera_id] += 1
        packet = DeltaPacket(job.epoch, sequence, digest, b"", digest, payload, 0)
        return EncodedFrame(packet, {"encode": CODING_S}, Pose.identity(), crf=crf)


class Drive:
    """A rig's session over a link, on a virtual clock; ``ended`` is what became of its pictures."""

    def __init__(
        self, hello: Hello, make_capture: Callable[..., Capture], rate_bps: float, seconds: float
    ) -> None:
        (front,) = hello.cameras
        cameras = tuple(replace(front, camera_id=name) for name in NAMES)
        self.session = AgentSession(
            replace(hello, cameras=cameras), None, RateControl(MAX_DELAY_S), BitDivision({})
        )
        self.session.connected(0.0)
        self.session.messages_to_send(0.0)
        self.session.receive(Welcome("s", True), 0.0)
        for name in NAMES:
            self.session.receive(Credit(name, 2), 0.0)
        self.uplink: Link[FrameAddress] = Link(LinkProfile(rate_bps, 0.02, 2**40))
        self.code = ModelCoder(Random(5), defaultdict(int))
        self.ended: list[FrameResult] = []
        instants = (
            tuple(
                replace(make_capture(i, i / RATE_HZ), camera_id=name, instant=i + 1)
                for name in NAMES
            )
            for i in range(int(seconds * RATE_HZ))
        )
        self._run([(captures[0].captured_s, captures) for captures in instants])

    def _run(self, instants: list[tuple[float, tuple[Capture, ...]]]) -> None:
        order = itertools.count()
        events = [(at_s, next(order), captures) for at_s, captures in instants]
        heapq.heapify(events)  # type: ignore[arg-type]
        while events:
            now, _, event = heapq.heappop(events)
            match event:
                case tuple():
                    self.session.offer(*event)
                case EncodedFrame():
                    self.session.encoded(event, now)
                case _:
                    self.session.receive(event, now)
            job = self.session.job_to_start(now)
            if job is not None:
                heapq.heappush(events, (now + CODING_S, next(order), self.code(job)))  # type: ignore[misc]
            for outgoing in self.session.messages_to_send(now):
                assert isinstance(outgoing.message, Frame)
                for at_s, answer in self._answers(outgoing.message, now):
                    heapq.heappush(events, (at_s, next(order), answer))  # type: ignore[misc]
            self.ended += self.session.take_results()

    def _answers(self, frame: Frame, now: float) -> list[tuple[float, Ack | Credit]]:
        address = frame.address
        due_s = self.uplink.push(address, len(frame.packet.payload) + 150, now).due_s + ANSWERING_S
        ack = Ack(address, StageTimes(), frame.packet.reconstruction_digest)
        return [(due_s, ack), (due_s, Credit(address.camera_id, address.sequence + 3))]

    def settled(self, from_s: float) -> list[FrameResult]:
        """Return what became of the pictures captured after that."""
        return [result for result in self.ended if result.capture.captured_s >= from_s]


@pytest.fixture
def drive(hello: Hello, make_capture: Callable[..., Capture]) -> Callable[[float], Drive]:
    return lambda rate_bps: Drive(hello, make_capture, rate_bps, 30.0)


def acked(results: list[FrameResult], camera_id: str) -> list[FrameResult]:
    return [r for r in results if r.outcome is Outcome.ACKED and r.capture.camera_id == camera_id]


@pytest.mark.parametrize("rate_bps", [0.5e6, 1e6, 2e6])
def test_the_delay_is_kept_the_link_used_and_quality_even(
    drive: Callable[[float], Drive], rate_bps: float
) -> None:
    results = drive(rate_bps).settled(5.0)
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


def test_a_link_that_is_wide_enough_costs_nothing(drive: Callable[[float], Drive]) -> None:
    results = drive(20e6).settled(5.0)
    assert all(result.outcome is Outcome.ACKED for result in results)
    assert {result.encoded.crf for result in results if result.encoded} == {LOWEST_CRF}


@pytest.mark.parametrize("rate_bps", [0.1e6, 0.5e6, 4e6])
def test_no_camera_is_dropped_for_another(drive: Callable[[float], Drive], rate_bps: float) -> None:
    results = drive(rate_bps).ended
    counts = [len(acked(results, name)) for name in NAMES]
    assert max(counts) - min(counts) <= 1
    assert min(counts) > 0
