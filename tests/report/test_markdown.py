"""The committed figures page is what the committed result files say."""

import json
from pathlib import Path

import pytest

from rfcore.errors import InvalidInput
from rfedge.report.markdown import results_page

ROOT = Path(__file__).parents[2]


def test_the_page_is_generated_from_the_result_files() -> None:
    assert (ROOT / "docs" / "results.md").read_text() == results_page(ROOT / "results")


def test_a_bench_result_becomes_a_table_with_its_provenance(tmp_path: Path) -> None:
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    rows = [{"width": 64, "sender_ms": {"render": 1.25, "total": 3.0}, "reference_ms": None}]
    result = {"case": "codec", "host": host, "revision": "abc123", "rows": rows}
    (tmp_path / "codec.json").write_text(json.dumps(result))
    page = results_page(tmp_path)
    assert "| width | sender_ms.render | sender_ms.total | reference_ms |" in page
    assert "| 64 | 1.25 | 3.00 | not run |" in page
    assert "`rfedge bench codec` at `abc123`; C, 2 cores, avx2." in page


def test_a_foreign_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"notes\.json is neither"):
        results_page(tmp_path)
