"""Readers of bytes that others wrote: each gets any bytes and may raise ``RfedgeError``, no other.

``TARGETS`` maps a target's name to a function of bytes. Where a digest or a checksum would refuse
everything a fuzzer makes, it is repaired first, so that what lies behind it is reached.
"""

import gzip
import hashlib
import io
import json
import math
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

from mec_server.session import OpenJob, ServerSession
from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import parse_slice_start, split_nals
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import DecoderState
from rfcore.dataset.read import read_transforms_source
from rfcore.errors import (
    FieldFormatError,
    InvalidInput,
    PacketRejected,
    RejectReason,
    RfedgeError,
)
from rfcore.field import render_field_view
from rfcore.field.archive import ALIGN_BYTES, PREFIX, decode_archive
from rfcore.field.gltf import read_open_gltf
from rfcore.field.splat_ply import read_open_ply
from rfcore.field.spz import read_open_spz
from rfcore.field.store import decode_field
from rfcore.views import FieldView
from rfcore.wire import head
from rfcore.wire.convert import client_message_from_bytes, hello_to_bytes
from rfcore.wire.convert_answers import AnswerReader
from rfcore.wire.drive_file import read_drive
from rfcore.wire.head import FrameReader, FrameRefused
from rfcore.wire.messages import Hello
from rfcore.wire.tile_manifest import MANIFEST, read_publication

FEW_BYTES = 1 << 24
"""Memory that a field of a fuzzer may take."""
FOLDER = Path(tempfile.mkdtemp())
CORPUS = Path(__file__).parent / "corpus"


def message(data: bytes) -> None:
    """A message of a vehicle, then of a server: what is read is written back as it was."""
    with suppress(RfedgeError):
        read = client_message_from_bytes(data)
        if isinstance(read, Hello):
            assert repr(client_message_from_bytes(hello_to_bytes(read))) == repr(read)
    with suppress(RfedgeError):
        AnswerReader(["front", "rear"]).messages(data)


def session(data: bytes) -> None:
    """A conversation with the server, message after message (two bytes of length each)."""
    machine, reader = ServerSession("session", ["ab" * 32], 0.0), FrameReader(hello_and_frames()[0])
    for now, part in enumerate(_parts(data)):
        if machine.closed is not None:
            return
        try:
            read = client_message_from_bytes(part)
            if isinstance(read, Hello):
                reader = FrameReader(read)
            machine.receive(read if isinstance(read, Hello) else reader.read(read), float(now))
        except (InvalidInput, FrameRefused) as error:
            machine.refuse(error, float(now))
        for ahead in machine.poses_to_prepare():
            machine.prepared(ahead)
        for job in machine.jobs_to_start(float(now)):
            if isinstance(job, OpenJob):
                machine.opened(job, float(now))
            else:
                machine.rejected(job, DAMAGED, float(now))
        machine.messages_to_send(float(now))


DAMAGED = PacketRejected(RejectReason.DECODER_FAILED, "no decoder here")


def _parts(data: bytes) -> Iterator[bytes]:
    while len(data) > 2:
        (length,) = struct.unpack_from("<H", data)
        yield data[2 : 2 + length]
        data = data[2 + length :]


def bitstream(data: bytes) -> None:
    """NAL units, the start of a slice."""
    with suppress(RfedgeError):
        for nal in split_nals(data):
            with suppress(RfedgeError):
                parse_slice_start(nal)


@dataclass(frozen=True)
class Receiver:
    """A decoder that has decoded the first frame of the corpus, and the second frame."""

    hello: Hello
    first: bytes
    decoder: DeltaDecoder
    state: DecoderState
    view: FieldView
    next_packet: DeltaPacket

    def takes(self, packet: DeltaPacket) -> None:
        """Decode a packet to the picture it promises, or refuse it."""
        with suppress(PacketRejected):
            decoded = self.decoder.decode(self.state, packet, self.view)
            assert decoded.frame.digest().startswith(packet.reconstruction_digest)


@cache
def receiver() -> Receiver:
    """Return one, with the view of the field that the corpus was coded against."""
    hello, *data = hello_and_frames()
    reader = FrameReader(hello)
    first, second = map(reader.frame, data)
    field = decode_field((CORPUS / "archive" / "raw").read_bytes())
    (camera,) = hello.cameras
    view = render_field_view(field, Camera(camera.intrinsics, first.pose).rounded())
    decoder = DeltaDecoder(camera.codec)
    state = decoder.decode(decoder.start(first.packet.epoch), first.packet, view).state
    decoder.decode(state, second.packet, view)
    return Receiver(hello, data[0], decoder, state, view, second.packet)


def hello_and_frames() -> tuple[Hello, bytes, bytes]:
    """Return what the corpus begins with."""
    hello, first, second = (
        client_message_from_bytes((CORPUS / "message" / name).read_bytes())
        for name in ("hello", "frame-0", "frame-1")
    )
    assert isinstance(hello, Hello)
    return hello, first.data, second.data


def packet(data: bytes) -> None:
    """A frame of a vehicle for a decoder that waits for it, as if its check were right."""
    one = receiver()
    reader = FrameReader(one.hello)
    reader.frame(one.first)
    with suppress(RfedgeError), mock.patch.object(head, "_check", return_value=mock.ANY):
        one.takes(reader.frame(data).packet)


def slices(data: bytes) -> None:
    """The slice of such a frame."""
    one = receiver()
    one.takes(replace(one.next_packet, payload=data))


def archive(data: bytes) -> None:
    """A field file as it is, then with its digests made right."""
    with suppress(FieldFormatError):
        decode_archive(data)
    with suppress(FieldFormatError):
        decode_field(repaired(data), max_bytes=FEW_BYTES)


def repaired(data: bytes) -> bytes:
    """Return an archive of JSON and, after a zero byte, the arrays' bytes; all digests hold."""
    text, _, blobs = data.partition(b"\0")
    try:
        header = json.loads(text)
        for entry in header["arrays"]:
            start, size = entry["offset"], math.prod(entry["shape"]) * int(entry["dtype"][2])
            entry["sha256"] = hashlib.sha256(blobs[start : start + size]).hexdigest()
        blobs += bytes(-len(blobs) % ALIGN_BYTES)
        header["data_bytes"] = len(blobs)
        text = json.dumps(header).encode()
    except (ValueError, TypeError, KeyError, IndexError, RecursionError, OverflowError):
        pass  # as it is, then
    prefix = PREFIX.pack(b"RFFIELD\0", 1, len(text), hashlib.sha256(text).digest())
    return prefix + text + bytes(-(len(prefix) + len(text)) % ALIGN_BYTES) + blobs


def ply(data: bytes) -> None:
    """Splats of other programs."""
    with suppress(FieldFormatError):
        read_open_ply(Path("fuzz.ply"), io.BytesIO(data), FEW_BYTES)


def spz(data: bytes) -> None:
    """Splats of other programs, compressed; as they are, then what gzip would hold."""
    for one in (data, gzip.compress(data, 0)):
        with suppress(FieldFormatError):
            read_open_spz(Path("fuzz.spz"), io.BytesIO(one), FEW_BYTES)


def gltf(data: bytes) -> None:
    """Splats of other programs, as glTF: a .glb, or JSON."""
    with suppress(FieldFormatError):
        read_open_gltf(Path("fuzz.gltf"), io.BytesIO(data), FEW_BYTES)


def tiles(data: bytes) -> None:
    """The manifest of a folder of fields."""
    _as_file(MANIFEST, data, lambda path: read_publication(path.parent))


def transforms(data: bytes) -> None:
    """Posed pictures by nerfstudio's transforms.json."""
    _as_file("transforms.json", data, read_transforms_source)


def drive(data: bytes) -> None:
    """A coded drive."""
    _as_file("drive.rfv", data, read_drive)


def _as_file(name: str, data: bytes, read: Callable[[Path], Any]) -> None:
    (FOLDER / name).write_bytes(data)
    with suppress(RfedgeError):
        read(FOLDER / name)


TARGETS: dict[str, Callable[[bytes], None]] = {
    "message": message,
    "session": session,
    "bitstream": bitstream,
    "packet": packet,
    "slices": slices,
    "archive": archive,
    "ply": ply,
    "spz": spz,
    "gltf": gltf,
    "tiles": tiles,
    "transforms": transforms,
    "drive": drive,
}
