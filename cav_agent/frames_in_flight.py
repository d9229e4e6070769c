"""What a sender knows of the frames it has encoded: which are unanswered, which were decoded.

Parts of ``cav_agent.session``, without a clock: ``FramesInFlight`` holds the frames without an
answer and knows when one is overdue (``AnswerTimeout``); ``PredictionChain`` numbers epochs and
says which frame the next may be predicted from.

The kernel notices a silent partition once it has bytes that nobody acknowledges. A stopped server,
or a middlebox that forwards nothing, acknowledges everything and answers nothing; only a timeout
notices that. It adapts to the stream: ``STALL_S``, plus the time that the bytes in flight need at
``SLOWEST_BPS``, plus twice the longest of the last answers.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

from cav_agent.frames import FrameResult
from rfcore.errors import RejectReason
from rfcore.wire.messages import Ack, FrameAddress, Nack

__all__ = [
    "SLOWEST_BPS",
    "STALL_S",
    "AnswerTimeout",
    "FrameInFlight",
    "FramesInFlight",
    "PredictionChain",
]

STALL_S = 1.0
"""How long a server may pause beyond its usual time."""

SLOWEST_BPS = 0.3e6
"""A link that has collapsed to this rate still counts as one."""

REMEMBERED_ANSWERS = 8


class AnswerTimeout:
    """How long to wait for an answer: at most ``longest_s``, which is also what the first gets."""

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
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
            return self._longest_s
        link_s = 8 * bytes_in_flight / SLOWEST_BPS
        return min(self._longest_s, STALL_S + link_s + 2 * max(self._answers_s))


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

    def __init__(self, longest_answer_s: float) -> None:
        self._frames: dict[FrameAddress, FrameInFlight] = {}
        self._timeout = AnswerTimeout(longest_answer_s)

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
        """Take a frame that was encoded ``now``."""
        in_flight_bytes = sum(frame.result.packet_bytes for frame in self._frames.values())
        timeout_s = self._timeout.timeout_s(in_flight_bytes + result.packet_bytes)
        self._frames[address] = FrameInFlight(result, base, now, timeout_s)

    def __contains__(self, address: FrameAddress) -> bool:
        return address in self._frames

    def sent(self, address: FrameAddress, now: float) -> None:
        """Note that a frame was sent ``now``."""
        self._frames[address] = replace(self._frames[address], sent_s=now)

    def instant_of(self, address: FrameAddress) -> int:
        """Return which instant of a rig a frame belongs to; 0: it stands alone."""
        return self._frames[address].result.capture.instant

    def pop(self, address: FrameAddress) -> FrameInFlight:
        """Remove a frame."""
        return self._frames.pop(address)

    def acked(self, ack: Ack, now: float) -> FrameInFlight | None:
        """Fill in what ``ack`` says of its frame and return it; None if it is not in flight."""
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
    """Which epoch the next packet is numbered in, and which frame it is predicted from."""

    def __init__(self, first_epoch: int) -> None:
        self.epoch = first_epoch
        self.base: FrameAddress | None = None
        """The frame sent last; in a new epoch, the last one known to have been decoded."""
        self._decoded: FrameAddress | None = None
        self._epoch_used = False

    def started(self) -> None:
        """A packet of this epoch is being encoded."""
        self._epoch_used = True

    def sent(self, address: FrameAddress) -> None:
        """A frame was sent: the next is predicted from it."""
        self.base = address

    def decoded(self, address: FrameAddress) -> None:
        """The server has decoded a frame to the sender's own picture."""
        self._decoded = address

    def unknown_to_server(self, base: FrameAddress | None) -> None:
        """The server no longer has the frame ``base``."""
        if base == self._decoded:
            self._decoded = None

    def forget(self) -> None:
        """Another connection begins: its server has decoded nothing."""
        self._decoded = None

    def restart(self, above: int = -1) -> None:
        """Begin an epoch later than ``above``, unless the present one is and has no packet yet."""
        if self._epoch_used or self.epoch <= above:
            self.epoch = max(self.epoch, above) + 1
            self._epoch_used = False
        self.base = self._decoded
