"""Read a .ply or .spz from anywhere in a process without rights, which hands back arrays.

The file is opened here and read there: ``python -m rfedge.fields.confined_reader CONFINEMENT FILE
MAX NAME EAST NORTH UP`` confines itself, says so with one byte, and writes to its standard output
one line (count, coefficients, antialiased or not or unsaid) and the arrays of ``Gaussians`` one
after the other; or ``!`` and what is wrong.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin
from rfcore.confinement.confine import Confinement, ProcessLimits, confine
from rfcore.confinement.start import ConfinedProgram
from rfcore.errors import BackendUnavailable, FieldFormatError, RfedgeError
from rfcore.field.splat_archive import check_decoded_size
from rfcore.field.splat_file import check_suffix, read_open_splat_file
from rfcore.raster.gaussians import Gaussians

BEST_FIRST = (Confinement.BUBBLEWRAP, Confinement.LANDLOCK)
READER_BYTES = 1 << 30
"""Address space of the reader, beside twice what the splats take."""
READY, WRONG = b".", b"!"
MAX_LINE_BYTES = 4096
NUMBERS_AT_ONCE = 1 << 20
STATED = {"unsaid": None, "antialiased": True, "default": False}


def read_confined(
    path: Path,
    tile_origin: TileOrigin | None,
    max_bytes: int,
    best_first: tuple[Confinement, ...] = BEST_FIRST,
) -> tuple[Gaussians, bool | None, Confinement]:
    """Return what ``read_splat_file`` does, and how the reader was confined.

    The first of ``best_first`` that works here is used. Raises ``FieldFormatError`` for what is
    wrong with the file, ``BackendUnavailable`` where no confinement works.
    """
    check_suffix(path)
    try:
        with path.open("rb") as file:
            process, confinement = _started(path, file, tile_origin, max_bytes, best_first)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error
    assert process.stdout is not None
    with process, process.stdout as answer:
        gaussians, antialiased = _received(path, answer, max_bytes)
    return gaussians, antialiased, confinement


def _started(
    path: Path,
    file: BinaryIO,
    origin: TileOrigin | None,
    max_bytes: int,
    best_first: tuple[Confinement, ...],
) -> tuple[subprocess.Popen[bytes], Confinement]:
    offset = "" if origin is None else f"{origin.east_m!r} {origin.north_m!r} {origin.up_m!r}"
    words = [str(file.fileno()), str(max_bytes), str(path), *offset.split()]
    problems = []
    for confinement in best_first:
        environment = {"OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        if "PYTHONPATH" in os.environ:
            environment["PYTHONPATH"] = os.environ["PYTHONPATH"]
        program = ConfinedProgram("rfedge.fields.confined_reader", confinement, environment)
        try:
            process = program.start(words, [file.fileno()], subprocess.PIPE, subprocess.PIPE)
        except BackendUnavailable as error:
            problems.append(str(error))
            continue
        assert process.stdout is not None
        assert process.stderr is not None
        if process.stdout.read(1) == READY:
            process.stderr.close()
            return process, confinement
        _, errors = process.communicate()
        problems.append((errors.decode(errors="replace").splitlines() or ["ended"])[-1][:200])
    raise BackendUnavailable(
        f"no sandbox for the reader of {path.name} works here: {'; '.join(problems)}. If you trust "
        "the file, give --unconfined"
    )


def _received(path: Path, answer: IO[bytes], max_bytes: int) -> tuple[Gaussians, bool | None]:
    line = answer.readline(MAX_LINE_BYTES)
    if line.startswith(WRONG):
        raise FieldFormatError(line[1:].decode(errors="replace").strip())
    try:
        count, coefficients, stated = line.decode("ascii").split()
        antialiased = STATED[stated]
        n, k = int(count), int(coefficients)
        check_decoded_size(n, int(k**0.5) - 1, max_bytes)
        shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, k, 3))
        return Gaussians(*(_array(answer, shape) for shape in shapes)), antialiased
    except (ValueError, KeyError, EOFError) as error:
        raise FieldFormatError(f"{path}: its reader ended before the last splat") from error


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
    confine(Confinement(confinement), ProcessLimits(READER_BYTES + 2 * max_bytes))
    answer.write(READY)
    answer.flush()
    try:
        splats, stated = read_open_splat_file(Path(name), file, origin, max_bytes)
    except RfedgeError as error:
        answer.write(WRONG + str(error).encode()[: MAX_LINE_BYTES - 2] + b"\n")
    else:
        word = {value: word for word, value in STATED.items()}[stated]
        answer.write(f"{len(splats)} {splats.sh.shape[1]} {word}\n".encode())
        for part in fields(splats):
            answer.write(getattr(splats, part.name).reshape(-1).view(np.uint8).data)
    answer.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
