"""Pictures that wait for the encoder, and frames that wait for an answer.

These are parts of ``cav_agent.session``, without a clock.

``WaitingInstants`` holds pictures until they are encoded. Pictures of one instant belong together:
a newer instant takes the place of one that waits as a whole, and an instant that was begun is coded
to its end before another begins. An instant begins when every camera in it may send. A camera that
may not, while others may, is left out of the instants that follow until it may again, so what is
wrong with one camera costs the others one instant at most. A single camera is a rig of one.

``FramesInFlight`` holds the frames without an answer, and ``AnswerTimeout`` says when one is
overdue. The kernel notices a silent partition once it has bytes that nobody acknowledges. But a
stopped server, or a middlebox that forwards nothing, acknowledges everything and answers nothing;
only a timeout notices that. It adapts to the stream: ``AgentLimits.stall_s``, plus the time that
the bytes in flight need at ``SLOWEST_BPS``, plus twice the longest of the last answers.

``PredictionChain`` numbers epochs and says which frame the next may be predicted from.

``AheadSwitch`` says whether poses are sent ahead of their frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import StatisticsError, fmean, linear_regression

from cav_agent.config import AgentLimits
from cav_agent.frames import Capture, FrameResult
from rfcore.errors import RejectReason
from rfcore.wire.messages import Ack, FrameAddress, Nack

SLOWEST_BPS = 0.3e6
"""A link that has collapsed to this rate still counts as one."""

REMEMBERED_ANSWERS = 8


class WaitingInstants:
    """Keeps at most ``slots`` instants that have not begun.

    ``may_send``: returns whether a camera may send.
    """

    def __init__(self, slots: int, may_send: Callable[[str], bool]) -> None:
        self._slots, self._may_send = slots, may_send
        self._begun: deque[Capture] = deque()
        self._waiting: deque[tuple[Capture, ...]] = deque()
        self._left_out: set[str] = set()

    def __bool__(self) -> bool:
        return bool(self._begun or self._waiting)

    @property
    def waiting_since_s(self) -> float | None:
        """Return when the oldest instant that has not begun was captured."""
        return min(c.captured_s for c in self._waiting[0]) if self._waiting else None

    @property
    def is_begun(self) -> bool:
        """Return whether pictures of an instant that was begun are left."""
        return bool(self._begun)

    def offer(self, captures: tuple[Capture, ...]) -> list[Capture]:
        """Take the pictures of an instant; return those that it supersedes."""
        superseded: list[Capture] = []
        if self._begun and not any(self._may_send(c.camera_id) for c in self._begun):
            superseded += self._drop_begun()
        if len(self._waiting) >= self._slots:
            late = self._waiting.popleft()
            may = {capture.camera_id: self._may_send(capture.camera_id) for capture in late}
            if any(may.values()):
                self._left_out |= {camera_id for camera_id in may if not may[camera_id]}
            superseded += late
        self._waiting.append(captures)
        return superseded

    def startable(self) -> tuple[Capture, ...]:
        """Return the pictures of the next instant that may begin; empty while none may."""
        self._left_out = {c for c in self._left_out if not self._may_send(c)}
        if self._begun or not self._waiting:
            return ()
        captures = self._waiting[0]
        ready = tuple(c for c in captures if self._may_send(c.camera_id))
        waited_for = {c.camera_id for c in captures} - {c.camera_id for c in ready}
        return () if waited_for - self._left_out else ready

    def begin(self) -> list[Capture]:
        """Begin the instant of ``startable``; return its pictures that are left out."""
        ready = self.startable()
        captures = self._waiting.popleft()
        self._begun.extend(ready)
        begun = {capture.camera_id for capture in ready}
        return [capture for capture in captures if capture.camera_id not in begun]

    def next(self) -> Capture | None:
        """Return, once, the next picture of the instant that was begun, if one may be sent."""
        for place, capture in enumerate(self._begun):
            if self._may_send(capture.camera_id):
                del self._begun[place]
                return capture
        return None

    def drop_oldest(self) -> list[Capture]:
        """Remove the oldest instant that has not begun; return its pictures."""
        return list(self._waiting.popleft())

    def clear(self) -> list[Capture]:
        """Remove everything; return the pictures."""
        dropped = self._drop_begun()
        while self._waiting:
            dropped += self._waiting.popleft()
        return dropped

    def _drop_begun(self) -> list[Capture]:
        dropped = list(self._begun)
        self._begun.clear()
        return dropped


class AnswerTimeout:
    """Limits the wait for an answer: to ``limits.answer_s`` at most, as for the first one."""

    def __init__(self, limits: AgentLimits) -> None:
        self._limits = limits
        self._answers_s: deque[float] = deque(maxlen=REMEMBERED_ANSWERS)

    def reset(self) -> None:
        """Forget the answers of an earlier stream."""
        self._answers_s.clear()

    def answered(self, within_s: float) -> None:
        """Note how long an answer took."""
        self._answers_s.append(within_s)

    def timeout_s(self, bytes_in_flight: int) -> float:
        """Return how long the answer to the newest of ``bytes_in_flight`` may take."""
        if not self._answers_s:
            return self._limits.answer_s
        link_s = 8 * bytes_in_flight / SLOWEST_BPS
        usual_s = link_s + 2 * max(self._answers_s)
        return min(self._limits.answer_s, self._limits.stall_s + usual_s)


@dataclass(frozen=True)
class FrameInFlight:
    """An encoded frame without an answer; ``base`` is the frame it was predicted from."""

    result: FrameResult
    base: FrameAddress | None
    encoded_s: float
    timeout_s: float
    sent_s: float | None = None


class FramesInFlight:
    """The unanswered frames of one session, by address."""

    def __init__(self, limits: AgentLimits) -> None:
        self._frames: dict[FrameAddress, FrameInFlight] = {}
        self._timeout = AnswerTimeout(limits)

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def addresses(self) -> list[FrameAddress]:
        """Every frame without an answer, oldest first."""
        return list(self._frames)

    def stream_opened(self) -> None:
        """Forget how quick the server of an earlier stream was."""
        self._timeout.reset()

    def add(
        self, address: FrameAddress, result: FrameResult, base: FrameAddress | None, now: float
    ) -> None:
        """Add a frame that was encoded ``now``."""
        in_flight_bytes = sum(frame.result.packet_bytes for frame in self._frames.values())
        timeout_s = self._timeout.timeout_s(in_flight_bytes + result.packet_bytes)
        self._frames[address] = FrameInFlight(result, base, now, timeout_s)

    def __contains__(self, address: FrameAddress) -> bool:
        return address in self._frames

    def sent(self, address: FrameAddress, now: float) -> FrameResult:
        """Note that a frame was sent ``now``; return what is known of it so far."""
        frame = self._frames[address] = replace(self._frames[address], sent_s=now)
        return frame.result

    def pop(self, address: FrameAddress) -> FrameInFlight:
        """Remove a frame."""
        return self._frames.pop(address)

    def acked(self, ack: Ack, now: float) -> FrameInFlight | None:
        """Complete the frame of ``ack`` and return it; None if it is not in flight."""
        frame = self._frames.get(ack.address)
        if frame is None:
            return None
        self._timeout.answered(now - frame.encoded_s)
        since_s = frame.encoded_s if frame.sent_s is None else frame.sent_s
        link_s = max(0.0, now - since_s - ack.times.total_ns / 1e9)
        result = replace(
            frame.result,
            server=ack.times,
            server_digest=ack.reconstruction_digest,
            link_s=link_s,
        )
        self._frames[ack.address] = frame = replace(frame, result=result)
        return frame

    def refused_by(self, nack: Nack) -> list[tuple[FrameAddress, FrameInFlight]]:
        """Return the frames in flight that ``nack`` is about."""
        return [(a, frame) for a, frame in self._frames.items() if _covers(nack, a)]

    def timeout_at(self) -> float | None:
        """Return when the first answer is overdue; None without frames."""
        due = (frame.encoded_s + frame.timeout_s for frame in self._frames.values())
        return min(due, default=None)

    def longest_wait_s(self, now: float) -> float:
        """Return how long the oldest frame has been waiting for its answer."""
        return now - min((frame.encoded_s for frame in self._frames.values()), default=now)


def _covers(nack: Nack, address: FrameAddress) -> bool:
    first = nack.address
    if first.camera_id == "" and nack.reason is RejectReason.INVALID_ARGUMENT:
        return True  # unreadable for the server: any frame in flight may be the one
    same = (address.camera_id, address.epoch) == (first.camera_id, first.epoch)
    return same and first.sequence <= address.sequence < first.sequence + nack.count


class PredictionChain:
    """Keeps the epoch of the next packet, and the frame that it is predicted from."""

    def __init__(self, first_epoch: int) -> None:
        self.epoch = first_epoch
        self.base: FrameAddress | None = None
        """The frame sent last; in a new epoch, the last one known to have been decoded."""
        self._decoded: FrameAddress | None = None
        self._epoch_used = False

    def started(self) -> None:
        """Note that a packet of this epoch is being encoded."""
        self._epoch_used = True

    def sent(self, address: FrameAddress) -> None:
        """Note that a frame was sent: the next is predicted from it."""
        self.base = address

    def decoded(self, address: FrameAddress) -> None:
        """Note that the server has decoded a frame to the sender's own picture."""
        self._decoded = address

    def unknown_to_server(self, base: FrameAddress | None) -> None:
        """Note that the server no longer has the frame ``base``."""
        if base == self._decoded:
            self._decoded = None

    def forget(self) -> None:
        """Forget what was decoded: another connection begins."""
        self._decoded = None

    def restart(self, above: int = -1) -> None:
        """Begin an epoch later than ``above``, unless the present one is and has no packet yet."""
        if self._epoch_used or self.epoch <= above:
            self.epoch = max(self.epoch, above) + 1
            self._epoch_used = False
        self.base = self._decoded

    def refused(self, nack: Nack) -> None:
        """Begin an epoch, unless the refusal follows from a loss that began one already."""
        if nack.address.epoch < self.epoch and nack.current_epoch <= self.epoch:
            return
        self.restart(nack.current_epoch)


@dataclass
class SendingCamera:
    """One camera's prediction chain, and how many frames it may send."""

    chain: PredictionChain
    granted: int = 0
    used: int = 0

    @property
    def may_send(self) -> bool:
        """Return whether the server's credit allows another frame."""
        return self.used < self.granted


AHEAD_FRAMING_BYTES = 80
"""gRPC, HTTP/2, TLS, TCP and IP around a pose ahead, which is a packet of its own."""

AHEAD_ANSWERS = 4
"""Answers before it is judged whether poses ahead pay."""

AHEAD_TRY_EVERY = 32
"""So often a pose is sent ahead of its frame although that did not pay lately."""


class AheadSwitch:
    """Sends poses ahead of their frames as long as that shows pictures sooner.

    What an answer says was done before its frame came, less what the frame waited for it, is won. A
    server that is full does nothing ahead. Lost is the time that the pose's bytes take on the link,
    by how much longer answers to larger frames take.
    """

    def __init__(self, is_wanted: bool) -> None:
        self._is_wanted = is_wanted
        self._skipped = 0
        self._links: deque[tuple[int, float]] = deque(maxlen=2 * REMEMBERED_ANSWERS)
        """Bytes and link time of the last answered frames."""
        self._won_s: deque[float] = deque(maxlen=REMEMBERED_ANSWERS)
        """Time won by the last frames with a pose ahead."""

    def next(self) -> bool:
        """Return whether to send the next pose ahead of its frame."""
        if not self._is_wanted:
            return False
        self._skipped += 1
        is_new = len(self._won_s) < AHEAD_ANSWERS
        is_tried = is_new or fmean(self._won_s) > 0 or self._skipped >= AHEAD_TRY_EVERY
        if is_tried:
            self._skipped = 0
        return is_tried

    def answered(self, result: FrameResult) -> None:
        """Learn from a frame that was acknowledged."""
        if result.server is None or result.link_s is None:
            return
        self._links.append((result.packet_bytes, result.link_s))
        if result.ahead_bytes:
            won_ns = max(0, result.server.ahead_ns - result.server.queue_ns)
            lost_s = self._s_per_byte() * (result.ahead_bytes + AHEAD_FRAMING_BYTES)
            self._won_s.append(won_ns / 1e9 - lost_s)

    def failed(self) -> None:
        """Note that a frame with a pose ahead was refused: the next ones go without."""
        self._won_s.clear()
        self._won_s.extend([0.0] * AHEAD_ANSWERS)

    def _s_per_byte(self) -> float:
        """Return by how much a byte more delays an answer."""
        try:
            return max(0.0, linear_regression(*zip(*self._links, strict=True)).slope)
        except StatisticsError:  # fewer than two sizes
            return 0.0
