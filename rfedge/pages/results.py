"""Write ``docs/results.md`` from the result files: figures are generated, never typed.

``python -m rfedge.pages.results results > docs/results.md`` (``make figures``). A test holds the
committed page to the committed files.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rfcore.errors import InvalidInput
from rfedge.bench.results import flattened
from rfedge.demo.report import METRIC, SUMMARY
from rfedge.experiments.latency.report import latency_section
from rfedge.experiments.robust.report import robust_section
from rfedge.loadtest.result import load_section
from rfedge.pages.codec_evidence import compare_section, never_worse_section, paper_section
from rfedge.report.markdown_parts import Row, cell, heading, table
from rfedge.training.report import training_section

__all__ = ["results_page"]

INTRODUCTION = """# Measured figures

Generated from `results/*.json` by `make figures`; each table names its command, revision and host.
Machines are shared and noisy: compare within a table, not across hosts.
"""


SECTIONS = {
    "compare": compare_section,
    "latency": latency_section,
    "never-worse": never_worse_section,
    "paper": paper_section,
    "robust": robust_section,
}


def results_page(folder: Path) -> str:
    """Return the page of every result file in ``folder``, in the order of their names.

    Training runs, in ``folder/train``, share one table at the end. Raises ``InvalidInput`` for a
    file that holds none of the known results.
    """
    sections = [_section(path) for path in sorted(folder.glob("*.json"))]
    runs = sorted(folder.glob("train/*.json"))
    if runs:
        sections.append(training_section(runs))
    return "\n".join([INTRODUCTION, *sections])


def _section(path: Path) -> str:
    result = json.loads(path.read_text())
    if result.get("format") == "rfedge-demo-1":
        return _demo(path, result)
    if result.get("format") == "rfedge-stability-1":
        return f"{heading(path, result)}\n\n{len(result['cases'])} cases: `docs/stability.md`.\n"
    if result.get("case") == "ladder":
        return f"{heading(path, result)}\n\n{len(result['rows'])} rungs: `docs/ladder.md`.\n"
    if result.get("format") == "rfedge-faults-1":
        return f"{heading(path, result)}\n\n{len(result['rows'])} faults: `docs/reliability.md`.\n"
    if result.get("case") in SECTIONS:
        return SECTIONS[result["case"]](path, result)
    if result.get("case") == "loadtest":
        return load_section(path, result)
    if "case" in result:
        return _bench(path, result)
    raise InvalidInput("results", f"{path} is neither a demo nor a bench result")


def _demo(path: Path, result: Row) -> str:
    sequences = result["sequences"]
    rows = [
        [f"{label} ({note})", *(show(entry) for entry in sequences.values())]
        for label, note, show in SUMMARY
    ]
    rows += [
        [f"100·I/(I+P) with {label}", *(f"{s[key]:.1f} %" for s in sequences.values())]
        for label, key in METRIC
    ]
    settings, field = result["settings"], result["field"]
    facts = (
        f"Field of {field['gaussians']:,} Gaussians, {field['held_out_psnr_db']:.2f} dB on the "
        f"held-out empty drive; x264 {settings['preset']}, CRF {settings['crf']:g}, "
        f"{settings['rate_hz']:g} Hz, link {settings['link_bps'] / 1e6:g} Mbit/s and "
        f"{settings['link_delay_ms']:g} ms."
    )
    return "\n\n".join([heading(path, result), facts, table(["", *sequences], rows), ""])


def _bench(path: Path, result: Row) -> str:
    rows = [flattened(row) for row in result["rows"]]
    columns = list(rows[0])
    cells = [[cell(row[column]) for column in columns] for row in rows]
    return "\n\n".join([heading(path, result), table(columns, cells), ""])


if __name__ == "__main__":
    sys.stdout.write(results_page(Path(sys.argv[1])))
