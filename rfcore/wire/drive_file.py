"""A coded drive in a file, ``.rfv``: what the vehicle said, without the conversation.

Layout: 8 bytes of magic, then messages, each preceded by its length as a protobuf varint: one
``StreamRequest`` with Hello, then one for every Frame. The magic holds a carriage return, a
control-Z and a line feed, so that a transfer that mangles text is noticed at once (as PNG does).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from rfcore.errors import InvalidData, InvalidInput
from rfcore.files import whole_file
from rfcore.wire.conventions import MAX_MESSAGE_BYTES
from rfcore.wire.convert import client_message_from_bytes, client_message_to_bytes
from rfcore.wire.messages import ClientMessage, Frame, Hello

__all__ = ["MAGIC", "CodedDrive", "read_drive", "write_drive"]

MAGIC = b"RFV1\r\n\x1a\n"
MAX_LENGTH_BYTES = 4
"""A varint of four bytes reaches 256 MiB, well past any message we accept."""


@dataclass(frozen=True)
class CodedDrive:
    """A whole coded drive: the frames are in the order of sending."""

    hello: Hello
    frames: tuple[Frame, ...]


def write_drive(path: Path, drive: CodedDrive) -> None:
    """Write ``drive``; the file appears whole or not at all. Raises ``OSError``."""
    with whole_file(path) as file:
        file.write(MAGIC)
        file.writelines(_records((drive.hello, *drive.frames)))


def read_drive(path: Path) -> CodedDrive:
    """Read and check a coded drive.

    Raises ``InvalidData`` with the file's name and the message's number when the file is
    truncated, oversize or not a drive; ``OSError`` when it cannot be read at all.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InvalidData(f"{path}: not a coded drive (.rfv), the first bytes are wrong")
        messages = list(_messages(file, path))
    if not messages or not isinstance(messages[0], Hello):
        raise InvalidData(f"{path}: message 0 is not a Hello")
    cameras = {camera.camera_id for camera in messages[0].cameras}
    frames: list[Frame] = []
    for number, message in enumerate(messages[1:], 1):
        if not isinstance(message, Frame):
            raise InvalidData(f"{path}: message {number} is a second Hello")
        if message.camera_id not in cameras:
            raise InvalidData(f"{path}: message {number} is of a camera that Hello does not name")
        frames.append(message)
    return CodedDrive(messages[0], tuple(frames))


def _records(messages: Iterable[ClientMessage]) -> Iterator[bytes]:
    for message in messages:
        data = client_message_to_bytes(message)
        yield _varint(len(data)) + data


def _messages(file: BinaryIO, path: Path) -> Iterator[ClientMessage]:
    number = 0
    while (length := _read_varint(file, path, number)) is not None:
        if length > MAX_MESSAGE_BYTES:
            raise InvalidData(
                f"{path}: message {number} claims {length} bytes, the limit is {MAX_MESSAGE_BYTES}"
            )
        data = file.read(length)
        if len(data) != length:
            raise InvalidData(
                f"{path}: truncated, message {number} has {len(data)} of its {length} bytes"
            )
        try:
            yield client_message_from_bytes(data)
        except InvalidInput as error:
            raise InvalidData(f"{path}: message {number}: {error}") from error
        number += 1


def _varint(value: int) -> bytes:
    """Return the base-128 form, least significant group first, high bit = more to come."""
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    groups.append(value)
    return bytes(groups)


def _read_varint(file: BinaryIO, path: Path, number: int) -> int | None:
    """Return the next length, or None where the file ends between two messages."""
    value = 0
    for index in range(MAX_LENGTH_BYTES):
        byte = file.read(1)
        if not byte:
            if index == 0:
                return None
            raise InvalidData(f"{path}: truncated in the length of message {number}")
        value |= (byte[0] & 0x7F) << (7 * index)
        if byte[0] < 0x80:
            return value
    raise InvalidData(f"{path}: the length of message {number} is not a length")
