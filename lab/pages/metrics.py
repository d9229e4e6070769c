"""``docs/metrics.md`` from the metrics that the processes declare.

python -m lab.pages.metrics > docs/metrics.md
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from prometheus_client import CollectorRegistry

from cav_agent.metrics import AgentMetrics
from mec_server.metrics import ServerMetrics
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.state import Twin
from rfcore.wire.instruments import Family
from rfedge.link.metrics import LinkMetrics

__all__ = ["families", "metrics_page"]

OPENING = """# Metrics

Generated from the code by `make figures`; do not edit.

`mec-server`, `cav-agent` and `rfedge link` serve these with `--metrics-port PORT` at `/metrics`.
Histograms have buckets at the frame budgets of 200 to 0.2 Hz. No metric tells vehicles apart unless
`--metrics-per-vehicle` is given, since every vehicle would leave time series behind for ever: the
server then adds a label `vehicle` to those marked *, and drops a vehicle's series when its last
stream ends; an agent, which is a target of its own, exports `rfedge_agent_info`.

Recording rules and alerts over these metrics are in `deploy/prometheus/rules.yml`.
"""


def families() -> Mapping[str, Sequence[Family]]:
    """Return what each command declares, with everything that a flag can add."""
    agent = AgentMetrics(CollectorRegistry())
    agent.identify("cav-1", "front")
    server = ServerMetrics(CollectorRegistry(), per_vehicle=True)
    TwinMetrics(server.instruments, Twin(), per_vehicle=True)
    return {
        "mec-server": server.instruments.families,
        "cav-agent": agent.instruments.families,
        "rfedge link": LinkMetrics(CollectorRegistry()).instruments.families,
    }


def metrics_page() -> str:
    """Return the page: a table for each command."""
    tables = (_table(command, declared) for command, declared in families().items())
    return "\n".join([OPENING, *tables])


def _table(command: str, declared: Sequence[Family]) -> str:
    rows = (_row(family) for family in sorted(declared, key=lambda family: family.name))
    head = f"## `{command}`\n\n| metric | kind | labels | what |\n|---|---|---|---|\n"
    return head + "".join(rows)


def _row(family: Family) -> str:
    mark = " *" if family.labels[:1] == ("vehicle",) and "info" not in family.name else ""
    labels = ", ".join(label for label in family.labels if not (mark and label == "vehicle"))
    return f"| `{family.name}`{mark} | {family.kind} | {labels} | {family.text} |\n"


if __name__ == "__main__":
    print(metrics_page(), end="")
