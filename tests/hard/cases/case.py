"""A hard case: the expected result, and the result.

``tests/hard/test_stability.py`` runs every case; the run that checks them also writes the page
(``make stability``), so that the two cannot differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rfcore.errors import RfedgeError


@dataclass(frozen=True)
class Finding:
    """The result of one case.

    ``error`` is the largest difference from what is right and ``limit`` what it may be; both are
    None where the answer is yes or no.
    """

    got: str
    holds: bool
    error: float | None = None
    limit: float | None = None


@dataclass(frozen=True)
class Case:
    """One hard case: ``expected`` says what is right and by which rule it is judged."""

    group: str
    name: str
    expected: str
    measure: Callable[[], Finding]


def within(error: float, limit: float, got: str = "") -> Finding:
    """Return the finding that ``error`` is at most ``limit``; NaN never is."""
    return Finding(got or "as expected", error <= limit, float(error), float(limit))


def statement(holds: bool, got: str, otherwise: str) -> Finding:
    """Return the finding of a yes or no."""
    return Finding(got if holds else otherwise, bool(holds))


def refusal(call: Callable[[], object], error: type[RfedgeError], *words: str) -> Finding:
    """Return the finding that ``call`` raises ``error`` with a message that has every word."""
    try:
        call()
    except error as refused:
        missing = [word for word in words if word not in str(refused)]
        got = f"{type(refused).__name__}: {refused}"
        return Finding(got if not missing else f"{got} (without {missing})", not missing)
    return Finding("accepted", False)
