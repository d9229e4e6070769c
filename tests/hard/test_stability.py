"""Every hard case holds, and the recorded result is what came of them."""

import json
from pathlib import Path

import pytest

from hard.cases import CASES
from hard.cases.case import Case, refusal, statement, within
from hard.cases.page import case_row, unmeasured
from rfcore.errors import InvalidInput

pytestmark = pytest.mark.hard

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "lab" / "results" / "stability.json"


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.group}-{case.name}")
def test_the_case_holds(case, record_finding):
    finding = case.measure()
    record_finding(case, finding)
    assert finding.holds, f"expected {case.expected}, got {finding}"


def test_no_two_cases_are_alike():
    names = [(case.group, case.name) for case in CASES]
    assert len(set(names)) == len(names)


def test_the_result_file_has_exactly_these_cases_and_all_hold():
    rows = json.loads(RESULT.read_text())["cases"]
    listed = [(row["group"], row["name"], row["expected"]) for row in rows]
    assert listed == [(c.group, c.name, c.expected) for c in CASES], "run `make stability`"
    assert [row["name"] for row in rows if not row["holds"]] == []


def test_a_case_that_gave_no_finding_is_missed_by_name():
    cases = [Case("Poses", name, "", lambda: within(0.0, 1.0)) for name in ("one", "two")]
    row = case_row(cases[0], cases[0].measure())
    assert unmeasured(cases, [row]) == ["two"]
    assert unmeasured(cases[:1], [row]) == []


def test_nothing_is_within_a_limit_that_is_not_a_number():
    assert not within(float("nan"), 1.0).holds
    assert within(1.0, 1.0).holds
    assert not statement(False, "yes", "no").holds


def test_a_refusal_must_be_of_the_kind_and_say_the_words():
    def refuse() -> None:
        raise InvalidInput("pose", "is NaN")

    assert refusal(refuse, InvalidInput, "pose", "NaN").holds
    assert not refusal(refuse, InvalidInput, "infinite").holds
    assert not refusal(lambda: None, InvalidInput).holds
    with pytest.raises(InvalidInput):
        refusal(refuse, type("Other", (InvalidInput,), {}))
