"""A result says how it was made, and comes back from its file as it was."""

import hashlib
import json
import math
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfedge import results
from rfedge.evaluate import Experiment
from rfedge.results import (
    Provenance,
    as_json,
    check_result_path,
    make_result,
    provenance,
    read_result,
    revision,
    rows_of,
    text_of,
    write_result,
)

MADE = Provenance("rfedge eval x", "abc123", False, {"cpu": "C"}, {})
ROOT = Path(__file__).parents[1]
RECORDED = sorted((ROOT / "lab/results").glob("*.json"))


@dataclass(frozen=True)
class Row:
    """A kind of row with everything a field can be."""

    name: str
    bytes_per_frame: float
    window_db: Sequence[float]
    by_stage: Mapping[str, float]
    measured: float | None
    reason: str | None = None


ROW = Row("a", 1.5, (32.0, 35.0), {"render": 2.0}, None)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Make a repository with a file of code and a result, both committed."""
    (tmp_path / "lab/results").mkdir(parents=True)
    for name in ("code.py", "lab/results/figure.json"):
        (tmp_path / name).write_text("1")
    for command in ("init -q", "add .", "commit -q -m first"):
        _git(tmp_path, command)
    return tmp_path


def _git(checkout: Path, command: str) -> None:
    who = ["-c", "user.name=test", "-c", "user.email=test@localhost"]
    subprocess.run(["git", "-C", str(checkout), *who, *command.split()], check=True)


# --- what is recorded in lab/results


def git(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, check=False)


def revisions_in(content: object) -> set[str]:
    """Return every revision that a result, its rows included, says it was made at."""
    if isinstance(content, list):
        return set().union(*map(revisions_in, content))
    if not isinstance(content, dict):
        return set()
    own = {content["revision"]} if isinstance(content.get("revision"), str) else set()
    return own.union(*map(revisions_in, content.values()))


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_what_is_recorded_was_made_by_committed_code_of_this_history(path):
    found = revisions_in(json.loads(path.read_text()))
    assert found
    assert not {at for at in found if not re.fullmatch(r"[0-9a-f]{7,40}", at)}
    if git("rev-parse", "--is-shallow-repository").stdout.strip() != b"false":
        pytest.skip("only a checkout with the whole history tells whether revisions are of it")
    foreign = {at for at in found if git("merge-base", "--is-ancestor", at, "HEAD").returncode}
    assert not foreign


# --- how it was made


def test_a_result_written_beside_does_not_make_the_code_dirty(checkout):
    clean = revision(checkout)
    (checkout / "lab/results/figure.json").write_text("2")
    assert revision(checkout) == clean
    assert len(clean) == 12


def test_changed_code_makes_it_dirty(checkout):
    clean = revision(checkout)
    (checkout / "code.py").write_text("2")
    assert revision(checkout) == f"{clean}-dirty"


def test_outside_a_checkout_it_is_unknown(tmp_path):
    assert revision(tmp_path) == "unknown"


@pytest.mark.parametrize(("at", "dirty"), [("abc", False), ("abc-dirty", True), ("unknown", None)])
def test_the_flag_says_whether_the_code_had_changes(at, dirty):
    assert provenance(at=at).dirty is dirty


@pytest.mark.parametrize(
    ("program", "name"),
    [
        ("/usr/bin/rfedge", "rfedge"),
        ("/usr/bin/rfedge-lab", "rfedge-lab"),
        ("/usr/lib/streetgen/__main__.py", "python -m streetgen"),
    ],
)
def test_the_command_can_be_pasted_into_a_shell(program, name, monkeypatch):
    monkeypatch.setattr(sys, "argv", [program, "eval", "a b", "c'd"])
    assert provenance(at="x").command == f"""{name} eval 'a b' 'c'"'"'d'"""


def test_inputs_are_named_as_given_with_their_digests_and_folders_left_out(tmp_path):
    file, folder = tmp_path / "f.rff", tmp_path / "drive"
    file.write_bytes(b"field")
    folder.mkdir()
    expected = {str(file): hashlib.sha256(b"field").hexdigest()}
    assert provenance([file, folder], at="x").inputs == expected


# --- writing and reading


def test_a_row_comes_back_as_it_was_written(tmp_path):
    path = tmp_path / "deep" / "x.json"
    write_result(path, make_result("test", MADE, {"rows": [ROW, replace(ROW, reason="none")]}))
    result = read_result(path, "test")
    assert list(result) == ["kind", "command", "revision", "dirty", "host", "inputs", "rows"]
    assert "reason" not in result["rows"][0]
    assert result["rows"][0]["measured"] is None
    first, second = rows_of(Row, result["rows"])
    assert as_json(first) == as_json(ROW)
    assert second.reason == "none"


def test_what_is_written_is_what_was_returned(tmp_path, capsys):
    result = make_result("test", MADE, {"rows": [ROW], "out": Path("a/b")})
    write_result(tmp_path / "x.json", result)
    write_result("-", result)
    assert json.loads((tmp_path / "x.json").read_text()) == result
    assert json.loads(capsys.readouterr().out) == result


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
        max_leaves=8,
    )
)
def test_json_holds_every_finite_value_and_no_other(value):
    if "Infinity" in json.dumps(value) and _has_infinity(value):
        with pytest.raises(InvalidInput, match="not finite"):
            as_json(value)
    else:
        assert json.loads(text_of(as_json(value))) == value


def _has_infinity(value: Any) -> bool:
    if isinstance(value, list):
        return any(map(_has_infinity, value))
    if isinstance(value, dict):
        return any(map(_has_infinity, value.values()))
    return isinstance(value, float) and math.isinf(value)


@pytest.mark.parametrize(
    ("content", "place"),
    [
        ({"rows": [{"psnr_db": math.nan}]}, r"result\.rows\[0\]\.psnr_db: nan is not finite"),
        ({"rows": [replace(ROW, bytes_per_frame=math.inf)]}, r"rows\[0\]\.bytes_per_frame: inf"),
        ({"made": {1, 2}}, r"result\.made: set has no form in JSON"),
        ({"data": b"raw"}, r"result\.data: bytes has no form"),
    ],
)
def test_what_json_cannot_hold_is_named_by_its_place(content, place):
    with pytest.raises(InvalidInput, match=place):
        make_result("test", MADE, content)


def test_a_measurement_cannot_pretend_to_have_been_made_otherwise():
    with pytest.raises(InvalidInput, match="host, revision: reserved"):
        make_result("test", MADE, {"revision": "another", "host": {}, "rows": []})


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "is not JSON"),
        ("[]", "it has no `kind`"),
        ('{"case": "compare"}', "it has no `kind`"),
        ('{"kind": 3}', "it has no `kind`"),
        ('{"kind": "ladder"}', "holds a result of kind 'ladder', not 'compare'"),
    ],
)
def test_another_file_is_refused_by_name(tmp_path, text, problem):
    path = tmp_path / "notes.json"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=rf"notes\.json.*{problem}"):
        read_result(path, "compare")


def test_a_row_of_another_shape_is_named_with_what_is_wrong():
    rows = [as_json(ROW), {**as_json(ROW), "colour": 1}]
    del rows[1]["by_stage"]
    with pytest.raises(InvalidInput, match="row 1 lacks by_stage and has unknown colour: Row does"):
        rows_of(Row, rows)


def test_a_result_is_a_json_file():
    check_result_path(Path("out/x.json"))
    with pytest.raises(InvalidInput, match=r"x\.csv must end in \.json"):
        check_result_path(Path("out/x.csv"))


# --- what is committed, and where verbs write


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_a_committed_result_says_how_it_was_made(path):
    result = read_result(path)
    json.dumps(result, allow_nan=False)
    assert {"command", "revision", "host"} < set(result)
    assert {"cpu", "cores", "isa"} <= set(result["host"])
    assert "case" not in result or result["kind"] == "bench"


def test_no_experiment_writes_over_a_tracked_file_unless_told_to():
    """Everything an experiment writes by default lies below ``out``, which is not tracked."""
    import lab.cli
    import rfedge.cli

    experiments = [each for each in Experiment.__subclasses__() if each.__module__ != __name__]
    assert {rfedge.cli.measure.EvalCompare, lab.cli.EvalAdapt} <= set(experiments)
    for experiment in experiments:
        assert Path(experiment.out).parts[:2] == ("out", "eval"), experiment
        assert Path(experiment.cells).parts[0] == "out", experiment


def test_the_host_is_described_without_a_clock():
    assert set(results.host()) == {"cpu", "cores", "isa", "python", "os"}
    assert results.host() == results.host()


def test_several_servers_say_of_each_row_whether_its_bound_held():
    result = read_result(ROOT / "lab/results/scale.json", "scale")
    for row in result["rows"]:
        assert row["held"] == (row["measured"] <= row["bound"]), row["case"]
    named = [case for run in result["runs"] for case in run["cases"]]
    assert sorted(named) == sorted(row["case"] for row in result["rows"]), "each row is of one run"
