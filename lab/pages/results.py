"""``docs/results.md`` and the figures of the experiments, from the result files: never typed.

``python -m lab.pages.results results docs README.md`` (``make figures``). Tests hold the
committed pages to the committed files.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lab.adapt.measure import adapt_section
from lab.bench import bench_section
from lab.benchmark.definition import benchmark_section
from lab.classes.measure import classes_section
from lab.latency.report import latency_section, write_latency_figures
from lab.live.report import live_section
from lab.localisation.rows import localise_section
from lab.pages.demo import demo_section
from lab.pages.loads import load_section, ratio_section
from lab.pages.training import training_section
from lab.paper.figures import write_paper_figures
from lab.paper.report import paper_rows, paper_section
from lab.rig.report import rig_section
from lab.robust.report import robust_section, write_robust_figure
from lab.servers.cases import scale_section, world_section
from lab.soak import soak_section
from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfedge.evaluate.compare.figures import write_bd_rates, write_compare_figures
from rfedge.evaluate.compare.report import compare_section, harder_sentence, headline
from rfedge.evaluate.ladder.page import write_ladder_figure
from rfedge.evaluate.never_worse.measure import never_worse_section
from rfedge.report.tables import heading, plain_section
from rfedge.results import Result, read_result

__all__ = ["results_page", "with_headline", "write_figures"]

INTRODUCTION = """# Measured figures

Generated from `lab/results/*.json` by `make figures`; each table names its command, revision and
host.
Machines are shared and noisy: compare within a table, not across hosts.
"""


HEADLINE_BEGINS = (
    "<!-- made from lab/results/compare.json and compare-harder.json by `make figures` -->"
)
HEADLINE_RESULTS = ("compare", "compare-harder")
HEADLINE_ENDS = "<!-- end -->"

SECTIONS: Mapping[str, Callable[[Path, Result], str]] = {
    "adapt": adapt_section,
    "attacks": lambda path, result: _reference(path, result, "attacks", "attacks"),
    "bench": bench_section,
    "benchmark": benchmark_section,
    "classes": classes_section,
    "compare": compare_section,
    "demo": demo_section,
    "faults": lambda path, result: _reference(path, result, "faults", "reliability"),
    "ladder": lambda path, result: _reference(path, result, "rungs", "ladder"),
    "latency": latency_section,
    "live": live_section,
    "loadtest": load_section,
    "load-ratio": ratio_section,
    "localise": localise_section,
    "never-worse": never_worse_section,
    "paper": paper_section,
    "rig": rig_section,
    "robust": robust_section,
    "scale": scale_section,
    "seams": plain_section,
    "slice-coder": plain_section,
    "soak": soak_section,
    "stability": lambda path, result: _reference(path, result, "cases", "stability"),
    "tail": plain_section,
    "world": world_section,
}
"""How each kind of result is shown; some have a page of their own."""


def results_page(folder: Path, figures: Mapping[str, Sequence[Path]] | None = None) -> str:
    """Return the page of every result file in ``folder``, in the order of their names, each with
    what ``write_figures`` drew of it.

    Training runs, in ``folder/train``, share one table at the end. Raises ``InvalidInput`` for a
    folder without results, and for a file that holds none of the known kinds.
    """
    drawn = figures or {}
    sections = [
        _section(path) + _images(drawn.get(path.stem, ())) for path in sorted(folder.glob("*.json"))
    ]
    runs = sorted(folder.glob("train/*.json"))
    if runs:
        sections.append(training_section(runs))
    if not sections:
        raise InvalidInput("results", f"{folder} holds no result file (*.json, train/*.json)")
    return "\n".join([INTRODUCTION, *sections])


def _section(path: Path) -> str:
    result = read_result(path)
    if result["kind"] not in SECTIONS:
        known = ", ".join(SECTIONS)
        raise InvalidInput("results", f"{path}: kind {result['kind']!r} is none of {known}")
    return SECTIONS[result["kind"]](path, result)


def _images(figures: Sequence[Path]) -> str:
    """Return the drawings among the files of a section's figures, below it."""
    return "".join(
        f"\n![{path.stem.replace('_', ' ')}](figures/{path.name})\n"
        for path in figures
        if path.suffix == ".svg"
    )


DRAWINGS: Mapping[str, Callable[[Result, Path], list[Path]]] = {
    "compare": write_compare_figures,
    "compare-harder": lambda result, out: write_bd_rates(result, out, "bd_rates_harder"),
    "ladder": write_ladder_figure,
    "latency": write_latency_figures,
    "paper": lambda result, out: write_paper_figures(paper_rows(result), out),
    "robust": write_robust_figure,
    "robust-long": lambda result, out: write_robust_figure(result, out, "loss_ssim_long"),
}
"""Figures of the result files that have some, by their names."""


def write_figures(folder: Path, out: Path) -> dict[str, list[Path]]:
    """Draw the results of ``folder`` that have figures into ``out``; return the files of each."""
    found = [path for path in sorted(folder.glob("*.json")) if path.stem in DRAWINGS]
    return {path.stem: DRAWINGS[path.stem](read_result(path), out) for path in found}


def _reference(path: Path, result: Result, noun: str, page: str) -> str:
    """Return how many rows there are, and the page that shows them."""
    rows = result["cases"] if noun == "cases" else result["rows"]
    return f"{heading(path, result)}\n\n{len(rows)} {noun}: `docs/{page}.md`.\n"


def with_headline(page: str, compared: Result, harder: Result) -> str:
    """Return a page with the headline of a comparison, and of one of harder drives, between its
    two marks.

    Raises ``InvalidInput`` for a page without them.
    """
    before, mark, rest = page.partition(HEADLINE_BEGINS)
    _, end, after = rest.partition(HEADLINE_ENDS)
    if not (mark and end):
        raise InvalidInput("page", f"it lacks {HEADLINE_BEGINS!r} ... {HEADLINE_ENDS!r}")
    told = f"{headline(compared)}\n\n{harder_sentence(harder)}"
    return f"{before}{mark}\n\n{told}\n\n{end}{after}"


def main(results: Path, docs: Path) -> None:
    """Write page and figures."""
    figures = write_figures(results, docs / "figures")
    write_whole(docs / "results.md", results_page(results, figures))


def write_headline(results: Path, readme: Path) -> None:
    """Write the headline of what is compared in ``results`` into the README."""
    told = (read_result(results / f"{name}.json", "compare") for name in HEADLINE_RESULTS)
    write_whole(readme, with_headline(readme.read_text(), *told))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
    write_headline(Path(sys.argv[1]), Path(sys.argv[3]))
