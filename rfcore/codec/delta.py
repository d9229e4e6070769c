"""The delta codec: frames as P slices against renders that both ends make themselves.

States are values: ``encode`` and ``decode`` take one and return the next, and an error leaves the
caller with the one it had. The objects hold only the configuration and a decoder whose content
does not outlive a frame. One caller at a time per object.

Why a packet carries what it does: losing a P slice, or one flipped bit in it, can go unnoticed in a
standard decoder (ITU-T H.264 says nothing about damaged streams). So the receiver compares, in this
order, epoch, sequence, CRC, the digest of its render, the shape of the payload, and at last
the digest of what it decoded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rfcore.codec.coarse import COARSE_TOLERANCE, coarse_difference, coarse_digest
from rfcore.codec.config import CodecConfig
from rfcore.codec.header import StreamHeader
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.pair import encode_pair
from rfcore.codec.splice import SpliceDecoder
from rfcore.codec.state import DecoderState, EncoderState
from rfcore.errors import BitstreamError, CodecError, InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420

__all__ = ["Decoded", "DeltaDecoder", "DeltaEncoder", "Encoded"]

Clock = Callable[[], int]


def _stopped_clock() -> int:
    return 0


@dataclass(frozen=True)
class Encoded:
    """A packet, what the receiver will see, and the sender's next state.

    ``stage_ns`` has "encode" (x264) and "closed_loop" (decoding as the receiver does, digests).
    """

    packet: DeltaPacket
    reconstruction: I420
    state: EncoderState
    stage_ns: Mapping[str, int]


@dataclass(frozen=True)
class Decoded:
    """A frame and the receiver's next state; ``lost`` packets are missing right before this one.

    ``stage_ns`` has "splice" (checks, the render as reference picture) and "decode" (the P slice,
    the digest).
    """

    frame: I420
    state: DecoderState
    lost: int
    stage_ns: Mapping[str, int]


class DeltaEncoder:
    """The sender. Raises ``CodecError`` if x264 does not make the stream the config promises."""

    def __init__(self, config: CodecConfig, clock_ns: Clock = _stopped_clock) -> None:
        self._config = config
        self._clock_ns = clock_ns
        grey = _grey(config.size_px)
        self._header, _ = encode_pair(config, grey, grey)
        try:
            self._splice = SpliceDecoder(self._header)
        except InvalidInput as error:
            raise CodecError(f"x264 did not do as told: {error}") from error

    @property
    def header(self) -> StreamHeader:
        """What a receiver needs before the first packet."""
        return self._header

    def start(self, epoch: int) -> EncoderState:
        """Return the state before the first packet of a (re)started stream."""
        return EncoderState(epoch)

    def encode(self, state: EncoderState, frame: I420, render: I420) -> Encoded:
        """Code ``frame`` against ``render`` (both of the configured size).

        Raises ``InvalidInput`` for another size, ``CodecError`` if x264 fails.
        """
        _require_size("frame", frame, self._config)
        _require_size("render", render, self._config)
        started_ns = self._clock_ns()
        header, payload = encode_pair(self._config, render, frame)
        if header != self._header:
            raise CodecError("x264 changed its parameter sets within a stream")
        encoded_ns = self._clock_ns()
        self._splice.predict_from(render)
        reconstruction = self._splice.decode(payload)
        packet = _seal(state, render, reconstruction, payload)
        stage_ns = {
            "encode": encoded_ns - started_ns,
            "closed_loop": self._clock_ns() - encoded_ns,
        }
        following = replace(state, next_sequence=state.next_sequence + 1)
        return Encoded(packet, reconstruction, following, stage_ns)


class DeltaDecoder:
    """The receiver. Raises ``InvalidInput`` for a header our encoder would not make.

    With ``exact=False`` the sender's renderer may differ by rounding: a reference that fails the
    exact digest but passes the coarse one is accepted, and its reconstruction cannot be checked.
    """

    def __init__(
        self, header: StreamHeader, exact: bool = True, clock_ns: Clock = _stopped_clock
    ) -> None:
        self._config = header.config
        self._splice = SpliceDecoder(header)
        self._exact = exact
        self._clock_ns = clock_ns

    def start(self, epoch: int) -> DecoderState:
        """Return the state before the first packet of a (re)started stream."""
        return DecoderState(epoch)

    def decode(self, state: DecoderState, packet: DeltaPacket, render: I420) -> Decoded:
        """Decode one packet against our own ``render`` at its pose.

        Raises ``PacketRejected`` with the reason; ``state`` stays good for the next packet.
        Raises ``InvalidInput`` if the render is not of the stream's size.
        """
        _require_size("render", render, self._config)
        started_ns = self._clock_ns()
        _check_order(state, packet)
        _check_crc(packet)
        same_reference = self._check_reference(packet, render)
        self._check_payload(packet)
        spliced_ns, frame = self._reconstruct(packet, render)
        if same_reference and frame.digest() != packet.reconstruction_digest:
            self._splice.reset()
            raise PacketRejected(
                RejectReason.RECONSTRUCTION_MISMATCH,
                f"packet {packet.sequence} decodes to another picture than the sender's",
            )
        stage_ns = {
            "splice": spliced_ns - started_ns,
            "decode": self._clock_ns() - spliced_ns,
        }
        lost = packet.sequence - state.next_sequence
        following = replace(state, next_sequence=packet.sequence + 1)
        return Decoded(frame, following, lost, stage_ns)

    def _check_reference(self, packet: DeltaPacket, render: I420) -> bool:
        """Tell whether the references are identical; raise if they may not be used together."""
        if render.digest() == packet.reference_digest:
            return True
        difference = coarse_difference(coarse_digest(render), packet.reference_coarse)
        rounding_sized = difference <= COARSE_TOLERANCE
        if rounding_sized and not self._exact:
            return False
        kind = (
            "rounding-sized: the renderers are not bit-exact to each other"
            if rounding_sized
            else "another pose, field or camera"
        )
        raise PacketRejected(
            RejectReason.REFERENCE_MISMATCH,
            f"our render is not the sender's; block means differ by up to {difference} "
            f"levels (tolerance {COARSE_TOLERANCE}): {kind}",
        )

    def _check_payload(self, packet: DeltaPacket) -> None:
        try:
            self._splice.check_payload(packet.payload)
        except BitstreamError as error:
            raise PacketRejected(RejectReason.MALFORMED_PAYLOAD, str(error)) from error

    def _reconstruct(self, packet: DeltaPacket, render: I420) -> tuple[int, I420]:
        """Return the time at which the reference stood, and the decoded frame."""
        self._splice.predict_from(render)
        spliced_ns = self._clock_ns()
        try:
            return spliced_ns, self._splice.decode(packet.payload)
        except CodecError as error:
            raise PacketRejected(RejectReason.DECODER_FAILED, str(error)) from error


def _require_size(name: str, picture: I420, config: CodecConfig) -> None:
    if picture.size_px != config.size_px:
        raise InvalidInput(name, f"{picture.size_px} px where the stream has {config.size_px} px")


def _check_order(state: DecoderState, packet: DeltaPacket) -> None:
    if packet.epoch != state.epoch:
        raise PacketRejected(
            RejectReason.STALE_EPOCH, f"epoch {packet.epoch} where {state.epoch} is current"
        )
    if packet.sequence < state.next_sequence:
        raise PacketRejected(
            RejectReason.STALE_SEQUENCE,
            f"sequence {packet.sequence} where {state.next_sequence} or later is expected",
        )


def _check_crc(packet: DeltaPacket) -> None:
    expected = packet.expected_crc32()
    if packet.crc32 != expected:
        raise PacketRejected(
            RejectReason.CRC_MISMATCH, f"CRC {packet.crc32:08x} of contents with {expected:08x}"
        )


def _seal(state: EncoderState, render: I420, reconstruction: I420, payload: bytes) -> DeltaPacket:
    return DeltaPacket(
        epoch=state.epoch,
        sequence=state.next_sequence,
        reference_digest=render.digest(),
        reference_coarse=coarse_digest(render),
        reconstruction_digest=reconstruction.digest(),
        payload=payload,
        crc32=0,
    ).sealed()


def _grey(size_px: tuple[int, int]) -> I420:
    width_px, height_px = size_px
    half = ((height_px + 1) // 2, (width_px + 1) // 2)
    return I420(*(np.full(s, 128, np.uint8) for s in ((height_px, width_px), half, half)))
