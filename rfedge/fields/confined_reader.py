"""Read splats from anywhere in a process without rights, which hands back arrays.

The file is opened here and read there: ``python -m rfedge.fields.confined_reader CONFINEMENT FILE
MAX NAME EAST NORTH UP`` confines itself, says so with one byte, and writes to its standard output
one line of JSON (``Answer``) and the arrays of ``Gaussians`` one after the other; or ``!`` and what
is wrong.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin, Vec3
from rfcore.confinement.confine import Confinement, ProcessLimits, confine
from rfcore.confinement.start import BEST_FIRST, READY, confined_reader
from rfcore.errors import BackendUnavailable, FieldFormatError, RfedgeError
from rfcore.field.ply_table import printable
from rfcore.field.splat_archive import check_decoded_size
from rfcore.field.splat_file import (
    START_BYTES,
    read_open_splat_file,
    read_splat_file,
    splat_format,
)
from rfcore.field.spz import load_zstandard, needs_zstandard
from rfcore.field.stored_splats import ImportedSplats
from rfcore.raster.gaussians import Gaussians

READER_BYTES = 1 << 30
"""Address space of the reader, beside twice what the splats take."""
WRONG = b"!"
MAX_LINE_BYTES = 4096
NUMBERS_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Answer:
    """The reader's description of splats, before the arrays."""

    count: int
    coefficients: int
    antialiased: bool | None
    origin: tuple[float, float, float]
    notes: tuple[str, ...]
    up: Vec3 | None


def read_splats(
    path: Path, tile_origin: TileOrigin | None = None, unconfined: bool = False
) -> ImportedSplats:
    """Read a splat file of another program for a command; say where its sandbox is a lesser one.

    Raises ``FieldFormatError``, and ``BackendUnavailable`` where no sandbox works.
    """
    from rfedge.arguments import max_field_bytes  # the reader itself needs no command line

    if unconfined:
        return read_splat_file(path, tile_origin, max_field_bytes())
    read, confinement = read_confined(path, tile_origin, max_field_bytes())
    if confinement is not BEST_FIRST[0]:
        print(f"read in a {confinement} sandbox: {BEST_FIRST[0]} does not work here")
    return read


def read_confined(
    path: Path,
    tile_origin: TileOrigin | None,
    max_bytes: int,
    best_first: tuple[Confinement, ...] = BEST_FIRST,
) -> tuple[ImportedSplats, Confinement]:
    """Return what ``read_splat_file`` does, and how the reader was confined.

    The first of ``best_first`` that works here is used. Raises ``FieldFormatError`` for what is
    wrong with the file, ``BackendUnavailable`` where no confinement works.
    """
    try:
        with path.open("rb") as file:
            start = os.pread(file.fileno(), START_BYTES, 0)
            splat_format(path, start)
            if needs_zstandard(start):
                load_zstandard()
            process, confinement = _started(path, file, tile_origin, max_bytes, best_first)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error
    assert process.stdout is not None
    with process, process.stdout as answer:
        return _received(path, process, answer, max_bytes), confinement


def _started(
    path: Path,
    file: BinaryIO,
    origin: TileOrigin | None,
    max_bytes: int,
    best_first: tuple[Confinement, ...],
) -> tuple[subprocess.Popen[bytes], Confinement]:
    offset = "" if origin is None else f"{origin.east_m!r} {origin.north_m!r} {origin.up_m!r}"
    words = [str(file.fileno()), str(max_bytes), str(path), *offset.split()]
    try:
        return confined_reader("rfedge.fields.confined_reader", words, [file.fileno()], best_first)
    except BackendUnavailable as error:
        raise BackendUnavailable(
            f"no sandbox for the reader of {path.name} works here: {error}. If you trust "
            "the file, give --unconfined"
        ) from error


def _received(
    path: Path, process: subprocess.Popen[bytes], answer: IO[bytes], max_bytes: int
) -> ImportedSplats:
    line = answer.readline(MAX_LINE_BYTES)
    if line.startswith(WRONG):
        raise FieldFormatError(printable(line[1:].decode(errors="replace").strip()))
    try:
        said = Answer(**json.loads(line))
        n, k = int(said.count), int(said.coefficients)
        check_decoded_size(n, int(k**0.5) - 1, max_bytes)
        shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, k, 3))
        splats = Gaussians(*(_array(answer, shape) for shape in shapes))
        notes = tuple(printable(str(note)) for note in said.notes)
        antialiased = None if said.antialiased is None else bool(said.antialiased)
        origin = TileOrigin(*map(float, said.origin))
        if said.up is None:
            return ImportedSplats(splats, antialiased, origin, notes)
        x, y, z = map(float, said.up)
        return ImportedSplats(splats, antialiased, origin, notes, (x, y, z))
    except (ValueError, TypeError, EOFError) as error:
        answer.close()
        raise FieldFormatError(f"{path}: {_ended(process)}") from error


def _ended(process: subprocess.Popen[bytes]) -> str:
    """Say how a reader ended that did not answer as it should."""
    status = process.wait()
    number = -status if status < 0 else status - 128  # bubblewrap's status for a killed program
    if number in signal.valid_signals():
        name = signal.Signals(number).name
        return (
            f"its reader was killed by signal {name} ({signal.strsignal(number)}) before the last "
            "splat; if you trust the file, give --unconfined"
        )
    return f"its reader ended (status {status}) before the last splat"


def _array(answer: IO[bytes], shape: tuple[int, ...]) -> NDArray[np.float32]:
    array = np.empty(math.prod(shape), np.float32)
    for start in range(0, len(array), NUMBERS_AT_ONCE):
        part = array[start : start + NUMBERS_AT_ONCE]
        data = answer.read(part.nbytes)
        if len(data) < part.nbytes:
            raise EOFError
        part[:] = np.frombuffer(data, np.float32)
    return array.reshape(shape)


def main() -> None:
    """Read one file and answer."""
    confinement, descriptor, max_text, name, *offset = sys.argv[1:]
    file, max_bytes = os.fdopen(int(descriptor), "rb"), int(max_text)
    origin = TileOrigin(*map(float, offset)) if offset else None
    answer = sys.stdout.buffer
    with suppress(BackendUnavailable):  # where it is needed, the other end has asked for it
        load_zstandard()
    np.linalg.inv(np.eye(2))  # OpenBLAS gets its buffer by a call that is not allowed later
    confine(Confinement(confinement), ProcessLimits(READER_BYTES + 2 * max_bytes))
    answer.write(READY)
    answer.flush()
    try:
        read = read_open_splat_file(Path(name), file, origin, max_bytes)
    except RfedgeError as error:
        answer.write(WRONG + str(error).encode()[: MAX_LINE_BYTES - 2] + b"\n")
    except MemoryError:
        answer.write(WRONG + f"{name}: needs more memory than its reader may take\n".encode())
    else:
        splats = read.splats
        said = Answer(
            *(len(splats), splats.sh.shape[1], read.antialiased),
            *(astuple(read.tile_origin), read.notes, read.up),
        )
        answer.write(json.dumps(vars(said)).encode() + b"\n")
        for part in fields(splats):
            answer.write(getattr(splats, part.name).reshape(-1).view(np.uint8).data)
    answer.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
