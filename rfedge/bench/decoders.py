"""Time the decoder in this process, in a child process, and in a child inside a sandbox.

Every frame of the sample drive (640x360, the references that the encoder chose) is decoded by each
kind in turn against the same render, so that a difference compares decodes under the same load of
the machine; the decoder itself refuses a picture that is not the sender's. Times are of
``DeltaDecoder.decode``, without the render.
"""

from __future__ import annotations

import statistics
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter_ns

from mec_server.config import DecoderKind
from mec_server.decoding.decoders import Decoders, DecoderSettings
from mec_server.decoding.process import LossCause
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.state import DecoderState
from rfcore.errors import RfedgeError
from rfcore.field import RadianceField, load_field
from rfcore.views import FieldView
from rfcore.wire.messages import Frame
from rfedge.loadtest.prerecorded import PrerecordedDrive, prerecorded_drive
from rfedge.samples import sample_path

__all__ = ["DecoderRow", "decoder_rows"]

FIELD = sample_path("fields/street.rff")
DRIVE = sample_path("street/transforms_drive_vehicles.json")
KINDS = (
    DecoderKind.IN_PROCESS,
    DecoderKind.CHILD,
    DecoderKind.LANDLOCK,
    DecoderKind.BUBBLEWRAP,
)
LAPS = 5
"""How many times the drive is decoded, after one pass to warm up."""


@dataclass(frozen=True)
class DecoderRow:
    """One place to decode in; ``more_ms`` is the median difference to decoding in this process."""

    decoder: str
    frames: int
    median_ms: float
    more_ms: float


def decoder_rows() -> list[DecoderRow]:
    """Return a row for each place to decode in."""
    field = load_field(FIELD)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        drive = PrerecordedDrive.read(prerecorded_drive(DRIVE, field, Path(folder)))
        decoders = {kind: _decoder(kind, drive, opened) for kind in KINDS}
        times_ms = _times(drive, field, decoders)
    here_ms = times_ms[DecoderKind.IN_PROCESS]
    return [
        DecoderRow(
            decoder=str(kind),
            frames=len(ms),
            median_ms=statistics.median(ms),
            more_ms=statistics.median(a - b for a, b in zip(ms, here_ms, strict=True)),
        )
        for kind, ms in times_ms.items()
    ]


def _decoder(kind: DecoderKind, drive: PrerecordedDrive, opened: ExitStack) -> DeltaDecoder:
    decoders = Decoders(
        DecoderSettings(kind, as_root=True), _fail, lambda _: None
    )  # taking the spare raises
    decoders.start()
    opened.callback(decoders.close)
    header = drive.hello.cameras[0].codec
    decoder = DeltaDecoder(header, True, perf_counter_ns, decoders.open)
    opened.callback(decoder.close)
    return decoder


def _fail(cause: LossCause) -> None:
    raise RfedgeError(f"a decoder process was lost ({cause}) on a sample that decodes")


def _times(
    drive: PrerecordedDrive, field: RadianceField, decoders: dict[DecoderKind, DeltaDecoder]
) -> dict[DecoderKind, list[float]]:
    views = [f.view(field, drive.intrinsics) for f in drive.chain]
    times_ms: dict[DecoderKind, list[float]] = {kind: [] for kind in decoders}
    for lap in range(1 + LAPS):
        states = {kind: decoder.start(0) for kind, decoder in decoders.items()}
        for frame, view in zip(drive.chain, views, strict=True):
            for kind, decoder in decoders.items():
                ms, states[kind] = _timed(decoder, states[kind], frame, view)
                if lap:
                    times_ms[kind].append(ms)
    return times_ms


def _timed(
    decoder: DeltaDecoder, state: DecoderState, frame: Frame, view: FieldView
) -> tuple[float, DecoderState]:
    started_ns = perf_counter_ns()
    decoded = decoder.decode(state, frame.packet, view)
    return (perf_counter_ns() - started_ns) / 1e6, decoded.state
