"""Take values out of a JSON or TOML table by key, and check them one by one.

A ``Table`` knows where it stands in its document as a dotted path (``uplink.outage``). What is
wrong with a value is raised as ``fail(path, problem)`` says, so that each format keeps its own
error class and its own way to say where: file and section, or file and line. A problem names the
value and the limit it broke. Keys that were never asked for are refused by ``finish``: a misspelt
key must not silently leave a default in place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Fail = Callable[[str, str], Exception]
"""Makes the error to raise of a dotted path and of what is wrong there."""

REQUIRED: Any = object()
"""Stands for "no default": the key must be there."""

MAX_SHOWN = 60


@dataclass(frozen=True)
class Range:
    """A finite number of at least ``low`` and at most ``high``."""

    low: float = -math.inf
    high: float = math.inf

    def problem(self, value: float) -> str | None:
        """Return what is wrong with ``value``, None if it lies within."""
        as_float = _float(value)
        if math.isfinite(as_float) and self.low <= value <= self.high:
            return None
        if math.isfinite(self.high):
            return f"is {shortened(value)}, outside {self.low:g}..{self.high:g}"
        if not math.isfinite(as_float):
            return f"is {shortened(value)}, must be finite"
        return f"is {shortened(value)}, must be at least {self.low:g}"


ANY_NUMBER = Range()


class Table:
    """A table of a document at the dotted ``path``, the empty one being the document's own.

    Raises what ``fail`` makes when ``values`` is no table, and in every method for a key that is
    missing without a default or has another kind of value than it is asked for.
    """

    def __init__(self, values: object, fail: Fail, path: str = "") -> None:
        if not isinstance(values, Mapping):
            raise fail(path, f"is {shortened(values)}, not a table")
        self.path = path
        self.values = values
        self._fail = fail
        self._asked: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def error(self, key: str, problem: str) -> Exception:
        """Return the error for a key of this table."""
        return self._fail(f"{self.path}.{key}" if self.path else key, problem)

    def value(self, key: str, default: Any = REQUIRED) -> Any:
        """Return a value as it stands in the document, or ``default``."""
        self._asked.add(key)
        value = self.values.get(key, default)
        if value is REQUIRED:
            raise self.error(key, "is missing")
        return value

    def number(self, key: str, within: Range = ANY_NUMBER, default: Any = REQUIRED) -> float:
        """Return a finite number."""
        return float(self.checked(key, self.value(key, default), within))

    def whole(self, key: str, within: Range = ANY_NUMBER, default: Any = REQUIRED) -> int:
        """Return a whole number; one that is written as ``3.0`` counts."""
        return self.checked_whole(key, self.value(key, default), within)

    def checked(self, key: str, value: object, within: Range = ANY_NUMBER) -> float:
        """Return ``value``, found at ``key``, if it is a number within the range."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, f"is {shortened(value)}, not a number")
        if problem := within.problem(value):
            raise self.error(key, problem)
        return value

    def checked_whole(self, key: str, value: object, within: Range = ANY_NUMBER) -> int:
        """Return ``value``, found at ``key``, if it is a whole number within the range."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, f"is {shortened(value)}, not a whole number")
        number = self.checked(key, value, within)
        if number != int(number):
            raise self.error(key, f"is {shortened(value)}, not a whole number")
        return int(number)

    def text(self, key: str, default: Any = REQUIRED) -> str:
        """Return a string that is not empty and can be printed."""
        value = self.value(key, default)
        if not isinstance(value, str):
            raise self.error(key, f"is {shortened(value)}, not a string")
        if not value:
            raise self.error(key, "is an empty string")
        if not value.isprintable():
            raise self.error(key, f"is {shortened(value)}, which is not printable")
        return value

    def flag(self, key: str, default: Any = REQUIRED) -> bool:
        """Return true or false."""
        value = self.value(key, default)
        if not isinstance(value, bool):
            raise self.error(key, f"is {shortened(value)}, not true or false")
        return value

    def choice(self, key: str, choices: Iterable[str], default: Any = REQUIRED) -> str:
        """Return one of the strings ``choices``."""
        value, known = self.value(key, default), tuple(choices)
        if not isinstance(value, str) or value not in known:
            raise self.error(key, f"is {shortened(value)}, none of {', '.join(known)}")
        return value

    def items(self, key: str, count: int | None = None, default: Any = REQUIRED) -> list[Any]:
        """Return a list, of ``count`` entries if that is given."""
        value = self.value(key, default)
        if not isinstance(value, list | tuple) or count not in (None, len(value)):
            wanted = "a list" if count is None else f"a list of {count}"
            raise self.error(key, f"is {shortened(value)}, not {wanted}")
        return list(value)

    def numbers(
        self, key: str, count: int | None = None, within: Range = ANY_NUMBER
    ) -> list[float]:
        """Return a list of finite numbers."""
        values = enumerate(self.items(key, count))
        return [float(self.checked(f"{key}[{i}]", value, within)) for i, value in values]

    def matrix(self, key: str, shapes: Sequence[tuple[int, int]]) -> list[list[float]]:
        """Return the rows of a matrix of finite numbers with one of these (rows, columns)."""
        rows = self.value(key)
        sizes = {len(row) for row in rows if isinstance(row, list)} if _is_rows(rows) else set()
        if len(sizes) != 1 or (len(rows), *sizes) not in shapes:
            wanted = " or ".join(f"{height}x{width}" for height, width in shapes)
            raise self.error(key, f"is {shortened(rows)}, not {wanted} numbers")
        return [
            [float(self.checked(f"{key}[{i}][{j}]", value)) for j, value in enumerate(row)]
            for i, row in enumerate(rows)
        ]

    def table(self, key: str, default: Any = REQUIRED) -> Table:
        """Return the table at ``key``."""
        path = f"{self.path}.{key}" if self.path else key
        return Table(self.value(key, default), self._fail, path)

    def require_known(self, known: Iterable[str]) -> None:
        """Raise for the first key of this table that is not among ``known``."""
        names = tuple(known)
        for key in self.values:
            if key not in names:
                raise self.error(key, f"is none of {', '.join(names)}")

    def finish(self, *optional: str) -> None:
        """Raise for the first key that was never asked for and is not ``optional`` either."""
        self.require_known(sorted({*self._asked, *optional}))


def _is_rows(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(row, list) for row in value)


def shortened(value: object) -> str:
    """Return a value as an error shows it: on one line, at most 60 characters of it."""
    try:
        shown = repr(value)
    except ValueError:
        return "a number of more digits than are printed"
    return shown if len(shown) <= MAX_SHOWN else shown[:MAX_SHOWN] + "..."


def _float(value: float) -> float:
    """Return ``value`` as float; a whole number beyond every float is infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf
