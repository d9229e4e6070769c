"""A vehicle's session over a link, on a virtual clock, with a coder that is a formula."""

import heapq
import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random

import numpy as np

from cav_agent.frames import Capture, EncodedFrame, EncodeJob, FrameResult
from cav_agent.session import AgentSession
from rfcore.camera import Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.link.shaper import Link
from rfcore.wire.messages import Ack, Credit, Frame, FrameAddress, StageTimes, Welcome

LOWEST_CRF = 23.0
HEADER_BYTES = 150


@dataclass
class ModelCoder:
    """Codes pictures of each camera with so many bytes at the lowest CRF, half as many every 6 of
    CRF, and strays by ``2 ** spread``."""

    bytes_at_lowest: dict[str, int]
    coding_s: float
    spread: float
    random: Random = field(default_factory=lambda: Random(5))
    sequences: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def __call__(self, job: EncodeJob) -> EncodedFrame:
        camera_id = job.capture.camera_id
        most = self.bytes_at_lowest[camera_id]
        crf = LOWEST_CRF
        if job.budget is not None:
            wanted = LOWEST_CRF + 6 * np.log2(most / job.budget.target_bytes)
            crf = min(51.0, max(LOWEST_CRF, wanted))
        strays = self.random.uniform(-self.spread, self.spread)
        size_bytes = int(most * 2 ** ((LOWEST_CRF - crf) / 6 + strays))
        digest, payload = b"d" * 16, bytes(size_bytes)
        packet = DeltaPacket(job.epoch, self.sequences[camera_id], digest, b"", digest, payload, 0)
        self.sequences[camera_id] += 1
        return EncodedFrame(packet, {"encode": self.coding_s}, Pose.identity(), crf=crf)


@dataclass
class World:
    """A session, a coder and an uplink, and a server that answers after ``answering_s``."""

    session: AgentSession
    uplink: Link[FrameAddress]
    code: ModelCoder
    answering_s: float

    def drive(self, instants: Sequence[tuple[Capture, ...]]) -> list[FrameResult]:
        """Return what became of the pictures, in the order of their ends."""
        self.session.connected(0.0)
        self.session.messages_to_send(0.0)
        self.session.receive(Welcome("s", True), 0.0)
        for camera_id in self.code.bytes_at_lowest:
            self.session.receive(Credit(camera_id, 2), 0.0)
        order = itertools.count()
        events: list[tuple[float, int, object]] = [
            (captures[0].captured_s, next(order), captures) for captures in instants
        ]
        heapq.heapify(events)
        ended: list[FrameResult] = []
        while events:
            now, _, event = heapq.heappop(events)
            match event:
                case tuple():
                    self.session.offer(*event)
                case EncodedFrame():
                    self.session.encoded(event, now)
                case Ack() | Credit():
                    self.session.receive(event, now)
            job = self.session.job_to_start(now)
            if job is not None:
                heapq.heappush(events, (now + self.code.coding_s, next(order), self.code(job)))
            for at_s, answer in self._send(now):
                heapq.heappush(events, (at_s, next(order), answer))
            ended += self.session.take_results()
        return ended

    def _send(self, now: float) -> list[tuple[float, Ack | Credit]]:
        answers: list[tuple[float, Ack | Credit]] = []
        for outgoing in self.session.messages_to_send(now):
            frame = outgoing.message
            assert isinstance(frame, Frame)
            address, packet = frame.address, frame.packet
            size_bytes = len(packet.payload) + HEADER_BYTES
            at_s = self.uplink.push(address, size_bytes, now).due_s + self.answering_s
            answers.append((at_s, Ack(address, StageTimes(), packet.reconstruction_digest)))
            answers.append((at_s, Credit(address.camera_id, address.sequence + 3)))
        return answers
