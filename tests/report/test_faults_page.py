"""The committed page of faults is what the committed scoreboard says."""

import json
from pathlib import Path

import pytest

from rfcore.errors import InvalidInput
from rfedge.pages.faults import faults_page

ROOT = Path(__file__).parents[2]


def test_the_page_is_generated_from_the_scoreboard() -> None:
    page = (ROOT / "docs/reliability.md").read_text()
    assert page == faults_page(ROOT / "results/faults.json"), "run `make figures`"


def test_a_row_shows_each_bound_beside_its_figure_and_a_miss_as_such(tmp_path: Path) -> None:
    row = {"fault": "it breaks", "injected_with": "a hammer", "passed": False}
    row |= {"bound": "back <= 1 s; told so", "measured": "2.5 s; yes"}
    machine = {"cpu": "C", "cores": 2, "isa": "avx2"}
    result = {"format": "rfedge-faults-1", "command": "make test-fault", "revision": "abc"}
    path = tmp_path / "faults.json"
    path.write_text(json.dumps({**result, "host": machine, "rows": [row]}))
    page = faults_page(path)
    assert "0 of 1 hold. `make test-fault` at `abc`; C, 2 cores, avx2." in page
    assert "### it breaks: **does not hold**" in page
    assert "| back <= 1 s | 2.5 s |\n| told so | yes |" in page


def test_another_result_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text("{}")
    with pytest.raises(InvalidInput, match="no result of the fault suite"):
        faults_page(path)
