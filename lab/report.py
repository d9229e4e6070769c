"""Makes a page of the results of one kind: its finding, a picture, tables, and their command.

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
    """A sentence that says what the page shows; what was found is in ``lab.pages.findings``."""
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
    report: Report,
    finding: str,
    results: Sequence[tuple[str, Result]],
    drawn: Mapping[str, Sequence[Path]],
) -> str:
    """Return the page of results by the names of their files, each with what was drawn of it.

    It opens with the finding, a sentence, and the first picture that there is.
    """
    pictures = {name: _picture(report, name, drawn.get(name, ())) for name, _ in results}
    first = next((name for name, picture in pictures.items() if picture), None)
    opening = [f"**{finding}**", pictures.pop(first) if first is not None else "", report.shows]
    sections = [_section(report, *each, pictures.get(each[0], ""), drawn) for each in results]
    texts = [f"# {report.title}", *(text for text in opening if text), *sections]
    return "\n\n".join(texts) + "\n"


def _picture(report: Report, name: str, drawn: Sequence[Path]) -> str:
    path = next((path for path in drawn if path.suffix == ".svg"), None)
    return "" if path is None else f"![{report.title}: {name}](figures/{path.name})"


def _section(
    report: Report, name: str, result: Result, picture: str, drawn: Mapping[str, Sequence[Path]]
) -> str:
    more = [path for path in drawn.get(name, ()) if path.suffix == ".svg"][1:]
    links = ", ".join(f"[{path.stem}](figures/{path.name})" for path in more)
    parts = (part.markdown() if isinstance(part, Table) else part for part in report.parts(result))
    texts = [f"## {name}", picture, *parts, f"More figures: {links}." if more else ""]
    return "\n\n".join([*(text for text in texts if text), _measured(name, result)])


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
