"""Makes a page of the results of one kind: a sentence, a picture, tables, and their command.

A page is made of every result file of its kind, a section each, so that it is never typed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rfedge.report.tables import Parts, Table
from rfedge.results import Result

Draw = Callable[[Result, Path, str], list[Path]]
"""Draws a result into a folder, its first figure with the name of the result file; returns the
files."""
BAR_IN = 0.22
"""Height of a bar, in inches."""


@dataclass(frozen=True)
class Report:
    """The page of results of one kind."""

    kind: str
    title: str
    shows: str
    """A sentence that says what the page shows."""
    parts: Parts
    draw: Draw | None = None


def bars(label: str, values: Callable[[Result], Iterable[tuple[str, float]]]) -> Draw:
    """Return what draws a bar for each named value of a result; ``label`` names value and unit."""

    def draw(result: Result, folder: Path, name: str) -> list[Path]:
        from matplotlib import pyplot as plt

        from rfedge.report.charts import BLUE, STYLE, write_figure

        named = list(values(result))
        if not named:
            return []
        places = range(len(named))
        with plt.rc_context({**STYLE, "axes.grid.axis": "x"}):
            figure, axes = plt.subplots(figsize=(7.2, BAR_IN * len(named) + 0.8))
            axes.barh(places, [value for _, value in named], 0.7, color=BLUE)
            axes.set_yticks(places, [each for each, _ in named], fontsize=8)
            axes.invert_yaxis()
            axes.set_xlabel(label)
        lines = [["name", label], *([each, f"{value:.6g}"] for each, value in named)]
        return write_figure(folder / name, figure, lines)

    return draw


def page_of(
    report: Report, results: Sequence[tuple[str, Result]], drawn: Mapping[str, Sequence[Path]]
) -> str:
    """Return the page of results by the names of their files, each with what was drawn of it."""
    sections = [_section(report, *named, drawn.get(named[0], [])) for named in results]
    return "\n\n".join([f"# {report.title}", report.shows, *sections]) + "\n"


def _section(report: Report, name: str, result: Result, drawn: Sequence[Path]) -> str:
    pictures = [path for path in drawn if path.suffix == ".svg"]
    shown = [f"![{report.title}: {name}](figures/{path.name})" for path in pictures[:1]]
    more = ", ".join(f"[{path.stem}](figures/{path.name})" for path in pictures[1:])
    parts = (part.markdown() if isinstance(part, Table) else part for part in report.parts(result))
    texts = [f"## {name}", *shown, *parts, *([f"More figures: {more}."] if more else [])]
    return "\n\n".join([*texts, _measured(name, result)])


def folded(summary: str, text: str) -> str:
    """Return text that a page shows once its summary is clicked."""
    return f"<details><summary>{summary}</summary>\n\n{text}\n\n</details>"


def _measured(name: str, result: Result) -> str:
    told = (
        f"`{result['command']}` at `{result['revision']}` on {described_host(result)}; "
        f"every figure is in `{name}.json`."
    )
    return folded("How it was measured", told)


def described_host(result: Result) -> str:
    """Return the machine that a result was measured on, in words."""
    host = result["host"]
    return f"{host['cpu']}, {host['cores']} cores, {host['isa']}"
