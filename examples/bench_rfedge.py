"""Our own coder as a submission to the benchmark, and its decoder.

rfedge-lab benchmark run out/rfedge --name rfedge --points 17 20 23 26 29 32 35 38 41 \
    --prior samples/fields/street.rff \
    --method "python examples/bench_rfedge.py encode {prior}/street.rff {frames} {out} {point}"
rfedge-lab benchmark check out/rfedge \
    --decoder "python examples/bench_rfedge.py decode {prior}/street.rff {packets} {out}"

The first packet begins with what a vehicle sends once: its camera and the stream's header.
"""

import sys
from dataclasses import replace
from pathlib import Path

from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfcore.wire.convert import client_message_from_bytes, hello_to_bytes
from rfcore.wire.drive_file import CodedDrive
from rfcore.wire.head import FrameReader, FrameWriter
from rfedge.offline import CodingSettings, decode_drive, encode_drive

CLOCK_NS = 1_700_000_000_000_000_000
"""Times of a vehicle's clock take more bytes than those of a data set that begin at 0."""


def encode(field_file: Path, frames: Path, out: Path, crf: float) -> None:
    field = load_field(field_file)
    coded = encode_drive(read_dataset(frames / "transforms.json"), field, CodingSettings(crf=crf))
    hello = hello_to_bytes(coded.hello)
    begins = len(hello).to_bytes(2, "big") + hello
    frames = (replace(f, capture_time_ns=CLOCK_NS + f.capture_time_ns) for f in coded.frames)
    for index, message in enumerate(FrameWriter(coded.hello).in_order(frames)):
        (out / f"{index:04d}.packet").write_bytes((b"" if index else begins) + message)
    decode(field_file, out, out)


def decode(field_file: Path, packets: Path, out: Path) -> None:
    first, *more = (file.read_bytes() for file in sorted(packets.glob("*.packet")))
    ends = 2 + int.from_bytes(first[:2], "big")
    hello = client_message_from_bytes(first[2:ends])
    reader = FrameReader(hello)
    frames = [reader.read(client_message_from_bytes(m)) for m in (first[ends:], *more)]
    for index, shown in enumerate(
        decode_drive(CodedDrive(hello, tuple(frames)), load_field(field_file))
    ):
        (out / f"{index:04d}.yuv").write_bytes(shown.frame.packed())


if __name__ == "__main__":
    verb, field_file, given, out, *crf = sys.argv[1:]
    if verb == "encode":
        encode(Path(field_file), Path(given), Path(out), float(crf[0]))
    else:
        decode(Path(field_file), Path(given), Path(out))
