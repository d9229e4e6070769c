"""``make figures``: pages and pictures of all recorded results, and the headline of the README.

``python -m lab.pages`` writes ``lab/results/KIND.md`` for every kind of result, ``losses.md``,
``index.md`` that sums up and lists them, ``figures/``, and what stands between two marks in
``README.md``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from lab.adapt.measure import REPORT as ADAPT
from lab.benchmark.definition import REPORT as BENCHMARK
from lab.classes.measure import REPORT as CLASSES
from lab.cli import Verb
from lab.cold_start import REPORT as COLD_START
from lab.detect.measure import REPORT as DETECT
from lab.head import REPORT as HEAD
from lab.latency.report import REPORT as LATENCY
from lab.live.report import REPORT as LIVE
from lab.localisation.measure import REPORT as LOCALISE
from lab.pages.findings import FINDINGS
from lab.pages.loads import LOADS, RATIO
from lab.pages.losses import losses_parts
from lab.pages.product import REPORTS, headline
from lab.pages.sizing import REPORT as SIZING
from lab.pages.suites import ATTACKS, FAULTS, RESULTS, STABILITY
from lab.pages.summary import comparisons, summary_parts, write_summary_figures
from lab.paper.figures import REPORT as PAPER
from lab.report import Report, page_of
from lab.rig.report import REPORT as RIG
from lab.robust.report import REPORT as ROBUST
from lab.servers.cases import SCALE, WORLD
from lab.soak import REPORT as SOAK
from lab.tcp.run import REPORT as TCP
from lab.truth.run import REPORT as LIVE_TRUTH
from lab.webrtc.report import REPORT as WEBRTC
from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfcore.program import verbs_of
from rfedge.report.tables import Table
from rfedge.results import Result, read_result
from rfedge.sizing.tables import SHIPPED

CHECKOUT = RESULTS.parents[1]
README_BEGINS, README_ENDS = "<!-- headline: generated -->", "<!-- headline: end -->"
KINDS: Mapping[str, Report] = {
    report.kind: report
    for report in (
        *REPORTS[:4],
        *(PAPER, BENCHMARK, CLASSES, DETECT, ADAPT, HEAD, LATENCY, ROBUST, TCP, LOCALISE, SIZING),
        WEBRTC,
        *(LOADS, RATIO, RIG, LIVE, LIVE_TRUTH, COLD_START, WORLD, SCALE),
        *(FAULTS, ATTACKS, STABILITY, SOAK),
        *REPORTS[4:],
    )
}
"""Every kind of result with how it is shown, in the order of the index."""
INDEX = "# Recorded results"
PAGES = """## Every page

Every page is generated from the JSON files beside it by `make figures`, and names the command,
revision and machine of its figures. Machines are shared and noisy: compare within a table, not
across machines.
"""
LOSSES = "# Where it loses"

Recorded = dict[str, list[tuple[str, Result]]]


def recorded(folder: Path = RESULTS) -> Recorded:
    """Return the results of a folder by their kind, each with its file's name.

    Raises ``InvalidInput`` for a kind that no page shows.
    """
    found: Recorded = {}
    files = [*folder.glob("*.json"), *folder.glob("train/*.json"), SHIPPED]
    for path in sorted(files, key=lambda path: path.stem):
        result = read_result(path)
        if result["kind"] not in KINDS:
            raise InvalidInput("results", f"{path}: nothing shows kind {result['kind']!r}")
        found.setdefault(result["kind"], []).append((path.stem, result))
    return found


def write_figures(results: Recorded, folder: Path) -> dict[str, list[Path]]:
    """Draw every result into ``folder``; return the files by the name of the result."""
    drawn = {}
    for kind, named in results.items():
        draw = KINDS[kind].draw
        for name, result in named if draw is not None else ():
            assert draw is not None
            drawn[name] = draw(result, folder, name)
    drawn["index"] = write_summary_figures(comparisons(results["compare"]), folder)
    return drawn


def pages(results: Recorded, drawn: Mapping[str, Sequence[Path]]) -> dict[str, str]:
    """Return the text of each page by its name, index and losses among them."""
    shown = [report for kind, report in KINDS.items() if kind in results]
    texts = {}
    for report in shown:
        named = results[report.kind]
        page = page_of(report, FINDINGS[report.kind](named), named, drawn)
        texts[report.kind] = _with_moved(page)
    lines = [f"* [{report.title}]({report.kind}.md): {report.shows}" for report in shown]
    lines.insert(
        0, "* [Where it loses](losses.md): Where it sends more bits, takes longer or waits."
    )
    opening = _texts(INDEX, summary_parts(comparisons(results["compare"])))
    losses = _texts(LOSSES, losses_parts(results))
    return {**texts, "losses": losses, "index": "\n".join([opening, PAGES, *lines, ""])}


def _texts(title: str, parts: Iterable[str | Table]) -> str:
    """Return paragraphs and tables below a title."""
    texts = (part.markdown() if isinstance(part, Table) else part for part in parts)
    return "\n\n".join([title, *texts]) + "\n"


def _with_moved(page: str) -> str:
    """Return a page that says what a command is called now that was one of ``rfedge``."""
    names = "|".join(verbs_of(Verb))
    return re.sub(
        rf"^(`(rfedge (?:eval )?({names}))\b.*)$",
        r"\1 `\2` is now `rfedge-lab \3`.",
        page,
        flags=re.M,
    )


def with_headline(page: str, results: Recorded) -> str:
    """Return the README with the headline of the comparisons between its two marks.

    Raises ``InvalidInput`` for a page without the marks.
    """
    before, mark, rest = page.partition(README_BEGINS)
    _, end, after = rest.partition(README_ENDS)
    if not (mark and end):
        raise InvalidInput("page", f"it lacks {README_BEGINS!r} ... {README_ENDS!r}")
    named = dict(results["compare"])
    told = headline(named["compare"], named["compare-harder"], named.get("compare-size"))
    return f"{before}{mark}\n\n{told}\n\n{end}{after}"


def main() -> None:
    """Write all pages, figures and the headline."""
    results = recorded()
    drawn = write_figures(results, RESULTS / "figures")
    for name, text in pages(results, drawn).items():
        write_whole(RESULTS / f"{name}.md", text)
    readme = CHECKOUT / "README.md"
    write_whole(readme, with_headline(readme.read_text(encoding="utf-8"), results))


if __name__ == "__main__":
    main()
