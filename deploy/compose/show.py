"""What the demo of docker-compose.yml does while it runs: docs/operations.md and its figures.

``python deploy/compose/show.py`` asks the Prometheus of the running demo, started with containers
or by ``processes.py``. It writes ``deploy/compose/measured.json`` (what each vehicle got, targets,
the newest values of every dashboard's panels), a plot of each dashboard, and the part of
docs/operations.md between its two marks. Nothing in these is typed by hand.
"""

from __future__ import annotations

import json
import os
import re
import shutil
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

__all__ = ["filled", "legend_text", "main", "section"]

PROMETHEUS = "http://localhost:9090"
SPAN_S = 300.0
STEP_S = 5.0
LIMIT_S = "0.15"
"""From capture to Ack; a bucket of ``rfedge_agent_capture_to_ack_seconds``."""
MOST_CURVES = 8
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
    """One series of a panel: seconds before now, and values."""

    name: str
    times_s: list[float]
    values: list[float]


@dataclass
class DashboardData:
    """The curves of each panel of one dashboard, by the panel's title."""

    dashboard: Dashboard
    curves: dict[str, list[Curve]] = field(default_factory=dict)


def filled(expr: str) -> str:
    """Return a panel's expression with Grafana's variables filled in."""
    expr = expr.replace("$instance", ".*")
    return expr.replace("$__rate_interval", "1m").replace("$__range", f"{SPAN_S:.0f}s")


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
                name = legend_text(query.legend, series["metric"])
                curves.append(Curve(name, [t - now_s for t in times_s], list(values)))
    return curves


def legend_text(legend: str, labels: Mapping[str, str]) -> str:
    """Return a legend with the values of its labels."""
    return re.sub(r"\{\{(\w+)\}\}", lambda label: labels.get(label[1], ""), legend).strip()


def plot(data: DashboardData, path: Path) -> None:
    """Draw a dashboard's panels side by side."""
    import matplotlib.pyplot as plt

    panels = data.dashboard.panels
    rows = (len(panels) + 2) // 3
    figure, grid = plt.subplots(rows, 3, figsize=(15, 3.2 * rows), squeeze=False)
    for axes in grid.flat:
        axes.set_visible(False)
    for panel, axes in zip(panels, grid.flat, strict=False):
        axes.set_visible(True)
        draw(panel, data.curves[panel.title], axes)
    figure.supxlabel("minutes", fontsize=9)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def draw(panel: Panel, curves: list[Curve], axes: Any) -> None:
    """Draw the curves of a panel with the largest newest values, and say how many are left out."""
    shown = sorted(curves, key=lambda curve: curve.values[-1], reverse=True)[:MOST_CURVES]
    for curve in sorted(shown, key=lambda curve: curve.name):
        axes.plot([t / 60 for t in curve.times_s], curve.values, label=curve.name, linewidth=1.2)
    left_out = f" ({len(shown)} of {len(curves)})" if len(curves) > len(shown) else ""
    axes.set_title(panel.title + left_out, fontsize=10)
    axes.set_ylabel(SYMBOL[panel.unit], fontsize=8)
    axes.tick_params(labelsize=8)
    axes.set_ylim(bottom=0)
    if any(curve.name for curve in shown):
        axes.legend(fontsize=7, loc="best", framealpha=0.6)
    if not shown:
        axes.text(0.5, 0.5, "nothing happened", ha="center", transform=axes.transAxes, fontsize=8)


def output_of(*command: str) -> str:
    """Return what a command prints; raise ``RfedgeError`` with its error output."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RfedgeError(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout.strip()


def docker_version() -> str | None:
    """Return the version of a Docker daemon that runs here, None where there is none."""
    if shutil.which("docker") is None:
        return None
    words = ("docker", "version", "--format", "{{.Server.Version}}")
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else None


def image_sizes() -> dict[str, int]:
    """Return the bytes of our images."""
    words = ("docker", "image", "inspect", "--format", "{{.Size}}")
    return {image: int(output_of(*words, image)) for image in IMAGES}


def by_instance(expr: str) -> dict[str, float]:
    """Return an instant query's values by instance, without its port."""
    found = ask("query", query=expr)["result"]
    return {
        series["metric"]["instance"].split(":")[0]: float(series["value"][1]) for series in found
    }


def vehicles() -> list[dict[str, Any]]:
    """Return, for each vehicle, its latency and which share of what it captured was in time.

    Pictures that were dropped, lost or refused count as captured and as not in time.
    """
    window = f"[{SPAN_S:.0f}s]"
    buckets = "rfedge_agent_capture_to_ack_seconds_bucket"
    quantile = f"histogram_quantile({{}}, sum by (instance, le) (increase({buckets}{window})))"
    captured = f"sum by (instance) (increase(rfedge_agent_frames_total{window}))"
    in_time = f'sum by (instance) (increase({buckets}{{le="{LIMIT_S}"}}{window}))'
    profiles = dict(re.findall(r"^LINK_(\d)=(\w+)$", (ROOT / ".env").read_text(), re.MULTILINE))
    columns = {
        "captured_per_s": by_instance(f"{captured} / {SPAN_S}"),
        "p50_ms": by_instance(f"1000 * {quantile.format(0.5)}"),
        "p99_ms": by_instance(f"1000 * {quantile.format(0.99)}"),
        "in_time": by_instance(f"{in_time} / {captured}"),
    }
    return [
        {"vehicle": name, "link": profiles[name.removeprefix("cav-")]}
        | {column: values[name] for column, values in columns.items()}
        for name in sorted(columns["in_time"])
    ]


def services() -> list[dict[str, Any]]:
    """Return the cores that each process kept busy, and its memory, as it says itself."""
    cores = by_instance(f"rate(process_cpu_seconds_total[{SPAN_S:.0f}s])")
    memory_bytes = by_instance("process_resident_memory_bytes")
    return [
        {"service": name, "cores": cores[name], "memory_bytes": memory_bytes[name]}
        for name in sorted(cores)
    ]


def ended_frames() -> dict[str, float]:
    """Return how many pictures of all vehicles ended how, since they started."""
    found = ask("query", query="sum by (result) (rfedge_agent_frames_total)")["result"]
    return {series["metric"]["result"]: float(series["value"][1]) for series in found}


def measured(dashboards: list[DashboardData]) -> dict[str, Any]:
    """Return the content of deploy/compose/measured.json."""
    docker = docker_version()
    targets = {
        f"{target['labels']['job']} {target['labels']['instance']}": target["health"]
        for target in ask("targets")["activeTargets"]
    }
    panels = {
        f"{data.dashboard.title} / {panel.title}": {
            "series": len(data.curves[panel.title]),
            "newest": {curve.name: curve.values[-1] for curve in data.curves[panel.title]},
        }
        for data in dashboards
        for panel in data.dashboard.panels
    }
    content = {
        "load_average": round(os.getloadavg()[1], 1),
        "docker": docker,
        "images_bytes": image_sizes() if docker else {},
        "settings": dict(
            re.findall(r"^(RATE_HZ|PICTURE_SIZE)=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE)
        ),
        "vehicles": vehicles(),
        "services": services(),
        "targets": targets,
        "frames": ended_frames(),
        "panels": panels,
    }
    return make_result("compose", provenance(command="python deploy/compose/show.py"), content)


def section(result: dict[str, Any]) -> str:
    """Return the generated part of docs/operations.md."""
    up = sum(health == "up" for health in result["targets"].values())
    silent = [name for name, panel in result["panels"].items() if not panel["series"]]
    frames = ", ".join(f"{count:.0f} {name}" for name, count in sorted(result["frames"].items()))
    running = f"docker {result['docker']}" if result["docker"] else "as processes, no containers"
    settings = result["settings"]
    lines = [
        f"Measured by `make operations-figures` over {SPAN_S / 60:.0f} minutes, on "
        f"{result['host']['cores']} cores of {result['host']['cpu']} ({running}): "
        f"{len(result['vehicles'])} vehicles, {settings['PICTURE_SIZE']} at "
        f"{settings['RATE_HZ']} Hz. The machine's load average was {result['load_average']:g}. "
        "Everything is in "
        "[deploy/compose/measured.json](../deploy/compose/measured.json).",
        "",
        "| vehicle | link | pictures/s | p50 to Ack | p99 to Ack | of all captured, in 150 ms |",
        "|---|---|---|---|---|---|",
        *(
            f"| {row['vehicle']} | {row['link']} | {row['captured_per_s']:.2f} | "
            f"{row['p50_ms']:.0f} ms | {row['p99_ms']:.0f} ms | {100 * row['in_time']:.2f} % |"
            for row in result["vehicles"]
        ),
        "",
        f"Prometheus: {up} of {len(result['targets'])} targets up. Pictures so far: {frames}. "
        f"Panels with data: {len(result['panels']) - len(silent)} of {len(result['panels'])}"
        + (f"; without: {', '.join(silent)}." if silent else "."),
        "",
        "| service | cores | memory |",
        "|---|---|---|",
        *(
            f"| {row['service']} | {row['cores']:.3f} | {row['memory_bytes'] / 1e6:.0f} MB |"
            for row in result["services"]
        ),
        "",
        "Decoder processes are not in a server's cores and memory. Quantiles are interpolated "
        "within a histogram's bucket: 100 to 150 ms is one.",
        "",
        *(f"- image {name}: {size / 1e6:.0f} MB" for name, size in result["images_bytes"].items()),
        *([""] if result["images_bytes"] else []),
        *(f"![{d.title}](figures/{d.uid}.svg)" for d in DASHBOARDS),
    ]
    return "\n".join(lines)


def main() -> None:
    """Write the result, the plots and the section."""
    now_s = time.time()
    dashboards = []
    for dashboard in DASHBOARDS:
        curves = {panel.title: curves_of(panel, now_s) for panel in dashboard.panels}
        dashboards.append(DashboardData(dashboard, curves))
    result = measured(dashboards)
    for data in dashboards:
        plot(data, ROOT / f"docs/figures/{data.dashboard.uid}.svg")
    write_result(ROOT / "deploy/compose/measured.json", result)
    page = ROOT / "docs/operations.md"
    before, _, rest = page.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}\n{section(result)}\n{END}{after}")


if __name__ == "__main__":
    main()
