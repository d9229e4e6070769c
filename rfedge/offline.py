"""Encode and decode without a network: frame by frame, or a drive into a ``.rfv`` file and back.

``encode_frames`` and ``decode_frames`` code a clip in one process. Both are generators, so the
caller decides whether a frame is decoded before the next one is coded. A ``.rfv`` file holds the
messages that a vehicle would send, so its size is the size of the packets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import tee

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import DEFAULT_EFFORT, CodecConfig, LightChange
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.h264.splice import PictureDecoder
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice, without_field
from rfcore.codec.sender.rate import FrameCosts
from rfcore.dataset import Dataset
from rfcore.errors import CodecError, DatasetError, InvalidData, InvalidInput, PacketRejected
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView, PosedPicture
from rfcore.wire.drive_file import CodedDrive
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract
from rfcore.wire.values import MAX_PAYLOAD_BYTES

OFFLINE_VEHICLE = "offline"
CAMERA_ID = "front"
DEFAULT_CHOICE = FrameChoice()
Locate = Callable[[PosedPicture, I420], FieldView | None]
"""Finds a picture's pose; returns the field's view there, or None if the camera is lost."""
EPOCH = 1
"""A clip that is coded in one go has this one epoch."""


@dataclass(frozen=True)
class FrameInput:
    """A frame to code, with the field's view at its pose, and how to code it."""

    frame: I420
    view: FieldView
    choice: FrameChoice = DEFAULT_CHOICE
    costs: FrameCosts | None = None
    """Costs of the frame's blocks, if they are known already."""
    lost: bool = False
    """Whether its pose is unknown, so that it is coded without the field."""


@dataclass(frozen=True)
class Arrival:
    """A packet at the receiver, with the field's view at the packet's pose."""

    packet: DeltaPacket
    view: FieldView


@dataclass(frozen=True)
class CodedFrame:
    """A frame and its coded form."""

    given: FrameInput
    encoded: Encoded

    @property
    def arrival(self) -> Arrival:
        """The packet as a receiver with the same field gets it."""
        return Arrival(self.encoded.packet, self.given.view)


def encode_frames(encoder: DeltaEncoder, inputs: Iterable[FrameInput]) -> Iterator[CodedFrame]:
    """Code one frame after another, each from the state that the one before it left.

    An input is taken only when its frame is coded. Raises as ``DeltaEncoder.encode``.
    """
    state = encoder.start(EPOCH)
    for given in inputs:
        choice = without_field(given.choice, state) if given.lost else given.choice
        encoded = encoder.encode(state, given.frame, given.view, choice, given.costs)
        state = encoded.state
        yield CodedFrame(given, encoded)


def decode_frames(
    decoder: DeltaDecoder,
    arrivals: Iterable[Arrival | None],
    *,
    skip_rejected: bool = False,
) -> Iterator[I420 | None]:
    """Decode one packet after another; None stands for a packet that was lost, and yields None.

    Raises ``PacketRejected`` for a packet that the decoder refuses. With ``skip_rejected`` such a
    packet yields None and leaves the decoder's state as it was.
    """
    state = decoder.start()
    for arrival in arrivals:
        shown = None
        if arrival is not None:
            try:
                decoded = decoder.decode(state, arrival.packet, arrival.view)
                state, shown = decoded.state, decoded.frame
            except PacketRejected:
                if not skip_rejected:
                    raise
        yield shown


def decode_promised(
    decoder: DeltaDecoder, coded: Iterable[CodedFrame]
) -> Iterator[tuple[CodedFrame, I420]]:
    """Decode every coded frame; raise ``CodecError`` if one differs from the sender's own."""
    frames, sent = tee(coded)
    pictures = decode_frames(decoder, (frame.arrival for frame in sent))
    for index, (frame, picture) in enumerate(zip(frames, pictures, strict=True)):
        promised = frame.encoded.reconstruction
        if picture is None or picture.digest() != promised.digest():
            raise CodecError(f"frame {index} decodes to another picture than its sender's")
        yield frame, picture


@dataclass(frozen=True)
class CodingSettings:
    """Settings with which the P pictures of a drive are coded."""

    effort: str = DEFAULT_EFFORT
    crf: float = 23.0
    """Constant rate factor, 1..51."""
    qp_map: QpMap | None = None
    """Parts of the picture that are coded finer or coarser."""
    check_decode: bool = False
    """Decode each slice and compare it, as ``DeltaEncoder`` does."""
    light: LightChange = LightChange.AUTO
    """Whether the light of renders is changed where that saves bits; its name will do."""

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "light", LightChange(self.light))
        except ValueError as error:
            known = ", ".join(LightChange)
            raise InvalidInput("light", f"{self.light!r} is not one of {known}") from error


@dataclass(frozen=True)
class DecodedFrame:
    """A reconstruction and the sequence number it came with."""

    sequence: int
    frame: I420


def encode_drive(
    dataset: Dataset,
    field: RadianceField,
    settings: CodingSettings,
    locate: Locate | None = None,
    watch: Callable[[CodedFrame], None] = lambda _: None,
) -> CodedDrive:
    """Code every picture of a drive against the field's render at its pose.

    ``locate`` finds the poses; without it they are the dataset's. ``watch`` is called with each
    frame once it is coded. Raises ``DatasetError`` if the
    pictures are not all of one camera, ``CodecError`` for a picture whose slice is too long for a
    message at every CRF.

    Three pictures into packets, and back into the very pictures that the sender decoded::

        >>> from dataclasses import replace
        >>> from pathlib import Path
        >>> from rfcore.dataset import read_dataset
        >>> from rfcore.field import load_field
        >>> from rfedge.offline import CodingSettings, decode_drive, encode_drive
        >>> field = load_field(Path("samples/fields/street.rff"))
        >>> drive = read_dataset(Path("samples/street/transforms_drive_empty.json"))
        >>> drive = replace(drive, pictures=drive.pictures[:3])
        >>> coded = encode_drive(drive, field, CodingSettings(crf=26))
        >>> sum(len(frame.packet.payload) for frame in coded.frames) < 40_000
        True
        >>> for decoded, sent in zip(decode_drive(coded, field), coded.frames):
        ...     assert decoded.frame.digest().startswith(sent.packet.reconstruction_digest)
    """
    intrinsics = dataset.pictures[0].camera.intrinsics
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px, settings.effort, settings.crf)
    encoder = DeltaEncoder(config, check_decode=settings.check_decode)
    coded_frames = encode_frames(encoder, _inputs(dataset, field, settings, locate))
    frames = []
    for picture, coded in zip(dataset.pictures, coded_frames, strict=True):
        _require_fit(picture.name, coded.encoded)
        watch(coded)
        pose = None if coded.given.lost else coded.given.view.camera.world_from_cam
        frames.append(Frame(CAMERA_ID, picture.time_ns, pose, "", coded.encoded.packet))
    camera = CameraDescription(CAMERA_ID, intrinsics, encoder.header)
    hello = Hello(OFFLINE_VEHICLE, (camera,), (field.field_id,), RendererContract.of(field))
    return CodedDrive(hello, tuple(frames))


def _inputs(
    dataset: Dataset, field: RadianceField, settings: CodingSettings, locate: Locate | None
) -> Iterator[FrameInput]:
    """Read one picture after another and render the field at its pose."""
    intrinsics = dataset.pictures[0].camera.intrinsics
    photometric = () if settings.light is LightChange.OFF else None
    exact = RendererContract.of(field).exact
    choice = FrameChoice(
        references=None if exact else RENDER_ONLY,
        block_means=not exact,
        limit_bytes=MAX_PAYLOAD_BYTES,
        qp_map=settings.qp_map,
        photometric=photometric,
    )
    for picture in dataset.pictures:
        if picture.camera.intrinsics != intrinsics:
            raise DatasetError(f"{picture.name}: its camera differs from the first picture's")
        frame = i420_from_rgb(picture.read())
        if locate is None:
            yield FrameInput(frame, render_field_view(field, picture.camera.rounded()), choice)
        else:
            view = locate(picture, frame)
            shown = view or FieldView.nothing(intrinsics)
            yield FrameInput(frame, shown, choice, lost=view is None)


def _require_fit(name: str, encoded: Encoded) -> None:
    size_bytes = len(encoded.packet.payload)
    if size_bytes > MAX_PAYLOAD_BYTES:
        raise CodecError(
            f"{name}: {size_bytes} bytes of P slice at the highest CRF, the limit is "
            f"{MAX_PAYLOAD_BYTES}; scale the pictures down"
        )


def decode_drive(
    drive: CodedDrive,
    field: RadianceField,
    open_decoder: Callable[[tuple[int, int]], PictureDecoder] = H264Decoder,
) -> Iterator[DecodedFrame]:
    """Reconstruct every frame, in order, with a decoder that ``open_decoder`` makes.

    Raises ``InvalidData`` if the drive was coded against another field, ``PacketRejected`` at the
    first packet that fails a check. ``encode_drive`` has an example.
    """
    if field.field_id not in drive.hello.field_ids:
        raise InvalidData(
            f"coded against field {', '.join(drive.hello.field_ids)}, given {field.field_id}"
        )
    camera = drive.hello.cameras[0]
    arrivals = (
        Arrival(frame.packet, camera.posed(frame).view(field, camera.intrinsics))
        for frame in drive.frames
    )
    exact = drive.hello.renderer.exact
    decoder = DeltaDecoder(camera.codec, exact, open_decoder=open_decoder)
    try:
        pictures = decode_frames(decoder, arrivals)
        for frame, picture in zip(drive.frames, pictures, strict=True):
            assert picture is not None, "every packet of a file arrives"
            yield DecodedFrame(frame.packet.sequence, picture)
    finally:
        decoder.close()
