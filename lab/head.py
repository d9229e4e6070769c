"""``rfedge-lab head``: the bytes of a message beside its slice, part by part.

Coded drives (``.rfv``, as ``rfedge encode`` writes them) hold the messages that a vehicle sends:
counted is the whole message less its payload, as everywhere in this project. What gRPC, HTTP/2 and
TLS add to it is not. A message takes whole bytes; parts are told to the bit, and the bits that fill
the last byte are a part, too. Each drive is also told as one of a rig: four cameras whose frames
have the pose of the rig and its instants.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from tyro.conf import Positional, arg

from lab.report import Report
from rfcore.errors import InvalidInput
from rfcore.wire.bits import BitReader
from rfcore.wire.drive_file import CodedDrive, read_drive
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import Frame
from rfcore.wire.v1 import edge_pb2 as pb
from rfedge.arguments import JSON
from rfedge.report.tables import Column, Table, columns, print_tables, shown
from rfedge.results import Result, as_json, make_result, provenance, rows_of, write_result

PARTS = ("message", "address", "time", "pose", "references", "fill", "check", "digests", "other")
RIG_CAMERAS = 4


@dataclass(frozen=True)
class HeadRow:
    """Bytes of a head and its parts over a drive, medians and 95th percentiles."""

    drive: str = field(metadata=shown("drive"))
    frames: int = field(metadata=shown("frames"))
    head: tuple[float, float] = field(metadata=shown("head", "{:.0f} / {:.0f}"))
    parts: Mapping[str, tuple[float, float]]
    """The same of every part of ``PARTS``."""
    before: tuple[float, float] | None = field(
        default=None, metadata=shown("head before", "{:.0f} / {:.0f}")
    )


def part_bits(message: bytes, payload_bytes: int) -> dict[str, int]:
    """Return the bits of each part of a frame's message."""
    data = pb.StreamRequest.FromString(message).frame
    bits, at = BitReader(data[:128]), 0
    parts = dict.fromkeys(PARTS, 0)
    parts["message"] = 8 * (len(message) - len(data))

    def over(part: str) -> None:
        nonlocal at
        parts[part] += bits.bits_taken - at
        at = bits.bits_taken

    bits.take(5)
    kind = bits.take(2)
    if kind:
        bits.take(12)
    if kind != 1:
        bits.number(), bits.number()
    flags = bits.take(8)
    over("address")
    bits.number()
    over("time")
    for flag, width in ((128, 6), (64, 19)):
        if flags & flag:
            bits.take(width)
    if flags & 32:
        bits.number()
    if flags & 16:
        bits.take(4)
    over("other")
    if not flags & 8:
        bits.take(2), bits.triple(), bits.triple()
    over("pose")
    bits.take(8)
    over("references")
    bits.take({0: 0, 1: 192, 2: 0, 3: 11}[flags & 3])
    over("other")
    parts["fill"] = -at % 8
    parts["check"], parts["digests"] = 32, 64
    parts["other"] += 8 * (len(data) - payload_bytes) - sum(parts.values()) + parts["message"]
    return parts


def head_row(name: str, frames: Iterable[Frame], messages: Iterable[bytes]) -> HeadRow:
    """Return the row of a drive."""
    bits = [part_bits(m, len(f.packet.payload)) for f, m in zip(frames, messages, strict=True)]
    parts = {part: _spread([each[part] / 8 for each in bits]) for part in PARTS}
    head = _spread([sum(each.values()) / 8 for each in bits])
    return HeadRow(name, len(bits), head, parts)


def _spread(values: list[float]) -> tuple[float, float]:
    return float(np.median(values)), float(np.percentile(values, 95, method="higher"))


def on_rig(drive: CodedDrive) -> CodedDrive:
    """Return the drive as if ``RIG_CAMERAS`` cameras had taken each of its pictures together."""
    (camera,) = drive.hello.cameras
    cameras = tuple(replace(camera, camera_id=f"c{n}") for n in range(RIG_CAMERAS))
    frames = (
        replace(frame, camera_id=one.camera_id, instant=instant)
        for instant, frame in enumerate(drive.frames, 1)
        for one in cameras
    )
    return CodedDrive(replace(drive.hello, cameras=cameras), tuple(frames))


def rows(paths: Iterable[Path], before: Mapping[str, tuple[float, float]]) -> Iterator[HeadRow]:
    """Yield a row for each drive, and one for it on a rig."""
    for path in paths:
        drive = read_drive(path)
        for name, told in ((path.stem, drive), (f"{path.stem}, a rig of four", on_rig(drive))):
            messages = FrameWriter(told.hello).in_order(told.frames)
            row = head_row(name, told.frames, messages)
            yield replace(row, before=before.get(path.stem) if told is drive else None)


def _parts(result: Result) -> Iterator[Table | str]:
    found = rows_of(HeadRow, result["rows"])
    before = f"; before: at revision {result['before']}" if result["before"] else ""
    yield Table(f"Bytes of a head, median / 95th percentile{before}", columns(HeadRow), found)
    parts = [Column(part, partial(_part, part), "{:.1f} / {:.1f}") for part in PARTS]
    yield Table("Bytes of its parts", [*columns(HeadRow, "drive"), *parts], found)


def _part(part: str, row: HeadRow) -> tuple[float, float]:
    return row.parts[part]


REPORT = Report(
    "head",
    "Heads of frames",
    "The bytes of a frame's message beside its slice, median and 95th percentile of each drive.",
    _parts,
)


@dataclass(frozen=True)
class EvalHead:
    """Tell the bytes of heads in coded drives, part by part, alone and on a rig of four."""

    drives: Annotated[tuple[Path, ...], Positional, arg(metavar="FILE.rfv ...")]
    """Files that `rfedge encode` wrote; a drive is called as its file."""
    before: Path | None = None
    """JSON with the median and 95th percentile of earlier heads by drive, and their revision."""
    json: Annotated[Path | None, JSON] = None
    """Also write the figures into this file."""

    def run(self) -> None:
        """Print the tables and write the result."""
        if not self.drives:
            raise InvalidInput("drives", "no coded drive is named")
        made = provenance(self.drives)
        earlier = {} if self.before is None else json.loads(self.before.read_text("utf-8"))
        measured = list(rows(self.drives, earlier.get("heads", {})))
        content = {"before": earlier.get("revision"), "rows": as_json(measured)}
        result = make_result("head", made, content)
        print_tables(_parts(result), Console())
        if self.json is not None:
            write_result(self.json, result)
