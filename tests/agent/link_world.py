"""A vehicle's session over a link, on a virtual clock, with a coder that is a formula."""

import heapq
import itertools
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random

import numpy as np

from cav_agent.field_fetch import IN_FLIGHT_BYTES, FetchPace
from cav_agent.frames import Capture, EncodedFrame, EncodeJob, FrameResult
from cav_agent.session import AgentSession
from rfcore.camera import Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.link.shaper import Link
from rfcore.wire.messages import Ack, Credit, Frame, FrameAddress, StageTimes, Welcome

LOWEST_CRF = 23.0
HEADER_BYTES = 150
CHUNK_BYTES = 16 * 1024
ANSWER_BYTES = 100


@dataclass(frozen=True)
class Answer:
    """The answer of a server to a frame."""

    messages: tuple[Ack, Credit]


@dataclass
class ModelCoder:
    """Codes pictures of each camera with so many bytes at the lowest CRF, half as many every 6 of
    CRF, and strays by ``2 ** spread``."""

    bytes_at_lowest: dict[str, int]
    coding_s: float
    spread: float
    random: Random = field(default_factory=lambda: Random(5))
    sequences: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    slow_s: dict[int, float] = field(default_factory=dict)

    def __call__(self, job: EncodeJob) -> EncodedFrame:
        camera_id = job.capture.camera_id
        most = self.bytes_at_lowest[camera_id]
        crf = LOWEST_CRF
        if job.budget is not None:
            wanted = LOWEST_CRF + 6 * np.log2(most / job.budget.target_bytes)
            crf = min(51.0, max(LOWEST_CRF, wanted))
        strays = self.random.uniform(-self.spread, self.spread)
        size_bytes = int(most * 2 ** ((LOWEST_CRF - crf) / 6 + strays))
        sequence, payload = self.sequences[camera_id], bytes(size_bytes)
        packet = DeltaPacket(job.epoch, sequence, b"rr", b"", b"digest", payload)
        self.sequences[camera_id] += 1
        coding_s = self.slow_s.get(sequence, self.coding_s)
        return EncodedFrame(packet, {"encode": coding_s}, Pose.identity(), crf=crf)


@dataclass
class Download:
    """A field that a vehicle reads chunk by chunk; a window more than it has read is under way."""

    left_bytes: int
    pace: FetchPace
    delay_s: float
    """Time that the news of what was read takes to the server."""
    read: list[tuple[float, int]] = field(default_factory=list)
    """When chunks were read, and their sizes."""
    ended_s: float | None = None
    asked_s: float = 0.0
    arrivals_s: deque[float] = field(default_factory=deque)

    def begin(self, downlink: Link[object]) -> float | None:
        """Send the first window from second 0 on; return when the first chunk is read."""
        for _ in range(IN_FLIGHT_BYTES // CHUNK_BYTES):
            self._send(downlink, 0.0)
        return self._read_at(0.0)

    def step(self, downlink: Link[object], now: float) -> float | None:
        """Read a chunk; return when the next one is, None at the end."""
        self.read.append((now, CHUNK_BYTES))
        self._send(downlink, now + self.delay_s)
        due_s = self.pace.received(CHUNK_BYTES, now - self.asked_s, now)
        if not self.arrivals_s:
            self.ended_s = now
        return self._read_at(due_s)

    def _send(self, downlink: Link[object], now: float) -> None:
        if self.left_bytes > 0:
            self.left_bytes -= CHUNK_BYTES
            self.arrivals_s.append(downlink.push(self, CHUNK_BYTES, now).due_s)

    def _read_at(self, asked_s: float) -> float | None:
        self.asked_s = asked_s
        return max(asked_s, self.arrivals_s.popleft()) if self.arrivals_s else None


@dataclass
class World:
    """A session, a coder and an uplink, and a server that answers after ``answering_s``.

    That is a time, or two between which it is drawn; the latter is said in the Ack, with the wait
    for the frames before. Answers come
    by ``downlink``, if there is one, and so does a field. ``taken_s`` returns how long an answer
    then waits for the vehicle's processor. ``slow_s``: what the server takes longer for frames, by
    sequence number.
    """

    session: AgentSession
    uplink: Link[FrameAddress]
    code: ModelCoder
    answering_s: float | tuple[float, float]
    downlink: Link[object] | None = None
    download: Download | None = None
    taken_s: Callable[[], float] = lambda: 0.0
    slow_s: dict[int, float] = field(default_factory=dict)
    answered_s: float = 0.0
    taken_at_s: float = 0.0

    def drive(
        self, instants: Sequence[tuple[Capture, ...]], begun: Callable[[], None] = lambda: None
    ) -> list[FrameResult]:
        """Return what became of the pictures, in the order of their ends.

        ``begun`` is called at the first.
        """
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
        if self.download is not None and self.downlink is not None:
            at_s = self.download.begin(self.downlink)
            if at_s is not None:
                heapq.heappush(events, (at_s, next(order), self.download))
        while events:
            now, _, event = heapq.heappop(events)
            match event:
                case tuple():
                    begun()
                    self.session.offer(*event)
                case Download():
                    assert self.downlink is not None
                    at_s = event.step(self.downlink, now)
                    if at_s is not None:
                        heapq.heappush(events, (at_s, next(order), event))
                    continue
                case Answer():
                    assert self.downlink is not None
                    at_s = self.downlink.push(event, ANSWER_BYTES, now).due_s
                    for answer in event.messages:
                        heapq.heappush(events, (at_s, next(order), answer))
                    continue
                case EncodedFrame():
                    self.session.encoded(event, now)
                case Ack() | Credit():
                    self.session.receive(event, now)
            job = self.session.job_to_start(now)
            if job is not None:
                encoded = self.code(job)
                heapq.heappush(events, (now + encoded.sender_s, next(order), encoded))
            for at_s, answer in self._send(now):
                heapq.heappush(events, (at_s, next(order), answer))
            ended += self.session.take_results()
        return ended

    def _send(self, now: float) -> list[tuple[float, Ack | Credit | Answer]]:
        answers: list[tuple[float, Ack | Credit | Answer]] = []
        for outgoing in self.session.messages_to_send(now):
            frame = outgoing.message
            assert isinstance(frame, Frame)
            address, packet = frame.address, frame.packet
            size_bytes = len(packet.payload) + HEADER_BYTES
            arrived_s, times = self.uplink.push(address, size_bytes, now).due_s, StageTimes()
            if isinstance(self.answering_s, tuple):
                begun_s = max(self.answered_s, arrived_s)
                took_s = self.code.random.uniform(*self.answering_s)
                took_s += self.slow_s.get(address.sequence, 0.0)
                at_s = self.answered_s = begun_s + took_s
                times = StageTimes(total_ns=round(1e9 * (at_s - arrived_s)))
            else:
                at_s = arrived_s + self.answering_s
            at_s = self.taken_at_s = max(self.taken_at_s, at_s + self.taken_s())
            ack = Ack(address, times, packet.reconstruction_digest)
            credit = Credit(address.camera_id, address.sequence + 3)
            if self.downlink is None:
                answers += [(at_s, ack), (at_s, credit)]
            else:
                answers.append((at_s, Answer((ack, credit))))
        return answers
