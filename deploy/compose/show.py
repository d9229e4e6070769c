"""What the demo of docker-compose.yml does, while it runs: into docs/operations.md and two files.

``python deploy/compose/show.py`` asks docker and Prometheus of the running demo. It writes
``deploy/compose/measured.json`` (images, states of the services, targets, the series and the newest
values of every dashboard's panel), a plot of each dashboard, and the part of docs/operations.md
between its two marks. Nothing in these is typed by hand.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from rfcore.errors import RfedgeError  # noqa: E402
from rfedge.dashboards.catalogue import DASHBOARDS  # noqa: E402
from rfedge.dashboards.grafana import Dashboard, Panel, Unit  # noqa: E402
from rfedge.results import make_result, provenance, write_result  # noqa: E402

__all__ = ["filled", "main", "section"]

PROMETHEUS = "http://localhost:9090"
SPAN_S = 600.0
STEP_S = 5.0
BEGIN, END = "<!-- compose: begin -->", "<!-- compose: end -->"
IMAGES = ("rfedge-runtime:local", "rfedge-full:local")
SYMBOL = {
    Unit.BITS_PER_S: "bit/s",
    Unit.BYTES: "bytes",
    Unit.COUNT: "",
    Unit.PER_S: "1/s",
    Unit.SECONDS: "s",
    Unit.SHARE: "share",
}


@dataclass(frozen=True)
class Curve:
    """One series of a panel: when (s) and what."""

    name: str
    times_s: list[float]
    values: list[float]


@dataclass
class Shown:
    """The curves of each panel of one dashboard."""

    dashboard: Dashboard
    curves: dict[str, list[Curve]] = field(default_factory=dict)


def filled(expr: str) -> str:
    """Return a panel's expression with Grafana's variables filled in."""
    expr = expr.replace("$instance", ".*")
    return expr.replace("$__rate_interval", "1m").replace("$__range", "10m")


def ask(path: str, **parameters: str) -> Any:
    """Return what Prometheus answers; raise ``RfedgeError`` without an answer."""
    url = f"{PROMETHEUS}/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
    try:
        with urllib.request.urlopen(url, timeout=30) as answer:
            return json.load(answer)["data"]
    except OSError as error:
        raise RfedgeError(f"{PROMETHEUS}: {error}; run `make up` first") from error


def curves_of(panel: Panel, now_s: float) -> list[Curve]:
    """Return the series of a panel over the last minutes."""
    curves = []
    for query in panel.queries:
        found = ask(
            "query_range",
            query=filled(query.expr),
            start=str(now_s - SPAN_S),
            end=str(now_s),
            step=str(STEP_S),
        )["result"]
        for series in found:
            points = [(float(t), float(v)) for t, v in series["values"] if v != "NaN"]
            if points:
                times_s, values = zip(*points, strict=True)
                name = named(query.legend, series["metric"])
                curves.append(Curve(name, [t - now_s for t in times_s], list(values)))
    return curves


def named(legend: str, labels: Mapping[str, str]) -> str:
    """Return a legend with the values of its labels."""
    return re.sub(r"\{\{(\w+)\}\}", lambda label: labels.get(label[1], ""), legend)


def plot(shown: Shown, path: Path) -> None:
    """Draw a dashboard's panels side by side."""
    import matplotlib.pyplot as plt

    panels = shown.dashboard.panels
    rows = (len(panels) + 2) // 3
    figure, grid = plt.subplots(rows, 3, figsize=(13, 2.6 * rows), squeeze=False)
    for axes in grid.flat:
        axes.set_visible(False)
    for panel, axes in zip(panels, grid.flat, strict=False):
        axes.set_visible(True)
        for curve in shown.curves[panel.title][:8]:
            times_min = [t / 60 for t in curve.times_s]
            axes.plot(times_min, curve.values, label=curve.name, linewidth=1)
        axes.set_title(panel.title, fontsize=9)
        axes.set_ylabel(SYMBOL[panel.unit], fontsize=7)
        axes.tick_params(labelsize=7)
        axes.set_ylim(bottom=0)
        if shown.curves[panel.title]:
            axes.legend(fontsize=5, loc="best")
    figure.supxlabel("minutes", fontsize=8)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def said(*command: str) -> str:
    """Return the output of a docker command; raise ``RfedgeError`` with what it says."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RfedgeError(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout.strip()


def services() -> list[dict[str, str]]:
    """Return each container of the demo: service, state, memory and CPU of now, first log line."""
    form = '{{.ID}}\t{{.Label "com.docker.compose.service"}}\t{{.Status}}'
    listed = said("docker", "ps", "-a", "--filter", "label=com.docker.compose.service",
                  "--format", form)  # fmt: skip
    stats = dict(
        line.split("\t", 1)
        for line in said(
            "docker", "stats", "--no-stream", "--format", "{{.ID}}\t{{.CPUPerc}}\t{{.MemUsage}}"
        ).splitlines()
    )
    rows = []
    for line in sorted(listed.splitlines(), key=lambda text: text.split("\t")[1]):
        container, service, status = line.split("\t")
        cpu, _, memory = stats.get(container, "\t").partition("\t")
        rows.append({"service": service, "status": status, "cpu": cpu, "memory": memory})
    return rows


def log_lines() -> list[str]:
    """Return what a roadside server and a vehicle said first."""
    lines = []
    for service in ("certificates", "rsu-a", "cav-1"):
        container = said("docker", "ps", "-aq", "--filter",
                         f"label=com.docker.compose.service={service}")  # fmt: skip
        done = subprocess.run(["docker", "logs", container], capture_output=True, text=True)
        lines += [f"{service} | {line}" for line in (done.stdout + done.stderr).splitlines()[:6]]
    return lines


def ended_frames() -> dict[str, float]:
    """Return how many pictures of all vehicles ended how, since they started."""
    found = ask("query", query="sum by (result) (rfedge_agent_frames_total)")["result"]
    return {series["metric"]["result"]: float(series["value"][1]) for series in found}


def measured(shown: list[Shown]) -> dict[str, Any]:
    """Return the content of deploy/compose/measured.json."""
    sizes = {
        image: int(said("docker", "image", "inspect", image, "--format", "{{.Size}}"))
        for image in IMAGES
    }
    targets = {
        f"{target['labels']['job']} {target['labels']['instance']}": target["health"]
        for target in ask("targets")["activeTargets"]
    }
    panels = {
        f"{one.dashboard.title} / {panel.title}": {
            "series": len(one.curves[panel.title]),
            "newest": {curve.name: curve.values[-1] for curve in one.curves[panel.title][:8]},
        }
        for one in shown
        for panel in one.dashboard.panels
    }
    content = {
        "docker": said("docker", "version", "--format", "{{.Server.Version}}"),
        "images_bytes": sizes,
        "services": services(),
        "targets": targets,
        "frames": ended_frames(),
        "panels": panels,
        "log": log_lines(),
    }
    return make_result("compose", provenance(command="python deploy/compose/show.py"), content)


def section(result: dict[str, Any]) -> str:
    """Return the generated part of docs/operations.md."""
    up = sum(health == "up" for health in result["targets"].values())
    silent = [name for name, panel in result["panels"].items() if not panel["series"]]
    frames = ", ".join(f"{count:.0f} {name}" for name, count in sorted(result["frames"].items()))
    lines = [
        f"Measured by `make operations-figures` on {result['host']['cores']} cores of "
        f"{result['host']['cpu']}, docker {result['docker']}; everything is in "
        "[deploy/compose/measured.json](../deploy/compose/measured.json).",
        "",
        "| image | MB |",
        "|---|---|",
        *(f"| {name} | {size / 1e6:.0f} |" for name, size in result["images_bytes"].items()),
        "",
        f"Prometheus: {up} of {len(result['targets'])} targets up. Pictures so far: {frames}. "
        f"Panels with data: {len(result['panels']) - len(silent)} of {len(result['panels'])}"
        + (f"; without: {', '.join(silent)}." if silent else "."),
        "",
        "| service | state | CPU | memory |",
        "|---|---|---|---|",
        *(
            f"| {row['service']} | {row['status']} | {row['cpu']} | {row['memory']} |"
            for row in result["services"]
        ),
        "",
        "```",
        *(line[:160] for line in result["log"]),
        "```",
        "",
        *(f"![{d.title}](figures/{d.uid}.svg)" for d in DASHBOARDS),
    ]
    return "\n".join(lines)


def main() -> None:
    """Write the result, the plots and the section."""
    now_s = time.time()
    shown = []
    for dashboard in DASHBOARDS:
        one = Shown(dashboard, {p.title: curves_of(p, now_s) for p in dashboard.panels})
        plot(one, ROOT / f"docs/figures/{dashboard.uid}.svg")
        shown.append(one)
    result = measured(shown)
    write_result(ROOT / "deploy/compose/measured.json", result)
    page = ROOT / "docs/operations.md"
    before, _, rest = page.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}\n{section(result)}\n{END}{after}")


if __name__ == "__main__":
    main()
