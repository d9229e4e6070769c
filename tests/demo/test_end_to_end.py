"""The whole demo on a tiny street: real processes, a real link, a real decoder."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tyro
from tyro.conf import OmitSubcommandPrefixes

from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfedge.cli import Verb
from rfedge.demo.report import figures_of


def demo(sample: Path, work: Path) -> subprocess.CompletedProcess[str]:
    code = "import sys; from rfedge.cli import main; sys.exit(main())"
    options = {"sample": sample, "out": work / "demo", "cache": work / "cache"}
    options |= {"iterations": 60, "gaussians": 400, "link-bps": 4e6, "link-delay-ms": 1}
    arguments = [part for name, value in options.items() for part in (f"--{name}", str(value))]
    return subprocess.run(
        [sys.executable, "-c", code, "demo", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.timeout(60)  # eight processes in turn: 8 s on two idle cores, more beside other tests
def test_the_server_ends_up_with_the_vehicles_pictures(tiny_sample, tmp_path):
    done = demo(tiny_sample, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((tmp_path / "demo" / "result.json").read_text())
    assert set(figures_of(result)) == {"empty", "vehicles"}
    for entry in result["sequences"].values():
        assert entry["frames"] == entry["frames_reconstructed"] == entry["digest_matches"] == 4
        assert entry["payload_bytes"] < entry["packet_bytes"] < entry["wire_bytes"]
        assert entry["psnr_db"] > entry["rf_psnr_db"], "the delta improves on the render"
    in_a_browser(done.stdout)
    page = (tmp_path / "demo" / "report.html").read_text()
    assert re.findall(r"(?:src|href)=.(?!data:|#)[^>]*", page) == [], "the page is self-contained"
    assert (tmp_path / "demo" / "reconstructed.mp4").stat().st_size > 0


def in_a_browser(said: str) -> None:
    """The line that the demo ends with names a field and a drive that `rfedge twin` takes."""
    (command,) = re.findall(r"^in a browser: \S*rfedge (.*)$", said, re.MULTILINE)
    verb: Any = tyro.cli(Verb, args=shlex.split(command), config=(OmitSubcommandPrefixes,))
    assert load_field(Path(verb.target)).primitives > 0
    assert len(read_dataset(verb.drive).pictures) == 4


def test_a_damaged_sample_is_one_clear_error_and_nothing_is_written(tiny_sample, tmp_path):
    victim = tiny_sample / "drive_empty" / "001.png"
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    done = demo(tiny_sample, tmp_path)
    assert done.returncode == 2
    assert "drive_empty/001.png" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "demo").exists()
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("keeper", ["thesis.tex", "sub/notes.txt"])
def test_a_folder_the_demo_did_not_make_is_not_emptied(tiny_sample, tmp_path, keeper):
    precious = tmp_path / "demo" / keeper
    precious.parent.mkdir(parents=True)
    precious.write_text("mine")
    done = demo(tiny_sample, tmp_path)
    assert done.returncode == 2
    assert "name another folder" in done.stderr
    assert precious.read_text() == "mine"
