"""The revision a figure names is that of the code it was taken with."""

import subprocess
from pathlib import Path

import pytest

from rfedge.results import revision


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Make a repository with a file of code and a result, both committed."""
    (tmp_path / "results").mkdir()
    for name in ("code.py", "results/figure.json"):
        (tmp_path / name).write_text("1")
    for command in ("init -q", "add .", "commit -q -m first"):
        _git(tmp_path, command)
    return tmp_path


def _git(checkout: Path, command: str) -> None:
    who = ["-c", "user.name=test", "-c", "user.email=test@localhost"]
    subprocess.run(["git", "-C", str(checkout), *who, *command.split()], check=True)


def test_a_result_written_beside_does_not_make_the_code_dirty(checkout: Path) -> None:
    clean = revision(checkout)
    (checkout / "results" / "figure.json").write_text("2")
    assert revision(checkout) == clean
    assert len(clean) == 12


def test_changed_code_makes_it_dirty(checkout: Path) -> None:
    clean = revision(checkout)
    (checkout / "code.py").write_text("2")
    assert revision(checkout) == f"{clean}-dirty"


def test_outside_a_checkout_it_is_unknown(tmp_path: Path) -> None:
    assert revision(tmp_path) == "unknown"
