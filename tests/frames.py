"""Messages of frames that stand alone, whole and damaged."""

from dataclasses import replace

from rfcore.camera import PoseLattice
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import Frame, Hello


def message_of(hello: Hello, frame: Frame) -> bytes:
    """Return the message of a frame that needs no other."""
    return FrameWriter(hello).message(frame, None)


def flipped(message: bytes, bit: int = 0) -> bytes:
    """Return the message with one bit flipped, counted from the end of the payload."""
    data = bytearray(message)
    data[len(data) - 1 - bit // 8] ^= 1 << bit % 8
    return bytes(data)


def far_away(hello: Hello, frame: Frame, x_m: float) -> bytes:
    """Return the message with its pose 500 times as far off as a pose may be at most."""
    _, y_m, z_m = frame.pose.translation_m
    fine = replace(hello, lattice=PoseLattice(1_000_000))
    pose = replace(frame.pose, translation_m=(x_m, y_m, z_m))
    return message_of(fine, replace(frame, pose=fine.lattice.pose(fine.lattice.steps(pose))))
