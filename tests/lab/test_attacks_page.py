"""The page of attacks shows every bound beside its figure, and counts what holds."""

from pathlib import Path
from typing import Any

import pytest

from lab.pages.attacks import AttackRow, attacks_page
from rfcore.errors import InvalidInput
from rfedge.results import Provenance, make_result, write_result

ROOT = Path(__file__).parents[2]
MADE = Provenance("make test-attack", "abc", False, {"cpu": "C", "cores": 2, "isa": "avx2"}, {})
HELD = AttackRow("junk: Bytes.", "vehicle", "p99 <= 9 ms; alive", "8 ms; yes", 8.0, held=True)
MISSED = AttackRow("flood: Calls.", "none", "p99 <= 9 ms; alive", "99 ms; no", 99.0, held=False)


def recorded(path: Path, *rows: Any, kind: str = "attacks") -> Path:
    write_result(path, make_result(kind, MADE, {"rows": rows}))
    return path


def test_the_page_is_generated_from_the_scoreboard() -> None:
    page = (ROOT / "docs/attacks.md").read_text()
    assert page == attacks_page(ROOT / "lab/results/attacks.json"), "run `make figures`"


def test_each_attack_is_there_with_its_verdict_and_those_that_hold_are_counted(
    tmp_path: Path,
) -> None:
    page = attacks_page(recorded(tmp_path / "attacks.json", HELD, MISSED))
    assert "1 of 2 hold. `make test-attack` at `abc`; C, 2 cores, avx2." in page
    assert "## junk: holds\n\nBytes. Certificate: vehicle.\n" in page
    assert "## flood: **does not hold**\n\nCalls. Certificate: none.\n" in page
    assert "| p99 <= 9 ms | 99 ms |\n| alive | no |" in page


def test_another_result_or_a_bound_without_its_figure_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="of kind 'faults', not 'attacks'"):
        attacks_page(recorded(tmp_path / "faults.json", HELD, kind="faults"))
    row = AttackRow("junk: Bytes.", "vehicle", "p99 <= 9 ms; alive", "8 ms", 8.0, held=True)
    with pytest.raises(InvalidInput, match="junk: 2 bounds and 1 figures"):
        attacks_page(recorded(tmp_path / "attacks.json", row))
