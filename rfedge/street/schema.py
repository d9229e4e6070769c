"""TOML tables into frozen dataclasses; every error names the file, the line and the key.

A field's type is ``bool``, ``int``, ``float``, ``str`` or a tuple of numbers; bounds and choices
stand in its ``Annotated`` metadata. A key that no field has is an error, so that a typing mistake
does not silently leave a default in place. Single values are checked by ``rfcore.tables``.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from rfcore.errors import InvalidInput
from rfcore.tables import Range, Table

__all__ = ["OneOf", "TomlFile", "read_record"]

T = TypeVar("T")
HEADER = re.compile(r"\s*\[+\s*([\w.\-\"]+)\s*\]+")
KEY = re.compile(r"\s*([\w\-\"]+)\s*=")
INDEX = re.compile(r"\[\d+\]$")


@dataclass(frozen=True)
class OneOf:
    """One of these strings."""

    choices: tuple[str, ...]


class TomlFile:
    """A parsed TOML file that knows on which line each key stands; ``top`` is its own table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
            content = tomllib.loads(text)
        except OSError as error:
            raise InvalidInput("scene", f"{path}: cannot be read ({error.strerror})") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InvalidInput("scene", f"{path}: {error}") from error
        self._lines = _lines_of_keys(text)
        self.top = Table(content, self.error)

    def error(self, key: str, problem: str) -> InvalidInput:
        """Return an error at a dotted key, or at the table it would stand in."""
        place = INDEX.sub("", key)
        while place and place not in self._lines:
            place = place.rpartition(".")[0]
        line = self._lines.get(place, 1)
        return InvalidInput("scene", f"{self.path}: line {line}: {key}: {problem}")


def read_record(table: Table, kind: type[T]) -> T:
    """Return a table as the dataclass ``kind``; raise the table's error for a wrong value."""
    hints = get_type_hints(kind, include_extras=True)
    kinds = fields(kind)  # type: ignore[arg-type]
    table.require_known(sorted(field.name for field in kinds))
    values = {}
    for field in kinds:
        optional = field.default is not MISSING or field.default_factory is not MISSING
        if field.name in table or not optional:
            values[field.name] = _value(table, field.name, hints[field.name])
    try:
        return kind(**values)
    except InvalidInput as error:
        raise table.error(error.field, error.problem) from error


def _value(table: Table, key: str, hint: Any) -> Any:
    kind, *rules = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    within = next((rule for rule in rules if isinstance(rule, Range)), Range())
    if get_origin(kind) is tuple:
        return _tuple(table, key, get_args(kind), within)
    if kind is bool:
        return table.flag(key)
    if kind is str:
        choices = [rule.choices for rule in rules if isinstance(rule, OneOf)]
        return table.choice(key, choices[0]) if choices else table.text(key)
    return table.whole(key, within) if kind is int else table.number(key, within)


def _tuple(table: Table, key: str, kinds: tuple[Any, ...], within: Range) -> tuple[float, ...]:
    """Return a list of numbers: ``(float, ...)`` has any length, ``(int, int)`` exactly two."""
    items = table.items(key, None if Ellipsis in kinds else len(kinds))
    check = table.checked_whole if kinds[0] is int else table.checked
    numbers = (check(f"{key}[{i}]", item, within) for i, item in enumerate(items))
    return tuple(kinds[0](number) for number in numbers)


def _lines_of_keys(text: str) -> dict[str, int]:
    """Where tables and keys begin; a key inside a multi-line string would be found too."""
    found: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = header[1].replace('"', "")
            found.setdefault(table, number)
        elif key := KEY.match(line):
            found.setdefault(".".join(filter(None, (table, key[1].replace('"', "")))), number)
    return found
