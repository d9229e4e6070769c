"""A table gives what was written and nothing else; what is wrong is named by path and limit."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.tables import Range, Table, shortened

Take = Callable[[Table], object]

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=12,
)
TAKERS: dict[str, Take] = {
    "number": lambda table: table.number("key", Range(0.0, 10.0)),
    "whole": lambda table: table.whole("key", Range(0, 10)),
    "text": lambda table: table.text("key"),
    "flag": lambda table: table.flag("key"),
    "choice": lambda table: table.choice("key", ("up", "down")),
    "items": lambda table: table.items("key", 2),
    "numbers": lambda table: table.numbers("key", 2, Range(0.0, 10.0)),
    "matrix": lambda table: table.matrix("key", ((2, 2), (1, 2))),
    "table": lambda table: table.table("key"),
}
GOOD: dict[str, list[Any]] = {
    "number": [0, 10, 2.5],
    "whole": [0, 10, 3.0],
    "text": ["a", "two words"],
    "flag": [True, False],
    "choice": ["up", "down"],
    "items": [[1, "a"]],
    "numbers": [[0, 10], [1.5, 2]],
    "matrix": [[[1, 2], [3, 4]], [[1.5, 2]]],
    "table": [{}, {"a": 1}],
}


def table(values: object, path: str = "") -> Table:
    return Table(values, InvalidInput, path)


@pytest.mark.parametrize(("kind", "value"), [(k, v) for k, good in GOOD.items() for v in good])
def test_a_good_value_comes_back_as_it_was_written(kind, value):
    taken = TAKERS[kind](table({"key": value}))
    if isinstance(taken, Table):
        assert all(taken.value(key) == value[key] for key in value)
        taken.finish()
    else:
        assert taken == value


@pytest.mark.parametrize("kind", TAKERS)
@pytest.mark.parametrize("path", ["", "up.link"])
def test_a_missing_key_is_named_with_its_path(kind, path):
    with pytest.raises(InvalidInput, match="is missing") as caught:
        TAKERS[kind](table({"other": 1}, path))
    assert caught.value.field == ("up.link.key" if path else "key")


ALLOWED: dict[str, Callable[[Any], bool]] = {
    "number": lambda taken: isinstance(taken, float) and 0 <= taken <= 10,
    "whole": lambda taken: type(taken) is int and 0 <= taken <= 10,
    "text": lambda taken: isinstance(taken, str) and taken.isprintable() and taken != "",
    "flag": lambda taken: isinstance(taken, bool),
    "choice": lambda taken: taken in ("up", "down"),
    "items": lambda taken: isinstance(taken, list) and len(taken) == 2,
    "numbers": lambda taken: len(taken) == 2 and all(0 <= number <= 10 for number in taken),
    "matrix": lambda taken: all(math.isfinite(number) for row in taken for number in row),
    "table": lambda taken: isinstance(taken, Table),
}


@pytest.mark.parametrize("kind", TAKERS)
@given(value=json_values)
def test_any_value_is_taken_as_its_kind_or_refused_by_its_key(kind, value):
    """Nothing of another kind gets through, and no value breaks the checker."""
    refused: list[InvalidInput] = []
    try:
        assert ALLOWED[kind](TAKERS[kind](table({"key": value})))
    except InvalidInput as error:
        refused.append(error)
    assert all(error.field.startswith("key") for error in refused)
    assert all("\n" not in error.problem for error in refused)


@given(st.floats() | st.integers(), st.floats(-1e6, 1e6), st.floats(0, 1e6))
def test_a_number_is_taken_exactly_if_it_is_finite_and_within(value, low, span):
    within = Range(low, low + span)
    inside = low <= value <= low + span
    assert (within.problem(value) is None) == inside
    if not inside:
        with pytest.raises(InvalidInput, match=r"is .*, outside "):
            table({"key": value}).number("key", within)


@pytest.mark.parametrize(
    ("kind", "value", "field", "problem"),
    [
        ("number", True, "key", "is True, not a number"),
        ("number", "4", "key", "is '4', not a number"),
        ("number", math.nan, "key", "is nan, outside 0..10"),
        ("number", 10.5, "key", "is 10.5, outside 0..10"),
        ("number", 10**400, "key", "outside 0..10"),
        ("whole", 2.5, "key", "is 2.5, not a whole number"),
        ("whole", True, "key", "is True, not a whole number"),
        ("whole", math.inf, "key", "is inf, outside 0..10"),
        ("text", "", "key", "is an empty string"),
        ("text", "a\x1b[0m", "key", "not printable"),
        ("flag", 1, "key", "is 1, not true or false"),
        ("choice", "left", "key", "is 'left', none of up, down"),
        ("choice", ["up"], "key", r"is \['up'\], none of up, down"),
        ("items", [1], "key", r"is \[1\], not a list of 2"),
        ("numbers", [1, math.nan], "key[1]", "is nan, outside 0..10"),
        ("matrix", [[1, 2, 3]], "key", r"not 2x2 or 1x2 numbers"),
        ("matrix", [[1, 2], [3]], "key", r"not 2x2 or 1x2 numbers"),
        ("matrix", [], "key", r"is \[\], not 2x2"),
        ("matrix", [[1, 2], [3, None]], "key[1][1]", "is None, not a number"),
        ("matrix", [[1, math.inf]], "key[0][1]", "is inf, must be finite"),
        ("table", [], "key", r"is \[\], not a table"),
    ],
)
def test_a_wrong_value_is_named_with_its_limit(kind, value, field, problem):
    with pytest.raises(InvalidInput, match=problem) as caught:
        TAKERS[kind](table({"key": value}))
    assert caught.value.field == field


def test_a_default_stands_for_a_missing_key_and_is_checked_too():
    assert table({}).number("key", Range(0, 1), 0.5) == 0.5
    assert table({"key": 0.25}).number("key", Range(0, 1), 0.5) == 0.25
    with pytest.raises(InvalidInput, match=r"is 2, outside 0\.\.1"):
        table({}).number("key", Range(0, 1), 2)


def test_a_key_that_nobody_asked_for_is_refused_with_those_that_are_known():
    section = table({"rate": 1, "dleay": 2}, "uplink")
    section.number("rate")
    section.number("delay", default=0.0)
    with pytest.raises(InvalidInput, match="is none of burst, delay, rate") as caught:
        section.finish("burst")
    assert caught.value.field == "uplink.dleay"


def test_the_error_is_what_the_format_makes_of_path_and_problem():
    def fail(path: str, problem: str) -> Exception:
        return LookupError(f"file.json at {path}, which {problem}")

    with pytest.raises(LookupError, match=r"file\.json at a, which is missing"):
        Table({}, fail).value("a")
    with pytest.raises(LookupError, match=r"file\.json at , which is 3, not a table"):
        Table(3, fail)


@given(json_values)
def test_what_an_error_shows_of_a_value_is_one_short_line(value):
    shown = shortened(value)
    assert len(shown) <= 63
    assert "\n" not in shown


def test_a_number_of_too_many_digits_is_shown_by_words():
    assert shortened(10**5000) == "a number of more digits than are printed"
