"""The makefiles of recorded results use commands and options that exist."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

import lab.cli
import rfedge.cli
import streetgen.cli

ROOT = Path(__file__).parents[2]
PARSERS = {
    "rfedge": rfedge.cli.parse,
    "rfedge-lab": lab.cli.parse,
    "streetgen": streetgen.cli.parse,
}


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize(
    ("makefile", "target", "least"),
    [("lab/record.mk", "results-full", 40), ("lab/adapt/record.mk", "record", 15)],
)
def test_every_command_that_records_is_one(makefile: str, target: str, least: int) -> None:
    told = subprocess.run(
        ["make", "-n", "-B", "-f", makefile, target, "MAKE=:"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    lines = told.stdout.replace("\\\n", " ").splitlines()
    parsed = 0
    for line in lines:
        name = Path(line.partition(" ")[0]).name
        if name in PARSERS and "$" not in line and "&&" not in line:
            PARSERS[name](shlex.split(line)[1:])
            parsed += 1
    assert parsed >= least
