"""Stand-in until rfcore.codec lands; replaced by an import from it."""

from dataclasses import dataclass

__all__ = ["CodecConfig", "DeltaPacket", "StreamHeader"]


@dataclass(frozen=True)
class CodecConfig:
    """Size and quality of one coded camera."""

    width_px: int
    height_px: int
    preset: str = "medium"
    crf: float = 23.0


@dataclass(frozen=True)
class StreamHeader:
    """All a receiver needs before packet 1."""

    config: CodecConfig
    sps: bytes
    pps: bytes


@dataclass(frozen=True)
class DeltaPacket:
    """One P slice with the digests of what it needs and makes."""

    epoch: int
    sequence: int
    reference_digest: bytes
    reference_coarse: bytes
    reconstruction_digest: bytes
    payload: bytes
    crc32: int
