"""One camera of one session: frames in order, one being decoded, and who was promised what.

Sans-IO bookkeeping. Frames enter with ``admit``, leave to the decoder with ``start`` and end in
``succeed`` or ``fail``; each ends in exactly one answer. The epoch and the next expected sequence
move only when a frame was reconstructed, so that a damaged frame cannot move them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from rfcore.errors import PacketRejected, RejectReason
from rfcore.wire.messages import CameraDescription, Frame

__all__ = ["MAX_EPOCH_STEP", "MAX_GAP", "CameraQueue", "Gap", "Waiting"]

MAX_GAP = 64
"""Sequences that may be missing at once; credits keep an honest sender far below it."""

MAX_EPOCH_STEP = 1 << 16
"""How far an epoch may lead the last one; a flipped high bit shall not carry the lane off."""


@dataclass(frozen=True)
class Waiting:
    """A frame and when it arrived."""

    frame: Frame
    received_s: float


@dataclass(frozen=True)
class Gap:
    """``count`` consecutive sequences, from ``first`` on, that never arrived."""

    first: int
    count: int


class CameraQueue:
    """The state of one camera. ``window`` frames may be unanswered at a time."""

    def __init__(self, camera: CameraDescription, window: int) -> None:
        self.camera = camera
        self.epoch: int | None = None
        self.last_good: int | None = None
        self.answered = 0
        self._window = window
        self._queue: deque[Waiting] = deque()
        self._running: Waiting | None = None
        self._refused: set[tuple[int, int]] = set()

    @property
    def granted(self) -> int:
        """How many frames the vehicle may have sent in all."""
        return self.answered + self._window

    @property
    def outstanding(self) -> int:
        """Frames admitted and not yet answered."""
        return len(self._queue) + (self._running is not None)

    def admit(self, frame: Frame, now: float) -> None:
        """Take ``frame`` in; raise ``PacketRejected`` (OVERLOADED) beyond the window."""
        if self.outstanding >= self._window:
            raise PacketRejected(
                RejectReason.OVERLOADED,
                f"{self.outstanding} frames are waiting, {self._window} may; wait for Credit",
            )
        self._queue.append(Waiting(frame, now))

    def start(self) -> Waiting | None:
        """Return the next frame to decode, or None while one is running or none waits."""
        if self._running is not None or not self._queue:
            return None
        self._running = self._queue.popleft()
        return self._running

    def check_order(self, frame: Frame) -> None:
        """Raise ``PacketRejected`` if the frame cannot follow what was reconstructed last."""
        epoch, sequence = frame.packet.epoch, frame.packet.sequence
        current = epoch if self.epoch is None else self.epoch
        if epoch < current:
            raise PacketRejected(
                RejectReason.STALE_EPOCH, f"epoch {epoch} is over, this is {current}"
            )
        if epoch > current + MAX_EPOCH_STEP:
            raise PacketRejected(
                RejectReason.INVALID_ARGUMENT,
                f"frame.epoch: {epoch} leads {current} by more than {MAX_EPOCH_STEP}",
            )
        missing = sequence - self._expected(epoch)
        if missing > MAX_GAP:
            raise PacketRejected(
                RejectReason.INVALID_ARGUMENT,
                f"frame.sequence: {sequence} skips {missing} frames, at most {MAX_GAP} can be lost",
            )

    def succeed(self, lost: int) -> list[Gap]:
        """The running frame was reconstructed; return the gaps nobody was told of yet."""
        packet = self._finish().packet
        before = range(packet.sequence - lost, packet.sequence)
        missing = [n for n in before if (packet.epoch, n) not in self._refused]
        self.epoch, self.last_good = packet.epoch, packet.sequence
        self._refused.clear()
        self.answered += 1 + len(missing)
        return _runs(missing)

    def fail(self) -> None:
        """The running frame did not become a picture."""
        packet = self._finish().packet
        self.refuse(packet.epoch, packet.sequence)

    def refuse(self, epoch: int, sequence: int) -> None:
        """A frame is answered with a Nack: it no longer counts as missing."""
        self.answered += 1
        if len(self._refused) < MAX_GAP:
            self._refused.add((epoch, sequence))

    def _expected(self, epoch: int) -> int:
        if epoch != self.epoch or self.last_good is None:
            return 0
        return self.last_good + 1

    def _finish(self) -> Frame:
        if self._running is None:
            raise AssertionError("an answer without a running frame")
        frame, self._running = self._running.frame, None
        return frame


def _runs(sequences: list[int]) -> list[Gap]:
    """Return ascending numbers as runs of consecutive ones."""
    runs: list[Gap] = []
    for sequence in sequences:
        if runs and sequence == runs[-1].first + runs[-1].count:
            runs[-1] = Gap(runs[-1].first, runs[-1].count + 1)
        else:
            runs.append(Gap(sequence, 1))
    return runs
