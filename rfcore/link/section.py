"""One section of a link profile: its values are taken out one by one, and none may be left over.

Raises ``InvalidInput`` naming the section, the key, the value and what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput

__all__ = ["Section"]

REQUIRED = object()


class Section:
    """A table of the profile; ``folder`` is where its files are looked for."""

    def __init__(self, name: str, values: Any, folder: Path) -> None:
        if not isinstance(values, Mapping):
            raise InvalidInput(name, f"{values!r} must be a section")
        self.name = name
        self._folder = folder
        self._left = dict(values)
        self._asked: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def take(self, key: str, default: Any = REQUIRED) -> Any:
        """Return a value as it stands in the file."""
        self._asked.add(key)
        value = self._left.pop(key, default)
        if value is REQUIRED:
            raise InvalidInput(f"{self.name}.{key}", "is missing")
        return value

    def number(self, key: str, limits: tuple[float, float], default: Any = REQUIRED) -> float:
        """Return a finite number within ``limits``."""
        value = self.take(key, default)
        return self.checked(key, value, limits)

    def checked(self, key: str, value: Any, limits: tuple[float, float]) -> float:
        """Return ``value`` if it is a number within ``limits``."""
        lowest, highest = limits
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (is_number and math.isfinite(value) and lowest <= value <= highest):
            raise InvalidInput(
                f"{self.name}.{key}", f"{value!r} must be a number in {lowest:g}..{highest:g}"
            )
        return float(value)

    def path(self, key: str) -> Path:
        """Return the path of a file beside the profile."""
        value = self.take(key)
        if not isinstance(value, str) or not value:
            raise InvalidInput(f"{self.name}.{key}", f"{value!r} must be the name of a file")
        return self._folder / value

    def section(self, key: str) -> Section:
        """Return a section within this one."""
        return Section(f"{self.name}.{key}".removeprefix("."), self.take(key), self._folder)

    def finish(self) -> None:
        """Refuse what nobody asked for: a misspelt key shall not be ignored."""
        if self._left:
            key = min(self._left)
            known = ", ".join(sorted(self._asked))
            name = f"{self.name}.{key}".removeprefix(".")
            raise InvalidInput(name, f"is not known here; known are {known}")
