"""Prediction of a frame's head from an earlier frame of its camera, its anchor.

Both ends keep the last ``KEPT_HEADS`` frames of a camera that were sent, or that arrived intact.
With t1, p1 of the anchor and t0, p0 of the anchor's own anchor, the time is predicted to be t1 +
(t1 - t0), or t1 and a period of the camera's stated rate where there is no t0; the pose to be p1 +
(p1 - p0) (t - t1) / (t1 - t0), of quaternions brought to one length. All of it is integer
arithmetic, so that both ends predict the same on every machine. Where p0 is missing, or the times
make no sense, p1 itself is predicted; without p1, zero. Poses are numbers of
``rfcore.camera.PoseLattice``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

from rfcore.camera import PoseSteps
from rfcore.field.quality import FULL, Quality
from rfcore.wire.messages import Hello, PoseAhead
from rfcore.wire.values import clock_to_wire, localisation_to_wire

KEPT_HEADS = 16
"""Frames of a camera that later ones may name: more than are in flight and kept as pictures."""

_UNIT = 1 << 30
"""Length of the quaternions that poses are predicted from."""
_FASTEST = 4
"""A step of time so many times the one before says nothing about the pose any more."""


@dataclass(frozen=True, slots=True)
class Head:
    """Parts of a head that later frames take from one that they name."""

    epoch: int
    sequence: int
    time_us: int
    pose: PoseSteps | None
    field: int
    quality: Quality
    instant: int
    sensing: int
    before: tuple[int, PoseSteps | None] | None
    """Time and pose of its own anchor."""
    digest: bytes = b""
    """The first bytes of the picture's; empty until the frame was coded."""

    def ends_in(self, epoch_bits: int, sequence_bits: int) -> bool:
        """Return whether the address has these lowest bits."""
        return self.epoch & 15 == epoch_bits and self.sequence & 255 == sequence_bits


class KeptHeads:
    """The last frames of one camera, the newest last."""

    def __init__(self) -> None:
        self._by_address: dict[tuple[int, int], Head] = {}

    def add(self, head: Head) -> None:
        self._by_address.pop((head.epoch, head.sequence), None)
        self._by_address[head.epoch, head.sequence] = head
        while len(self._by_address) > KEPT_HEADS:
            del self._by_address[next(iter(self._by_address))]

    def at(self, epoch: int, sequence: int) -> Head | None:
        return self._by_address.get((epoch, sequence))

    def ending_in(self, epoch_bits: int, sequence_bits: int) -> Head | None:
        """Return the newest frame whose address has these lowest bits."""
        for head in reversed(self._by_address.values()):
            if head.ends_in(epoch_bits, sequence_bits):
                return head
        return None

    def nearest(self, epoch_bits: int, sequence_bits: int) -> tuple[int, int]:
        """Return the address with these lowest bits that follows the newest frame."""
        newest = next(reversed(self._by_address.values()), None)
        epoch, sequence = (0, 0) if newest is None else (newest.epoch, newest.sequence)
        later = epoch + (epoch_bits - epoch & 15)
        if later != epoch:
            return later, sequence_bits
        return epoch, sequence + (sequence_bits - sequence & 255)


def head_of(ahead: PoseAhead, steps: PoseSteps | None, field: int, anchor: Head | None) -> Head:
    """Return the head of a frame that is not coded yet."""
    return Head(
        epoch=ahead.epoch,
        sequence=ahead.sequence,
        time_us=ahead.capture_time_ns // 1000,
        pose=steps,
        field=field,
        quality=ahead.quality,
        instant=ahead.instant,
        sensing=clock_to_wire(ahead.clock) << 2 | localisation_to_wire(ahead.localisation),
        before=before_of(anchor),
    )


def before_of(anchor: Head | None) -> tuple[int, PoseSteps | None] | None:
    """Return ``Head.before`` of a frame after ``anchor``."""
    return None if anchor is None else (anchor.time_us, anchor.pose)


class Prediction:
    """Predicted head of a frame after ``anchor``."""

    def __init__(self, hello: Hello, camera: int, anchor: Head | None) -> None:
        self._anchor = anchor
        self._before = None if anchor is None else anchor.before
        self._rotation_steps = hello.lattice.rotation_steps
        self.field = 0 if anchor is None else anchor.field
        self.quality = FULL if anchor is None else anchor.quality
        self.sensing = 0 if anchor is None else anchor.sensing
        self.instant = anchor.instant + 1 if anchor is not None and anchor.instant else 0
        self.time_us = self._time_us(hello.cameras[camera].rate_hz)

    def _time_us(self, rate_hz: float) -> int:
        if self._anchor is None:
            return 0
        t1 = self._anchor.time_us
        if self._before is None:
            return t1 + (round(1e6 / rate_hz) if rate_hz else 0)
        return 2 * t1 - self._before[0]

    def metres(self, time_us: int) -> tuple[int, int, int]:
        """Return x, y, z in steps."""
        if self._anchor is None or self._anchor.pose is None:
            return 0, 0, 0
        x, y, z, *_ = self._moved(self._anchor.pose, self._p0, time_us)
        return x, y, z

    def rotation(self, time_us: int, largest: int) -> tuple[int, ...]:
        """Return the parts of the quaternion, where part ``largest`` is ``rotation_steps``."""
        if self._anchor is None or self._anchor.pose is None:
            return 0, 0, 0, 0
        q1 = _at_length(self._anchor.pose[3:])
        q0 = None if self._p0 is None else _at_length(self._p0[3:])
        if q0 is not None and sum(a * b for a, b in zip(q0, q1, strict=True)) < 0:
            q0 = tuple(-part for part in q0)
        parts = self._moved(q1, q0, time_us)
        whole = parts[largest]
        if not whole:
            return 0, 0, 0, 0
        steps = self._rotation_steps
        return tuple(max(-steps, min(_divided(part * steps, whole), steps)) for part in parts)

    @property
    def _p0(self) -> PoseSteps | None:
        return None if self._before is None else self._before[1]

    def _moved(
        self, now: tuple[int, ...], before: tuple[int, ...] | None, time_us: int
    ) -> tuple[int, ...]:
        if before is None or self._before is None or self._anchor is None:
            return now
        step_us = self._anchor.time_us - self._before[0]
        ahead_us = time_us - self._anchor.time_us
        if step_us <= 0 or not 0 <= ahead_us <= _FASTEST * step_us:
            return now
        return tuple(
            b + _divided((b - a) * ahead_us, step_us) for a, b in zip(before, now, strict=False)
        )


def _divided(value: int, by: int) -> int:
    """Return the whole number nearest to ``value / by``, a half rounded up."""
    return (2 * value + by) // (2 * by)


def _at_length(parts: tuple[int, ...]) -> tuple[int, ...]:
    length = isqrt(sum(part * part for part in parts) << 20)
    return tuple(_divided(part * _UNIT << 10, length) for part in parts)
