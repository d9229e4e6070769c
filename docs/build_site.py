"""Build the documentation site: the pages of ``docs``, a reference made from the code, results.

``python docs/build_site.py`` (`make docs`) collects all pages in ``build/docs`` and has zensical
make ``build/site`` of them. A dead link is an error. ``--pages`` stops before zensical.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import importlib
import inspect
import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_type_hints
from unittest import mock

import lab.cli
import rfedge.cli
import streetgen.cli
from cav_agent.config import AgentConfig
from lab.pages.metrics import families
from mec_server.config import ServerConfig
from rfcore.program import parse_options
from rfcore.wire.instruments import Family
from rfedge.report.tables import SHOWN

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs"
RESULTS = ROOT / "lab" / "results"
BUILD = ROOT / "build" / "docs"

Parse = Callable[[Sequence[str]], object]
PROGRAMS: Mapping[str, Parse] = {
    "rfedge": rfedge.cli.parse,
    "cav-agent": lambda words: parse_options(AgentConfig, "cav-agent", words),
    "mec-server": lambda words: parse_options(ServerConfig, "mec-server", words),
    "streetgen": streetgen.cli.parse,
    "rfedge-lab": lab.cli.parse,
}

API: Mapping[str, Sequence[str]] = {
    "Fields": ("rfcore.field.load_field", "rfcore.field.RadianceField", "rfcore.field.Quality"),
    "Cameras and datasets": (
        "rfcore.camera.Camera",
        "rfcore.camera.Pose",
        "rfcore.dataset.read_dataset",
    ),
    "Rendered views": ("rfcore.views.View",),
    "Coding frames": (
        "rfcore.codec.sender.encoder.DeltaEncoder",
        "rfcore.codec.decoder.DeltaDecoder",
    ),
    "A server and an agent": ("mec_server.server.EdgeServer", "cav_agent.vehicle.Vehicle"),
    "Reading a twin": ("rfcore.wire.twin_client.TwinClient",),
    "A codec of one's own": ("rfedge.evaluate.clips.ClipCoder",),
    "Sizes of uplinks": ("rfedge.sizing.estimate",),
    "Errors": ("rfcore.errors",),
}
"""Names of the public classes and functions, by topic."""

FORMATS: Mapping[str, str] = {
    "Field archives, `.rff`": "rfcore.field.archive",
    "Splats in an archive": "rfcore.field.splat_archive",
    "Hash grids in an archive": "rfcore.field.ngp",
    "Colour layers": "rfcore.field.layer",
    "Deltas of fields": "rfcore.field.delta",
    "Coded drives, `.rfv`": "rfcore.wire.drive_file",
    "Heads of frames, on the wire and in drives": "rfcore.wire.head",
    "Answers to frames": "rfcore.wire.convert_answers",
    "Published tiles, `tiles.json`": "rfcore.wire.tile_manifest",
    "Recordings of a server": "rfcore.dataset.recorded_session",
}
FILES: Mapping[str, str] = {
    "Recordings: `camera.toml`": "rfcore.dataset.recording",
    "Rigs of cameras: `rig.toml`": "rfcore.dataset.rig",
    "Links: `rfedge link --profile`": "rfcore.link.plan",
    "Access to a server: `mec-server --access`": "mec_server.access",
}
ROWS: Mapping[str, str] = {
    "compare rows": "rfedge.evaluate.compare.rows:CompareRow",
    "compare ssim": "rfedge.evaluate.compare.rows:QualityRow",
    "compare break_even": "rfedge.evaluate.compare.rows:BreakEvenRow",
    "compare bits": "rfedge.evaluate.compare.rows:BitShareRow",
    "compare foreground": "rfedge.evaluate.compare.rows:ForegroundRow",
    "compare curves": "rfedge.evaluate.compare.rows:CurveRow",
    "never-worse rows": "rfedge.evaluate.never_worse.measure:NeverWorseRow",
    "ladder rows": "rfedge.evaluate.ladder.rows:LadderRow",
    "ladder tracking": "rfedge.evaluate.ladder.rows:TrackingRow",
    "loadtest rows": "lab.pages.loads:RecordedLoad",
    "paper tables": "lab.paper.report:PaperTable",
    "benchmark rows": "lab.benchmark.definition:BenchmarkRow",
    "detect bd_rates": "lab.detect.measure:DetectBdRow",
    "detect cost": "lab.detect.measure:CostRow",
    "detect curves": "lab.detect.measure:DetectCurveRow",
    "adapt rows": "lab.adapt.measure:AdaptRow",
    "robust crossings": "lab.robust.report:CrossingRow",
    "robust rows": "lab.robust.report:LossRow",
    "robust disturbances": "lab.robust.report:DisturbanceRow",
    "latency needed": "lab.latency.report:NeededRow",
    "latency rows": "lab.latency.report:PlayedRow",
    "latency shown": "lab.latency.report:ShownRow",
    "live ages": "lab.live.report:AgeRow",
    "live ingest": "lab.live.report:IngestRow",
    "live sources": "lab.live.report:SourceRow",
    "rig sessions": "lab.rig.report:SessionRow",
    "rig rows": "lab.rig.report:CameraRow",
    "faults rows": "lab.pages.suites:FaultRow",
    "attacks rows": "lab.pages.suites:AttackRow",
    "stability cases": "lab.pages.suites:StabilityRow",
    "world rows": "lab.servers.cases:WorldRow",
}
"""The rows that result files have: kind and key of a list, and what its rows are read as."""
VARIABLES = {
    "RFEDGE_TWIN_TOKEN": "The token of `rfedge twin --http`, which no list of processes shows.",
    "RFEDGE_MAX_FIELD_GB": "Memory that the splats of a field may take, in 10^9 bytes.",
    "DRJIT_LIBLLVM_PATH": "The LLVM that Mitsuba compiles with (`streetgen build`).",
}
GENERATED = "<!-- Made from the code by docs/build_site.py. -->\n\n"


@dataclass(frozen=True)
class Panel:
    """One frame of a help text: its title, its introduction, and its terms with what they mean."""

    title: str
    introduction: str
    items: Sequence[tuple[str, str]]


def help_text(parse: Parse, words: Sequence[str]) -> str:
    """Return what a program prints for ``--help`` after some words."""
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with (
        mock.patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1"}),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        parse([*words, "--help"])
    printed.seek(0)
    return printed.read()


def read_help(text: str) -> tuple[str, list[Panel]]:
    """Take a help text apart: what stands before the first frame, and the frames."""
    head, _, rest = text.partition("╭")
    panels = []
    for frame in re.findall(r"╭─ (.*?) ─*╮\n(.*?)╰", "╭" + rest, re.DOTALL):
        lines = [line.strip("│").rstrip()[1:] for line in frame[1].splitlines()]
        rule = next((i for i, line in enumerate(lines) if set(line) == {"─"}), -1)
        introduction = " ".join(line.strip() for line in lines[: rule + 1] if set(line) != {"─"})
        panels.append(Panel(frame[0], introduction, list(_items(lines[rule + 1 :]))))
    return head, panels


def _items(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Join the lines of each term; a term begins at the left edge, or with a bullet."""
    term, words = "", list[str]()
    for line in lines:
        bullet = line.lstrip().startswith("• ")
        if line.startswith(" ") and not bullet:
            words.append(line.strip())
            continue
        if term:
            yield term, " ".join(words).strip()
        term, _, text = re.sub(r" {2,}", "\0", line.strip().removeprefix("• ")).partition("\0")
        words = [text]
    if term:
        yield term, " ".join(words).strip()


@functools.cache
def command_pages() -> Mapping[str, str]:
    """Return a page for each program: every verb and option, as the parser has them."""
    return {
        f"commands/{name}.md": f"{GENERATED}# {name}\n\n" + "\n".join(_sections(name, parse, ()))
        for name, parse in PROGRAMS.items()
    }


def _sections(name: str, parse: Parse, words: Sequence[str]) -> Iterator[str]:
    head, panels = read_help(help_text(parse, words))
    usage, _, text = head.partition("\n\n")
    usage = re.sub(r"\s+", " ", usage.removeprefix("usage: ")).replace("[-h] ", "")
    usage = re.sub(r"\{[\w,-]+\}$", "COMMAND", usage)
    if words:
        yield f"## {name} {' '.join(words)}\n"
    yield f"```text\n{usage}\n```\n\n{escaped(text.strip())}\n"
    verbs: Sequence[tuple[str, str]] = ()
    for panel in panels:
        if panel.title == "subcommands":
            verbs = [item for item in panel.items if item[0] != "(required)"]
            continue
        items = [item for item in panel.items if item[0] != "-h, --help"]
        if items:
            if panel.introduction:
                yield f"{escaped(panel.introduction)}\n"
            kind = "argument" if panel.title == "positional arguments" else "option"
            yield table((kind, "what it does"), (_option(*item) for item in items))
    for verb, _ in verbs:
        yield from _sections(name, parse, [*words, verb])


def _option(name: str, text: str) -> Sequence[str]:
    """Return a row for an option, without defaults that say nothing."""
    text = re.sub(r" ?\(default: (None|False|True|''|)\)$", "", text)
    return code(name.replace("{None}|", "")), escaped(text)


def escaped(text: str) -> str:
    """Return plain text as Markdown that shows it."""
    return re.sub(r"([<>|*_\[\]])", r"\\\1", text)


def code(text: str) -> str:
    """Return text as code in a cell of a table."""
    return f"`{text}`".replace("|", "\\|")


def table(heads: Sequence[str], rows: Iterator[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def metrics_page() -> str:
    """Return the page of metrics: a table for each program."""
    parts = [
        GENERATED + "# Metrics\n",
        "`mec-server`, `cav-agent` and `rfedge link` serve these with `--metrics-port PORT` at "
        "`/metrics`. Histograms have buckets at the frame budgets of 200 to 0.2 Hz. No series "
        "names a vehicle unless `--metrics-per-vehicle` is given; the server then adds a label "
        "`vehicle` to those marked *. Rules and alerts: `deploy/prometheus/rules.yml`.\n",
    ]
    for program, declared in families().items():
        rows = (_metric(family) for family in sorted(declared, key=lambda family: family.name))
        parts += [f"## {program}\n", table(("metric", "kind", "labels", "what it says"), rows)]
    return "\n".join(parts)


def _metric(family: Family) -> Sequence[str]:
    per_vehicle = family.labels[:1] == ("vehicle",) and "info" not in family.name
    labels = [label for label in family.labels if not (per_vehicle and label == "vehicle")]
    name = f"`{family.name}`" + (" \\*" if per_vehicle else "")
    return name, family.kind, ", ".join(labels), escaped(family.text)


def protocol_page() -> str:
    """Return the page of the wire protocol: the protobuf definitions with their comments."""
    parts = [
        GENERATED + "# Wire protocol\n",
        "gRPC over HTTP/2. These are the definitions with their comments; "
        "[the method](../explanation/method.md) says why the messages are as they are.\n",
    ]
    parts += [
        f"## {file.name}\n\n```protobuf\n{file.read_text(encoding='utf-8')}```\n"
        for file in sorted((ROOT / "proto").rglob("*.proto"))
    ]
    return "\n".join(parts)


def row_type(name: str) -> type[Any]:
    """Return the dataclass that ``ROWS`` names."""
    module, _, row = name.partition(":")
    found: type[Any] = getattr(importlib.import_module(module), row)
    return found


def results_page() -> str:
    """Return the page of result files: the columns of every list of rows."""
    parts = [
        GENERATED + "# Result files\n",
        "A result is one JSON object: `kind`, `command`, `revision`, `dirty`, `host` and `inputs` "
        "say how it was made (`rfedge.results`), the rest is the measurement, in lists of rows. A "
        "column that is not known is left out of its row. Units are in the names; `scene` is the "
        "drive, `hz` its frames a second, `method` what coded it, `point` its CRF, "
        "`rival_` before a name the same of the rival. "
        "`rfedge.results.rows_of(type, result[key])` reads them back.\n",
    ]
    for place, name in ROWS.items():
        kind, key = place.split()
        row, columns = row_type(name), list(_columns(row_type(name)))
        text = re.sub(r"``([^`]+)``", r"`\1`", inspect.cleandoc(row.__doc__ or ""))
        parts += [
            f"## {kind}: `{key}`\n\n{text}\n",
            table(("column", "type", "what it is"), iter(columns)),
        ]
        parts.append(f"Read as `{name.replace(':', '.')}`.\n")
    return "\n".join(parts)


def _columns(row: type[Any], above: str = "") -> Iterator[Sequence[str]]:
    """Yield each column of a row with what its docstring, or its heading in tables, says; behind
    one that holds rows itself, their columns."""
    texts = {}
    for made in reversed(row.__mro__[:-1]):
        (body,) = ast.parse(inspect.cleandoc(inspect.getsource(made))).body
        assert isinstance(body, ast.ClassDef)
        for line, after in pairwise(body.body):
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                texts[line.target.id] = str(after.value.value) if documented else ""
    types = get_type_hints(row)
    for each in dataclasses.fields(row):
        heading = each.metadata.get(SHOWN, ("",))[0]
        text = texts.get(each.name) or heading
        kind = str(each.type).replace("Sequence", "list").replace("Mapping", "object")
        text = escaped(re.sub(r"\s+", " ", text.replace("``", "")))
        yield code(above + each.name), code(kind), text
        for inner in filter(dataclasses.is_dataclass, get_args(types[each.name])):
            yield from _columns(inner, f"{above}{each.name}[].")


def api_page() -> str:
    """Return the page of the Python API; mkdocstrings fills it in."""
    parts = [GENERATED + "# Python API\n"]
    for topic, names in API.items():
        parts.append(f"## {topic}\n")
        parts += [f"::: {name}\n    options:\n      heading_level: 3\n" for name in names]
    return "\n".join(parts)


def docstrings_page(title: str, introduction: str, modules: Mapping[str, str]) -> str:
    """Return a page of the docstrings of some modules, each under a heading."""
    parts = [f"{GENERATED}# {title}\n\n{introduction}\n"]
    for heading, name in modules.items():
        text = importlib.import_module(name).__doc__ or ""
        text = re.sub(r"``([^`]+)``", r"`\1`", re.sub(r"::$", ":", text, flags=re.MULTILINE))
        parts.append(f"## {heading}\n\n{text.strip()}\n\nDefined in `{name}`.\n")
    return "\n".join(parts)


def configuration_page() -> str:
    """Return the page of configuration: files and environment variables."""
    variables = table(
        ("variable", "what it sets"), ((f"`{name}`", text) for name, text in VARIABLES.items())
    )
    introduction = (
        "The programs are configured by their options ([mec-server](commands/mec-server.md), "
        "[cav-agent](commands/cav-agent.md)) and by these files. A key that is not known is an "
        f"error.\n\n## Environment variables\n\n{variables}"
    )
    return docstrings_page("Configuration", introduction, FILES)


def option_names(program: str) -> set[str]:
    """Return every option of a program and its verbs, as ``--name``."""
    page = command_pages()[f"commands/{program}.md"]
    return {"--help", *re.findall(r"--[a-z][a-z0-9-]*", page)}


def reference_names() -> list[str]:
    """Return the names of the generated pages under ``reference``."""
    programs = [f"commands/{name}.md" for name in PROGRAMS]
    return [
        *programs,
        "configuration.md",
        "protocol.md",
        "files.md",
        "results.md",
        "metrics.md",
        "python.md",
    ]


def reference() -> dict[str, str]:
    """Return the generated pages by their names under ``reference``."""
    return {
        **command_pages(),
        "configuration.md": configuration_page(),
        "protocol.md": protocol_page(),
        "files.md": docstrings_page("File formats", "Files that rfedge writes.", FORMATS),
        "results.md": results_page(),
        "metrics.md": metrics_page(),
        "python.md": api_page(),
    }


def collect(folder: Path = BUILD) -> None:
    """Put all pages of the site into a folder that is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(PAGES, folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for name, text in reference().items():
        file = folder / "reference" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "streetgen" / "README.md", folder / "reference" / "streets.md")
    for page in sorted(RESULTS.glob("*.md")):
        (folder / "results").mkdir(exist_ok=True)
        shutil.copy(page, folder / "results" / page.name)
    if (RESULTS / "figures").is_dir():
        shutil.copytree(RESULTS / "figures", folder / "results" / "figures")
    for page in folder.rglob("*.md"):
        page.write_text(on_site(page.read_text(encoding="utf-8")), encoding="utf-8")


def on_site(text: str) -> str:
    """Return a page whose links out of ``docs`` lead to where the site has those pages."""
    text = re.sub(r"\]\((\.\./)+lab/results/", "](../results/", text)
    text = re.sub(r"\]\((\.\./)+docs/", "](../", text)
    text = re.sub(r"\]\((\.\./)+streetgen/README\.md", "](../reference/streets.md", text)
    return text.replace("<details>", '<details markdown="1">')


def main(arguments: Sequence[str]) -> int:
    """Build the site; return the exit status."""
    collect()
    if "--pages" in arguments:
        return 0
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = re.sub(r"\x1b\[[0-9;]*m", "", built.stdout + built.stderr)
    print(said.partition("Traceback (most recent")[0].strip())
    return built.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
