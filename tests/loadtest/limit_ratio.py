"""How many vehicles the full loop carries now, and at another revision, on this machine today.

``python tests/loadtest/limit_ratio.py REVISION OUT.json [RUNS]`` (`make load-ratio`): both search
for their limit in turn, three times, at 640x360 and 10 Hz, so that what else the machine does meets
both. Processor time is the server's a frame, with one vehicle; what the canned vehicles take is
not in it.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

TESTS = Path(__file__).parents[1]
sys.path.insert(0, str(TESTS))
from history import ROOT, code_of, git  # noqa: E402
from rfedge.loadtest.result import LimitRow  # noqa: E402
from rfedge.results import make_result, provenance, write_result  # noqa: E402

SEARCH = ("--mode", "full", "--hz", "10", "--vehicles", "1", "--find-limit", "--duration", "10")


OF_THAT_CODE = """
import sys
# the finder of an editable installation comes before every path, and knows the checkout alone
sys.meta_path[:] = [f for f in sys.meta_path if not type(f).__module__.startswith("_editable_")]
sys.path.insert(0, {root!r})
"""
"""A ``sitecustomize`` by which every process of the test runs the code under ``root``."""


def search(code: Path, work: Path) -> tuple[int, float]:
    """Return how many vehicles the code held, and what one of them costs its server: ms a frame."""
    if code != ROOT:  # what is installed is this checkout, with its extension beside it
        (work / "sitecustomize.py").write_text(OF_THAT_CODE.format(root=str(code)))
    command = [sys.executable, "-c", "from rfedge.cli import main; main()", "loadtest", *SEARCH]
    folders = ["--out", str(work / "out"), "--cache", str(work / "cache")]
    environment = os.environ | {"PYTHONPATH": str(work)}
    subprocess.run([*command, *folders], cwd=code, env=environment, check=True)
    rows = json.loads((work / "out" / "result.json").read_text())["rows"]
    (one,) = (row for row in rows if row["vehicles"] == 1)
    held = max((row["vehicles"] for row in rows if row["held"]), default=0)
    return held, 1e3 * one["server_cores"] / one["hz"]


def main(revision: str, out: str, runs: str = "3") -> None:
    commit = git("rev-parse", f"{revision}^{{commit}}").stdout.decode().strip()
    with tempfile.TemporaryDirectory() as folder:
        codes = {commit[:12]: code_of(commit, Path(folder) / "made"), "now": ROOT}
        works = {name: Path(folder) / name for name in codes}
        for work in works.values():
            work.mkdir()
        found = {name: list[tuple[int, float]]() for name in codes}
        for _ in range(int(runs)):
            for name, code in codes.items():
                found[name].append(search(code, works[name]))
    rows = [
        LimitRow(name, tuple(held for held, _ in every), median(ms for _, ms in every))
        for name, every in found.items()
    ]
    made = provenance(command=f"make load-ratio BASE={commit[:12]}")
    result = make_result("load-ratio", made, {"rows": rows, "search": " ".join(SEARCH)})
    write_result(Path(out), result)
    print(json.dumps(result["rows"], indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
