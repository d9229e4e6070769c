"""The cameras of one session: frames in order, at most one being decoded per camera, and credits.

Sans-IO bookkeeping. Frames enter with ``admit``, leave to the decoder with ``start`` and end in
``succeed``, ``fail`` or ``refuse``; each gets exactly one answer. The epoch and the next expected
sequence move only when a frame was reconstructed, so that a damaged frame cannot move them. The
order of frames is checked here, before any work is spent on them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from rfcore.codec.packet import check_order
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.wire.messages import (
    MAX_EPOCH_STEP,
    AnyPosed,
    CameraDescription,
    Credit,
    Frame,
    FrameAddress,
    Hello,
    PoseAhead,
)

MAX_GAP = 64
"""Sequences that may be missing at once; credits keep an honest sender far below it."""


@dataclass(frozen=True)
class WaitingFrame:
    """A frame and when it arrived."""

    frame: Frame
    received_s: float


@dataclass(frozen=True)
class SequenceGap:
    """``count`` consecutive sequences, from ``first`` on, that never arrived."""

    first: int
    count: int


class CameraQueue:
    """The frames of one camera. ``window`` frames may be unanswered at a time.

    The newest pose ahead of a frame waits beside them, until it is prepared or its frame is here.
    """

    def __init__(self, window: int) -> None:
        self.epoch: int | None = None
        self.last_good: int | None = None
        self.answered = 0
        self._window = window
        self._queue: deque[WaitingFrame] = deque()
        self._running: WaitingFrame | None = None
        self._ahead: PoseAhead | None = None
        self._is_preparing = False
        self._refused: set[tuple[int, int]] = set()

    @property
    def granted(self) -> int:
        """Number of frames that the vehicle may have sent in all."""
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
        self._queue.append(WaitingFrame(frame, now))
        self._ahead = None

    def expect(self, ahead: PoseAhead) -> None:
        """Take a pose ahead of its frame in, in place of the one before."""
        self._ahead = ahead

    def prepare(self) -> PoseAhead | None:
        """Return, once, the pose to prepare; None while there is a frame to decode.

        Raises ``PacketRejected`` for one whose frame could not follow what was reconstructed last.
        """
        if self._ahead is None or self.outstanding or self._is_preparing:
            return None
        ahead, self._ahead = self._ahead, None
        self.check(ahead)
        self._is_preparing = True
        return ahead

    def prepared(self) -> None:
        """Note that the work of ``prepare`` is done: the next frame may be decoded."""
        self._is_preparing = False

    def start(self) -> WaitingFrame | None:
        """Return the next frame to decode, or None while one is running or none waits."""
        if self._running is not None or self._is_preparing or not self._queue:
            return None
        self._running = self._queue.popleft()
        return self._running

    def check(self, numbered: Frame | PoseAhead) -> int:
        """Return how many frames are lost right before this one; raise ``PacketRejected`` if it
        cannot follow what was reconstructed last."""
        epoch, sequence = numbered.address.epoch, numbered.address.sequence
        current = epoch if self.epoch is None else self.epoch
        lost = check_order(epoch, sequence, current, self._expected(current))
        if epoch > current + MAX_EPOCH_STEP:
            raise PacketRejected(
                RejectReason.INVALID_ARGUMENT,
                f"frame.epoch: {epoch} leads {current} by more than {MAX_EPOCH_STEP}",
            )
        if lost > MAX_GAP:
            raise PacketRejected(
                RejectReason.INVALID_ARGUMENT,
                f"frame.sequence: {sequence} skips {lost} frames, at most {MAX_GAP} can be lost",
            )
        return lost

    def succeed(self) -> list[SequenceGap]:
        """Note that the running frame was reconstructed.

        Returns the sequences before it that never arrived and were not answered yet.
        """
        packet = self._finish().packet
        before = range(self._expected(packet.epoch), packet.sequence)
        missing = [n for n in before if (packet.epoch, n) not in self._refused]
        self.epoch, self.last_good = packet.epoch, packet.sequence
        done = (packet.epoch, packet.sequence)
        self._refused = {refused for refused in self._refused if refused > done}
        self.answered += 1 + len(missing)
        return _runs(missing)

    def fail(self) -> None:
        """Note that the running frame did not become a picture."""
        packet = self._finish().packet
        self.refuse(packet.epoch, packet.sequence)

    def refuse(self, epoch: int, sequence: int) -> None:
        """Note that a frame is answered with a Nack: it no longer counts as missing."""
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


class SessionCameras:
    """The queues of a session's cameras by id.

    Empty until ``open``; every method may be called before.
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._queues: dict[str, CameraQueue] = {}
        self._descriptions: dict[str, CameraDescription] = {}
        self._first_field_id = ""

    def open(self, hello: Hello) -> None:
        """Make a queue for each camera of ``hello``."""
        for camera in hello.cameras:
            self._queues[camera.camera_id] = CameraQueue(self._window)
            self._descriptions[camera.camera_id] = camera
        self._first_field_id = hello.field_ids[0]

    @property
    def are_busy(self) -> bool:
        """Whether a frame of any camera was taken and is not answered yet."""
        return any(queue.outstanding for queue in self._queues.values())

    def queue_of(self, frame: Frame | PoseAhead) -> CameraQueue:
        """Return the queue of a frame's camera; raise ``InvalidInput`` before ``open``."""
        if frame.camera_id not in self._queues:
            raise InvalidInput("frame", "came before Welcome; wait for that")
        return self._queues[frame.camera_id]

    def posed(self, frame: AnyPosed) -> AnyPosed:
        """Return the frame of a queue at the pose of its camera, which came as that of its rig."""
        return self._descriptions[frame.camera_id].posed(frame)

    def field_of(self, frame: Frame | PoseAhead) -> str:
        """Return the id of the field that the frame of a queue is predicted from."""
        return frame.field_id or self._first_field_id

    def refuse(self, address: FrameAddress) -> None:
        """Note that a message is answered with a Nack.

        If it cannot be told which camera it was of, each camera's credit grows by one: the vehicle
        spent a credit on the message, and no camera may run out of them.
        """
        queue = self._queues.get(address.camera_id)
        if queue is not None:
            queue.refuse(address.epoch, address.sequence)
            return
        for other in self._queues.values():
            other.answered += 1

    def started(self) -> Iterator[tuple[CameraQueue, WaitingFrame]]:
        """Take out, camera by camera, every frame that may be decoded now.

        A camera whose frame the caller answers at once, with ``fail``, yields its next one.
        """
        for queue in self._queues.values():
            while (waiting := queue.start()) is not None:
                yield queue, waiting

    def to_prepare(self) -> Iterator[PoseAhead]:
        """Take out, camera by camera, every pose that may be prepared now.

        One that its queue refuses is dropped: its frame, when it comes, is told why.
        """
        for queue in self._queues.values():
            with suppress(PacketRejected):
                if (ahead := queue.prepare()) is not None:
                    yield ahead

    def position(self, address: FrameAddress) -> tuple[int, int | None]:
        """Return the current epoch of a camera, and the last good sequence if it is of that of
        ``address``."""
        queue = self._queues.get(address.camera_id)
        if queue is None:
            return 0, None
        return queue.epoch or 0, queue.last_good if queue.epoch == address.epoch else None

    def credits(self, camera_ids: Iterable[str] | None = None) -> list[Credit]:
        """Return the credits of these cameras; of all without ``camera_ids``, or if one is ""."""
        wanted = None if camera_ids is None else set(camera_ids)
        everything = wanted is None or "" in wanted
        return [
            Credit(camera_id, queue.granted)
            for camera_id, queue in self._queues.items()
            if everything or (wanted is not None and camera_id in wanted)
        ]


def _runs(sequences: list[int]) -> list[SequenceGap]:
    """Return ascending numbers as runs of consecutive ones."""
    runs: list[SequenceGap] = []
    for sequence in sequences:
        if runs and sequence == runs[-1].first + runs[-1].count:
            runs[-1] = SequenceGap(runs[-1].first, runs[-1].count + 1)
        else:
            runs.append(SequenceGap(sequence, 1))
    return runs
