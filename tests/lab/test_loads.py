"""Rows of several load tests are kept in one file, each with how it was made."""

from dataclasses import replace
from pathlib import Path

import pytest

from lab.pages.loads import RecordedLoad, main, record
from load_runs import load_run
from rfcore.errors import InvalidInput
from rfedge.loadtest.plan import Mode
from rfedge.loadtest.run import LoadResult, Run, write_load_result
from rfedge.results import Provenance, make_result, read_result, rows_of, write_result


def recorded(path: Path, *runs: Run) -> list[RecordedLoad]:
    """Record runs in ``path`` and return all rows that are there."""
    record(path, LoadResult(runs).content)
    return rows_of(RecordedLoad, read_result(path, "loadtest")["rows"])


def test_a_recorded_row_is_replaced_by_the_same_load_and_kept_beside_others(tmp_path):
    path = tmp_path / "loadtest.json"
    recorded(path, load_run(4, held=False, mode=Mode.FULL))
    recorded(path, load_run(4, held=True, mode=Mode.FULL))
    recorded(path, load_run(100, held=False, mode=Mode.TRANSPORT, hz=30.0))
    rows = recorded(path, load_run(4, held=True, mode=Mode.FULL, hz=5.0))
    assert [(row.mode, row.vehicles, row.hz, row.held) for row in rows] == [
        ("transport", 100, 30.0, False),
        ("full", 4, 5.0, True),
        ("full", 4, 10.0, True),
    ]
    assert all(row.command and row.revision for row in rows), "each says how it was made"


def test_runs_of_one_load_are_rows_of_their_own_and_replace_those_before(tmp_path):
    one = load_run(8, held=True)
    for on_time in (90.0, 99.5):
        rows = [replace(one.row, run=n, on_time_percent=on_time + n / 10) for n in (1, 2, 3)]
        kept = recorded(tmp_path / "loadtest.json", *(replace(one, row=row) for row in rows))
    assert [(row.run, row.on_time_percent) for row in kept] == [(1, 99.6), (2, 99.7), (3, 99.8)]


def test_rows_are_not_recorded_in_another_kind_of_file(tmp_path):
    path = tmp_path / "compare.json"
    made = Provenance("rfedge eval compare", "abc123", False, {"cpu": "C"}, {})
    write_result(path, make_result("compare", made, {"rows": []}))
    before = path.read_bytes()
    with pytest.raises(InvalidInput, match="of kind 'compare', not 'loadtest'"):
        recorded(path, load_run(4, held=True))
    assert path.read_bytes() == before


def test_the_command_records_what_a_load_test_wrote(tmp_path):
    write_load_result(LoadResult([load_run(4, held=True)]), tmp_path)
    arguments = [str(tmp_path / name) for name in ("kept.json", "result.json")]
    assert main(arguments) == 0
    assert [row["vehicles"] for row in read_result(tmp_path / "kept.json")["rows"]] == [4]
    assert main([*arguments, str(tmp_path / "missing.json")]) == 2
