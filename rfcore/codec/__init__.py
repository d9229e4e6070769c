"""The delta codec: camera frames as H.264 P slices against a render that is never sent."""

from rfcore.codec.config import CodecConfig
from rfcore.codec.delta import Decoded, DeltaDecoder, DeltaEncoder, Encoded
from rfcore.codec.header import StreamHeader
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.state import DecoderState, EncoderState

__all__ = [
    "CodecConfig",
    "Decoded",
    "DecoderState",
    "DeltaDecoder",
    "DeltaEncoder",
    "DeltaPacket",
    "Encoded",
    "EncoderState",
    "StreamHeader",
]
