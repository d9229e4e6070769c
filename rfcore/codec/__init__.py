"""The delta codec: camera frames as H.264 P slices against a render that is never sent."""

from rfcore.codec.config import CodecConfig
from rfcore.codec.decoder import Decoded, DeltaDecoder
from rfcore.codec.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.codec.header import StreamHeader
from rfcore.codec.packet import NEEDED_BYTES, DeltaPacket
from rfcore.codec.qp_map import QpMap, qp_map_of_mask
from rfcore.codec.rate import RateModel, RateTarget
from rfcore.codec.references import INTRA, RENDER_ONLY, Reference, References, references_name
from rfcore.codec.state import KEPT_FRAMES, DecoderState, EncoderState, Past
from rfcore.codec.steering import NO_STEERING, Steering, SteeringSettings
from rfcore.codec.throughput import PathEstimator

__all__ = [
    "INTRA",
    "KEPT_FRAMES",
    "NEEDED_BYTES",
    "NO_STEERING",
    "RENDER_ONLY",
    "CodecConfig",
    "Decoded",
    "DecoderState",
    "DeltaDecoder",
    "DeltaEncoder",
    "DeltaPacket",
    "Encoded",
    "EncoderState",
    "FrameChoice",
    "Past",
    "PathEstimator",
    "QpMap",
    "RateModel",
    "RateTarget",
    "Reference",
    "References",
    "Steering",
    "SteeringSettings",
    "StreamHeader",
    "qp_map_of_mask",
    "references_name",
]
