"""The program of docs/how-to/python.md runs as it stands there."""

import re
import subprocess
import sys

import pytest

from docs.pages import ROOT, Page
from rfedge.cli import parse

SAMPLE = ROOT / "samples" / "street" / "transforms_drive_empty.json"


@pytest.mark.sample
def test_the_program_renders_encodes_and_decodes(tmp_path):
    few = ["--size", "160x90", "--every", "8"]
    parse(["dataset", "convert", str(SAMPLE), "--out", str(tmp_path / "drive"), *few]).run()
    (tmp_path / "street.rff").symlink_to(ROOT / "samples" / "fields" / "street.rff")
    program = "\n".join(Page("how-to/python.md").blocks("python"))
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    first, *frames = done.stdout.splitlines()
    assert first == "(90, 160, 3) (90, 160) (90, 160)"
    found = [re.fullmatch(r"(\d): (\d+) bytes, ([\d.]+) dB", line) for line in frames]
    assert [line[1] for line in found] == ["0", "1", "2"]
    assert all(int(line[2]) > 20 and float(line[3]) > 20 for line in found)
