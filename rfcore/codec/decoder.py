"""The receiver: decodes slices into frames, against pictures it makes itself.

A standard decoder may not notice a lost P slice or a flipped bit in one (ITU-T H.264 does not
define what damaged streams decode to), so a packet carries digests. Whether it arrived intact is
checked where it is read (``rfcore.wire.head``), its epoch and sequence by ``check_packet``. The
receiver then checks that the earlier frame is kept here, the form of the payload, and at last the
digests of its render and of the decoded picture. Where decoding fails, a render that is not the
sender's is named first: it is the likely cause.

With inexact renderers an error would spread from frame to frame, so then frames may be predicted
from the render only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.splice import PictureDecoder, SpliceDecoder, without_zeros
from rfcore.codec.packet import (
    BLOCK_MEANS_TOLERANCE,
    CheckedPacket,
    DeltaPacket,
    block_mean_difference,
    block_mean_digest,
    check_packet,
)
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import DecoderState, Past
from rfcore.errors import BitstreamError, CodecError, InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

_OTHER = "another pose, field or camera, or a class that promises exact renders and breaks it"
_MEANS_REQUIRED = "between renderers that are not exact the sender must send them"


@dataclass(frozen=True)
class Decoded:
    """A decoded frame and the receiver's next state; ``lost`` packets are missing right before it.

    ``exact``: the frame equals the sender's to the bit; otherwise the render differed by rounding.
    ``stage_ns`` has the times of "references" (checks, warp, correction), "splice" (feeding the
    references to the decoder) and "decode" (the slice, the digests of render and picture).
    """

    frame: I420
    state: DecoderState
    lost: int
    exact: bool
    stage_ns: Mapping[str, int]


class DeltaDecoder:
    """Decodes packets one by one; ``DeltaEncoder`` has an example.

    Raises ``InvalidInput`` for a header that our encoder would not make.

    With ``exact=False`` the sender's renderer may differ by rounding: a render of another digest
    but of the same block means, up to rounding, is accepted, and its reconstruction cannot be
    checked. Between exact renderers no packet needs block means; if they are present, they say what
    kind of difference led to ``RENDER_MISMATCH``. ``open_decoder`` opens the standard decoder that
    reads the sender's bytes.
    """

    def __init__(
        self,
        header: StreamHeader,
        exact: bool = True,
        clock_ns: Callable[[], int] = lambda: 0,
        open_decoder: Callable[[tuple[int, int]], PictureDecoder] = H264Decoder,
    ) -> None:
        self._config = header.config
        self._splice = SpliceDecoder(header, open_decoder)
        self._exact = exact
        self._clock_ns = clock_ns

    def close(self) -> None:
        """Release the standard decoder."""
        self._splice.close()

    def start(self, epoch: int = 0) -> DecoderState:
        """Return the state before the first packet, which is of ``epoch`` or a later one."""
        return DecoderState(epoch)

    def decode(self, state: DecoderState, packet: DeltaPacket, view: FieldView) -> Decoded:
        """Check one packet and decode it against ``view``, our own render and depth at its pose.

        Raises ``PacketRejected`` with the reason; ``state`` stays good for the next packet.
        Raises ``InvalidInput`` if the view is not of the stream's size.
        """
        checked = check_packet(packet, state.epoch, state.next_sequence)
        return self.decode_checked(state, checked, view)

    def prepared(
        self, state: DecoderState, view: FieldView, base_digest: bytes, like: DeltaPacket | None
    ) -> Prediction:
        """Return what the next packet is predicted from, if it is like ``like``, the one before.

        ``base_digest`` names the earlier frame. The references that ``like`` had are made.
        """
        past = state.past(base_digest) if base_digest and self._exact else None
        if like is None or past is None or like.photometric or like.light:
            return Prediction(view)
        prediction = prediction_of(like, view, past)
        prediction.pictures(like.references)
        return prediction

    def decode_checked(
        self,
        state: DecoderState,
        checked: CheckedPacket,
        view: FieldView,
        prepared: Prediction | None = None,
    ) -> Decoded:
        """Decode as ``decode`` does, for a caller that checked the packet before it rendered.

        ``prepared``: made from the same view, used if the packet is predicted from that.
        """
        packet = checked.packet
        render = view.render
        if render.size_px != self._config.size_px:
            raise InvalidInput(
                "render", f"{render.size_px} px where the stream has {self._config.size_px} px"
            )
        started_ns = self._clock_ns()
        try:
            past = self._past(state, packet)
            self._check_payload(packet)
            prediction = (
                prepared
                if prepared is not None and _fits(prepared, packet, past)
                else prediction_of(packet, view, past)
            )
            pictures = _pictures(packet, prediction)
            made_ns = self._clock_ns()
            spliced_ns, frame = self._reconstruct(packet, pictures)
        except PacketRejected:
            self._check_render(packet, render)
            raise
        made, same_render = self._checked(packet, render, prediction, frame)
        stage_ns = {
            "references": made_ns - started_ns,
            "splice": spliced_ns - made_ns,
            "decode": self._clock_ns() - spliced_ns,
        }
        following = state.after(packet.epoch, packet.sequence, made)
        return Decoded(frame, following, checked.lost, same_render, stage_ns)

    def _checked(
        self, packet: DeltaPacket, render: I420, prediction: Prediction, frame: I420
    ) -> tuple[Past, bool]:
        """Return the decoded frame, and whether it is known to equal the sender's to the bit.

        Raises ``PacketRejected`` for a render or picture that is not the sender's.
        """
        digest = frame.digest()
        try:
            same_render = self._check_render(packet, render)
            if same_render and not digest.startswith(packet.reconstruction_digest):
                raise PacketRejected(
                    RejectReason.RECONSTRUCTION_MISMATCH,
                    f"packet {packet.sequence} decodes to another picture than the sender's",
                )
        except PacketRejected:
            self._splice.reset()
            raise
        return prediction.past_of(frame, digest), same_render

    def _check_render(self, packet: DeltaPacket, render: I420) -> bool:
        """Return whether the renders are identical; raise if the packet cannot be decoded with
        ours."""
        if render.digest().startswith(packet.render_digest):
            return True
        if not packet.render_block_means:
            raise PacketRejected(
                RejectReason.RENDER_MISMATCH,
                "our render is not the sender's, and the packet has no block means to say by how "
                f"much: {_OTHER if self._exact else _MEANS_REQUIRED}",
            )
        difference = block_mean_difference(block_mean_digest(render), packet.render_block_means)
        rounding_sized = difference <= BLOCK_MEANS_TOLERANCE
        if rounding_sized and not self._exact:
            return False
        kind = (
            "rounding-sized: the renderers are not bit-exact to each other"
            if rounding_sized
            else "another pose, field or camera"
        )
        raise PacketRejected(
            RejectReason.RENDER_MISMATCH,
            f"our render is not the sender's; block means differ by up to {difference} "
            f"levels (tolerance {BLOCK_MEANS_TOLERANCE}): {kind}",
        )

    def _past(self, state: DecoderState, packet: DeltaPacket) -> Past | None:
        """Return the earlier frame that the packet predicts from, if there is one."""
        if not packet.needs_base:
            return None
        if not self._exact:
            raise PacketRejected(
                RejectReason.INVALID_ARGUMENT,
                "between renderers that are not exact only the render may be predicted from",
            )
        past = state.past(packet.base_digest)
        if past is None:
            raise PacketRejected(
                RejectReason.UNKNOWN_STATE,
                f"frame {packet.base_digest.hex()} is none of the {len(state.kept)} kept here",
            )
        return past

    def _check_payload(self, packet: DeltaPacket) -> None:
        count = len(packet.references)
        try:
            if packet.payload:
                self._splice.check_payload(packet.payload, count)
            elif count != 1:
                raise BitstreamError(f"no slice, and {count} references where 1 is the picture")
        except BitstreamError as error:
            raise PacketRejected(RejectReason.MALFORMED_PAYLOAD, str(error)) from error

    def _reconstruct(self, packet: DeltaPacket, pictures: tuple[I420, ...]) -> tuple[int, I420]:
        """Return the time when the decoder had the references, and the decoded frame."""
        if not packet.payload:
            return self._clock_ns(), without_zeros(pictures[0])
        try:
            self._splice.predict_from(*pictures)
            spliced_ns = self._clock_ns()
            return spliced_ns, self._splice.decode(packet.payload)
        except CodecError as error:
            raise PacketRejected(RejectReason.DECODER_FAILED, str(error)) from error


def _fits(prepared: Prediction, packet: DeltaPacket, past: Past | None) -> bool:
    """Return whether a packet, of the same view, is predicted from what was prepared."""
    lights = (prepared.photometric, prepared.is_relit, prepared.light)
    same_light = lights == (packet.photometric, packet.relit, packet.light)
    return same_light and (past is None or past is prepared.past)


def prediction_of(packet: DeltaPacket, view: FieldView, past: Past | None) -> Prediction:
    """Return what ``packet`` was predicted from; raise ``PacketRejected`` if it cannot be made."""
    if not packet.relit:
        return Prediction.under_light(view, packet.photometric, past)
    try:
        return Prediction.relit(view, past, light=packet.light)
    except InvalidInput as error:
        raise PacketRejected(RejectReason.INVALID_ARGUMENT, str(error)) from error


def _pictures(packet: DeltaPacket, prediction: Prediction) -> tuple[I420, ...]:
    try:
        return prediction.pictures(packet.references)
    except InvalidInput as error:
        raise PacketRejected(RejectReason.INVALID_ARGUMENT, str(error)) from error
