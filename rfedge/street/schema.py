"""TOML tables into frozen dataclasses; every error names the file, the line and the key.

A field's type is ``bool``, ``int``, ``float``, ``str`` or a tuple of numbers; bounds and choices
stand in its ``Annotated`` metadata. A key that no field has is an error, so that a typing mistake
does not silently leave a default in place.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from rfcore.errors import InvalidInput

__all__ = ["OneOf", "Range", "TomlFile"]

T = TypeVar("T")
HEADER = re.compile(r"\s*\[+\s*([\w.\-\"]+)\s*\]+")
KEY = re.compile(r"\s*([\w\-\"]+)\s*=")
KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a string"}


@dataclass(frozen=True)
class Range:
    """A number of at least ``low`` and at most ``high``."""

    low: float
    high: float


@dataclass(frozen=True)
class OneOf:
    """One of these strings."""

    choices: tuple[str, ...]


class TomlFile:
    """A parsed TOML file that knows on which line each key stands."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
            self.content = tomllib.loads(text)
        except OSError as error:
            raise InvalidInput("scene", f"{path}: cannot be read ({error.strerror})") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InvalidInput("scene", f"{path}: {error}") from error
        self._lines = _lines_of_keys(text)

    def error(self, key: str, problem: str) -> InvalidInput:
        """Return an error at a dotted key, or at the table it would stand in."""
        place = key
        while place and place not in self._lines:
            place = place.rpartition(".")[0]
        line = self._lines.get(place, 1)
        return InvalidInput("scene", f"{self.path}: line {line}: {key}: {problem}")

    def require_known(self, key: str, table: Mapping[str, Any], known: set[str]) -> None:
        """Raise for the first key of ``table`` that is not known."""
        for name in table:
            if name not in known:
                raise self.error(_joined(key, name), f"is none of {', '.join(sorted(known))}")

    def table(self, key: str) -> Mapping[str, Any]:
        """Return the table at a dotted key, empty if it is not there."""
        found: Any = self.content
        for name in key.split(".") if key else ():
            found = found.get(name, {}) if isinstance(found, dict) else found
        if not isinstance(found, dict):
            raise self.error(key, "is not a table")
        return found

    def read(self, key: str, kind: type[T]) -> T:
        """Return the table at ``key`` as a dataclass; raise ``InvalidInput``."""
        table = self.table(key)
        hints = get_type_hints(kind, include_extras=True)
        known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
        self.require_known(key, table, known)
        values = {}
        for field in fields(kind):  # type: ignore[arg-type]
            place = _joined(key, field.name)
            if field.name in table:
                values[field.name] = self._value(place, table[field.name], hints[field.name])
            elif field.default is MISSING and field.default_factory is MISSING:
                raise self.error(place, "is missing")
        try:
            return kind(**values)
        except InvalidInput as error:
            raise self.error(_joined(key, error.field), error.problem) from error

    def _value(self, key: str, value: Any, hint: Any) -> Any:
        kind, *rules = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if get_origin(kind) is tuple:
            return self._tuple(key, value, get_args(kind), rules)
        whole_for_float = kind is float and isinstance(value, int) and not isinstance(value, bool)
        if type(value) is not kind and not whole_for_float:
            raise self.error(key, f"is {value!r}, not {KINDS[kind]}")
        self._check(key, value, rules)
        return float(value) if kind is float else value

    def _tuple(self, key: str, value: Any, kinds: tuple[Any, ...], rules: list[Any]) -> Any:
        open_ended = len(kinds) == 2 and kinds[1] is Ellipsis
        if not isinstance(value, list) or not (open_ended or len(value) == len(kinds)):
            wanted = "a list" if open_ended else f"a list of {len(kinds)}"
            raise self.error(key, f"is {value!r}, not {wanted}")
        each = [kinds[0]] * len(value) if open_ended else kinds
        pairs = zip(value, each, strict=True)
        return tuple(self._value(key, v, Annotated[k, *rules] if rules else k) for v, k in pairs)

    def _check(self, key: str, value: Any, rules: list[Any]) -> None:
        for rule in rules:
            if isinstance(rule, OneOf) and value not in rule.choices:
                raise self.error(key, f"is {value!r}, none of {', '.join(rule.choices)}")
            if isinstance(rule, Range) and not (
                math.isfinite(value) and rule.low <= value <= rule.high
            ):
                raise self.error(key, f"is {value!r}, outside {rule.low:g}..{rule.high:g}")


def _joined(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _lines_of_keys(text: str) -> dict[str, int]:
    """Where tables and keys begin; a key inside a multi-line string would be found too."""
    found: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = header[1].replace('"', "")
            found.setdefault(table, number)
        elif key := KEY.match(line):
            found.setdefault(_joined(table, key[1].replace('"', "")), number)
    return found
