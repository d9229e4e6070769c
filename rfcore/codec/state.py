"""What each end remembers between frames: nothing but numbers.

The reference of every packet is the render at its own pose, so a state holds no picture, any
packet can be decoded on its own, and losing one costs one frame.
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.errors import InvalidInput

__all__ = ["DecoderState", "EncoderState"]


@dataclass(frozen=True)
class EncoderState:
    """The sender's state: the ``sequence`` its next packet gets within ``epoch``."""

    epoch: int
    next_sequence: int = 0

    def __post_init__(self) -> None:
        _require_counts(self.epoch, self.next_sequence)


@dataclass(frozen=True)
class DecoderState:
    """The receiver's state: the lowest ``sequence`` of ``epoch`` it still accepts."""

    epoch: int
    next_sequence: int = 0

    def __post_init__(self) -> None:
        _require_counts(self.epoch, self.next_sequence)


def _require_counts(epoch: int, next_sequence: int) -> None:
    for name, value in (("epoch", epoch), ("next_sequence", next_sequence)):
        if not 0 <= value < 1 << 64:
            raise InvalidInput(f"state.{name}", f"{value} is outside 0..2**64 - 1")
