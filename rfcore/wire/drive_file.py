"""A coded drive in a file, ``.rfv``: the messages a vehicle sends, without the server's answers.

Layout: 8 bytes of magic, then messages in protobuf's length-prefixed form: one ``StreamRequest``
with Hello, then one for every frame, each sent after the one of its camera before it
(``rfcore.wire.head``): a drive is read from its start. The magic holds a carriage return, a
control-Z and a line feed, so that a transfer that converts line ends is noticed at once (as in
PNG).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import BinaryIO, cast

from google.protobuf.message import DecodeError
from google.protobuf.proto import parse_length_prefixed, serialize_length_prefixed

from rfcore.errors import InvalidData
from rfcore.files import whole_file
from rfcore.wire.conventions import MAX_MESSAGE_BYTES
from rfcore.wire.convert import client_message_from_wire, hello_to_bytes
from rfcore.wire.head import FrameReader, FrameRefused, FrameWriter
from rfcore.wire.messages import Frame, Hello, PackedFrame
from rfcore.wire.v1 import edge_pb2 as pb

MAGIC = b"RFV1\r\n\x1a\n"


@dataclass(frozen=True)
class CodedDrive:
    """A whole coded drive; its frames are in the order of sending."""

    hello: Hello
    frames: tuple[Frame, ...]


def write_drive(path: Path, drive: CodedDrive) -> None:
    """Write ``drive``; the file appears whole or not at all. Raises ``OSError``."""
    with whole_file(path) as file:
        file.write(MAGIC)
        frames = FrameWriter(drive.hello).in_order(drive.frames)
        for message in chain((hello_to_bytes(drive.hello),), frames):
            request = pb.StreamRequest.FromString(message)
            serialize_length_prefixed(request, cast("BytesIO", file))


def is_coded_drive(path: Path) -> bool:
    """Return whether a file begins as a coded drive."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def read_drive(path: Path) -> CodedDrive:
    """Read and check a coded drive, as ``rfedge encode`` writes it.

    >>> from pathlib import Path
    >>> from rfedge.cli.codec import Encode
    >>> from rfcore.wire.drive_file import read_drive
    >>> Encode(
    ...     Path("samples/street/transforms_drive_empty.json"),
    ...     Path("samples/fields/street.rff"),
    ...     Path("street.rfv"),
    ... ).run()  # doctest: +ELLIPSIS
    street.rfv: 24 frames, ...
    >>> drive = read_drive(Path("street.rfv"))
    >>> len(drive.frames), [reference.name for reference in drive.frames[0].packet.references]
    (24, ['RENDER'])

    Raises ``InvalidData`` with the file's name and the message's number when the file is
    truncated, oversize or not a drive; ``OSError`` when it cannot be read at all.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InvalidData(f"{path}: not a coded drive (.rfv), the first bytes are wrong")
        messages = _messages(file, path)
        hello = next(messages, None)
        if not isinstance(hello, Hello):
            raise InvalidData(f"{path}: message 0 is not a Hello")
        reader, frames = FrameReader(hello), []
        for number, message in enumerate(messages, 1):
            if isinstance(message, Hello) or message.is_ahead:
                what = "second Hello" if isinstance(message, Hello) else "pose ahead"
                raise InvalidData(f"{path}: message {number} is a {what}")
            try:
                frames.append(reader.frame(message.data))
            except FrameRefused as error:
                raise InvalidData(f"{path}: message {number}: {error}") from error
    return CodedDrive(hello, tuple(frames))


class _BoundedReader:
    """A file that refuses a message's claimed length before memory is taken for it.

    Raises ``ValueError`` for a length above ``MAX_MESSAGE_BYTES``, and where the file ends within a
    message.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, size: int) -> bytes:
        """Return ``size`` bytes; the single first byte of a length may be missing at the end."""
        if size > MAX_MESSAGE_BYTES:
            raise ValueError(f"claims {size} bytes, the limit is {MAX_MESSAGE_BYTES}")
        data = self._file.read(size)
        if len(data) != size and size > 1:
            raise ValueError(f"truncated: it has {len(data)} of its {size} bytes")
        return data


def _messages(file: BinaryIO, path: Path) -> Iterator[Hello | PackedFrame]:
    reader, number = _BoundedReader(file), 0
    while True:
        try:
            request: pb.StreamRequest | None
            request = parse_length_prefixed(pb.StreamRequest, cast("BytesIO", reader))
            if request is None:
                return
            message = client_message_from_wire(request)
        except (ValueError, DecodeError) as error:  # InvalidInput is a ValueError
            raise InvalidData(f"{path}: message {number}: {error}") from error
        yield message
        number += 1
