"""Result files: one format for every measurement, and where its figures come from.

A result is one JSON object. Its ``kind`` says what was measured (such as ``compare``, ``bench`` or
``faults``) and is the only key that readers branch on; ``command``, ``revision``, ``dirty``,
``host`` and ``inputs`` say how it was made; the rest is the measurement, mostly lists of rows. A
kind of row is a frozen dataclass: ``as_json`` writes it, ``rows_of`` reads it back. A field whose
default is None may be missing from a row; every other one must be there.

All results are made by ``make_result`` and written by ``write_result``. No date is in them, so that
the same measurement of the same code on the same host makes the same file but for its timings.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from rfcore.errors import InvalidInput
from rfcore.files import write_whole

Result = Mapping[str, Any]
"""The content of a result file, as JSON has it."""

T = TypeVar("T")

CHECKOUT = Path(__file__).parents[1]
CODE = (".", ":!lab/results", ":!docs")
"""Git pathspecs of the files that decide about a figure."""
DIRTY = "-dirty"
NUMBERS = re.compile(r"\[\n\s*(?:(?:-?\d[\d.eE+-]*|null),?\n\s*)+\]")
"""A list of numbers as ``json`` writes it, each on a line; no string holds a line break."""
STANDARD_OUTPUT = "-"


@dataclass(frozen=True)
class Provenance:
    """The origin of a result: enough to make it again, and to tell whether that is possible."""

    command: str
    """The command line, quoted for a shell."""
    revision: str
    """Commit of the code; ends in ``-dirty`` with uncommitted changes, ``unknown`` outside git."""
    dirty: bool | None
    """Whether the code had uncommitted changes; None where the revision is unknown."""
    host: Mapping[str, Any]
    """CPU, cores, instruction set, Python and operating system; see ``host``."""
    inputs: Mapping[str, str]
    """SHA-256 of the input files, by the path that was given."""


def provenance(
    inputs: Iterable[Path] = (), *, command: str | None = None, at: str | None = None
) -> Provenance:
    """Return how a result is made that is measured now.

    ``command`` defaults to the command line of this process, ``at`` to the ``revision`` of the
    checkout. Of ``inputs``, files are hashed; folders are left out: what is read of them
    is the measurement's to digest.
    """
    at = revision() if at is None else at
    return Provenance(
        command=command_line() if command is None else command,
        revision=at,
        dirty=None if at == "unknown" else at.endswith(DIRTY),
        host=host(),
        inputs={str(path): _sha256(path) for path in inputs if path.is_file()},
    )


def command_line() -> str:
    """Return how this process was called, quoted for a shell, without the program's folder."""
    program = Path(sys.argv[0])
    module = program.parent.name  # of `python -m rfedge`, the program is rfedge/__main__.py
    name = f"python -m {module}" if program.name == "__main__.py" else program.name
    return " ".join([name, shlex.join(sys.argv[1:])]).rstrip()


def revision(checkout: Path = CHECKOUT) -> str:
    """Return the checkout's commit, with ``-dirty`` if it has changes; ``unknown`` outside one.

    Results and the pages made of them do not count: figures are taken one after another.
    """
    try:
        commit = _git(checkout, "describe", "--always", "--abbrev=12")
        changed = _git(checkout, "status", "--porcelain", "--untracked-files=no", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}{DIRTY}" if changed else commit


def _git(checkout: Path, *arguments: str) -> str:
    command = ["git", "-C", str(checkout), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def host() -> dict[str, Any]:
    """Return CPU model, core count, best instruction set, Python and operating system."""
    from rfcore.native.backend import available_isas

    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "isa": available_isas()[0],
        "python": platform.python_version(),
        "os": platform.platform(),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def check_result_path(out: Path) -> None:
    """Raise ``InvalidInput`` unless ``out`` names a JSON file."""
    if out.suffix != ".json":
        raise InvalidInput("out", f"{out} must end in .json")


def make_result(kind: str, made: Provenance, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result of ``kind`` as JSON has it; rows in ``content`` may be dataclasses.

    Raises ``InvalidInput`` for a number that is not finite, which JSON cannot hold, and for content
    that would replace what says how it was made.
    """
    head = {"kind": kind, **as_json(made)}
    taken = sorted(set(head) & set(content))
    if taken:
        raise InvalidInput("result", f"{', '.join(taken)}: reserved for the provenance; rename it")
    return {**head, **as_json(content)}


def as_json(value: Any, place: str = "result") -> Any:
    """Return ``value`` as JSON has it: dataclasses become objects, sequences lists, paths text.

    Fields whose default is None are left out while they are None. Raises ``InvalidInput`` naming
    the place of a number that is not finite, or of a value that JSON does not know.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise InvalidInput(place, f"{value} is not finite; write null for what is not known")
        return float(value)
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        pairs = ((field.name, getattr(value, field.name), field) for field in fields(value))
        kept = {name: v for name, v, field in pairs if v is not None or field.default is not None}
        return as_json(kept, place)
    if isinstance(value, Mapping):
        return {str(name): as_json(inner, f"{place}.{name}") for name, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, bytes):
        return [as_json(inner, f"{place}[{index}]") for index, inner in enumerate(value)]
    raise InvalidInput(place, f"{type(value).__name__} has no form in JSON")


def write_result(out: Path | str, result: Result) -> None:
    """Write a result whole, with the folder it belongs in; to standard output for ``-``."""
    text = text_of(result)
    if str(out) == STANDARD_OUTPUT:
        sys.stdout.write(text)
        return
    path = Path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text)


def text_of(result: Result) -> str:
    """Return the text of a result file; a list of numbers alone is on one line."""
    return NUMBERS.sub(_on_a_line, json.dumps(result, indent=1, allow_nan=False)) + "\n"


def _on_a_line(numbers: re.Match[str]) -> str:
    return "".join(numbers[0].split())


def read_result(path: Path, kind: str | None = None) -> dict[str, Any]:
    """Return the content of a result file.

    Raises ``InvalidInput`` for a file that is no result, or of another ``kind`` than the one asked
    for.
    """
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InvalidInput("result", f"{path} is not JSON: {error}") from None
    found = result.get("kind") if isinstance(result, dict) else None
    if not isinstance(found, str):
        raise InvalidInput("result", f"{path} is no result file: it has no `kind`")
    if kind is not None and found != kind:
        raise InvalidInput("result", f"{path} holds a result of kind {found!r}, not {kind!r}")
    assert isinstance(result, dict)
    return result


def rows_of(row_type: type[T], rows: Iterable[Mapping[str, Any]]) -> list[T]:
    """Return rows of a result as the dataclass they were written from.

    Names are checked, values are not. Raises ``InvalidInput`` for a row that lacks a field without
    a default, or has one the type does not know.
    """
    assert is_dataclass(row_type)
    known = {field.name for field in fields(row_type)}
    needed = {field.name for field in fields(row_type) if field.default is MISSING}
    made: list[T] = []
    for number, row in enumerate(rows):
        missing, unknown = sorted(needed - set(row)), sorted(set(row) - known)
        if missing or unknown:
            faults = [f"lacks {', '.join(missing)}"] * bool(missing)
            faults += [f"has unknown {', '.join(unknown)}"] * bool(unknown)
            what = f"row {number} {' and '.join(faults)}: {row_type.__name__} does not read it"
            raise InvalidInput("result", what)
        made.append(cast(T, row_type(**row)))
    return made
