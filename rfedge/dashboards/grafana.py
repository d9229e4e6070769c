"""What a dashboard is made of. Expressions are PromQL.

``$instance`` stands for the targets chosen above the panels, ``$__rate_interval`` for a time that
holds at least four scrapes.

Grafana's JSON of a dashboard (schema version 39, Grafana 10.4 and later).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from rfcore.errors import InvalidInput

__all__ = [
    "DATASOURCE",
    "Dashboard",
    "Panel",
    "PanelKind",
    "Query",
    "Unit",
    "dashboard_text",
    "share_of",
    "stages_of",
]


class Unit(StrEnum):
    """Grafana's names of units."""

    BITS_PER_S = "bps"
    BYTES = "bytes"
    COUNT = "short"
    PER_S = "hertz"
    SECONDS = "s"
    SHARE = "percentunit"


class PanelKind(StrEnum):
    """Grafana's names of panel types."""

    LINES = "timeseries"
    NUMBER = "stat"
    TABLE = "table"


@dataclass(frozen=True)
class Query:
    """One PromQL expression and how its lines are called."""

    expr: str
    legend: str = "{{instance}}"


@dataclass(frozen=True)
class Panel:
    """One picture of one quantity; ``stacked`` lines add up to a whole."""

    title: str
    description: str
    unit: Unit
    queries: tuple[Query, ...]
    kind: PanelKind = PanelKind.LINES
    stacked: bool = False

    def __post_init__(self) -> None:
        if not (self.title and self.description.endswith(".") and self.queries):
            raise InvalidInput("panel", f"{self.title!r} needs a description and a query")


@dataclass(frozen=True)
class Dashboard:
    """``job``: whose targets can be chosen; of several parts of a system, the one looked at."""

    uid: str
    title: str
    description: str
    job: str
    panels: tuple[Panel, ...]


def share_of(part: str, whole: str) -> str:
    """Return the expression of a share, which is absent, not NaN, while there is no whole."""
    return f"{part} / ({whole} > 0)"


def stages_of(metric: str) -> str:
    """Return the expression of the mean time by stage."""
    return share_of(
        f"sum by (stage) (rate({metric}_sum{{instance=~'$instance'}}[$__rate_interval]))",
        f"sum by (stage) (rate({metric}_count{{instance=~'$instance'}}[$__rate_interval]))",
    )


DATASOURCE = {"type": "prometheus", "uid": "prometheus"}
"""The uid is the one of deploy/grafana/provisioning/datasources/prometheus.yaml."""
COLUMNS, WIDTH, HEIGHT = 2, 12, 8


def dashboard_text(dashboard: Dashboard) -> str:
    """Return the content of a dashboard's file."""
    return json.dumps(_dashboard(dashboard), indent=1) + "\n"


def _dashboard(dashboard: Dashboard) -> dict[str, Any]:
    return {
        "uid": dashboard.uid,
        "title": dashboard.title,
        "description": dashboard.description,
        "tags": ["rfedge"],
        "schemaVersion": 39,
        "version": 1,
        "editable": False,
        "timezone": "browser",
        "refresh": "5s",
        "time": {"from": "now-15m", "to": "now"},
        "templating": {"list": [_instances(dashboard.job)]},
        "links": [
            {"type": "dashboards", "title": "rfedge", "tags": ["rfedge"], "asDropdown": True}
        ],
        "panels": [_panel(index, panel) for index, panel in enumerate(dashboard.panels)],
    }


def _instances(job: str) -> dict[str, Any]:
    return {
        "name": "instance",
        "label": job,
        "type": "query",
        "datasource": DATASOURCE,
        "query": {"query": f'label_values(up{{job="{job}"}}, instance)', "refId": "instances"},
        "refresh": 2,
        "includeAll": True,
        "multi": True,
        "allValue": ".*",
        "current": {"text": "All", "value": "$__all"},
        "sort": 1,
    }


def _panel(index: int, panel: Panel) -> dict[str, Any]:
    row, column = divmod(index, COLUMNS)
    return {
        "id": index + 1,
        "type": str(panel.kind),
        "title": panel.title,
        "description": panel.description,
        "datasource": DATASOURCE,
        "gridPos": {"x": column * WIDTH, "y": row * HEIGHT, "w": WIDTH, "h": HEIGHT},
        "targets": [
            {
                "refId": chr(ord("A") + number),
                "datasource": DATASOURCE,
                "expr": query.expr,
                "legendFormat": query.legend,
                "instant": panel.kind is PanelKind.TABLE,
                "range": panel.kind is not PanelKind.TABLE,
                "format": "table" if panel.kind is PanelKind.TABLE else "time_series",
            }
            for number, query in enumerate(panel.queries)
        ],
        "fieldConfig": {"defaults": _defaults(panel), "overrides": []},
        "options": {"legend": {"displayMode": "list", "placement": "bottom", "showLegend": True}}
        if panel.kind is PanelKind.LINES
        else {},
    }


def _defaults(panel: Panel) -> dict[str, Any]:
    defaults: dict[str, Any] = {"unit": str(panel.unit), "min": 0}
    if panel.kind is PanelKind.LINES:
        stacking = {"mode": "normal" if panel.stacked else "none"}
        defaults["custom"] = {"fillOpacity": 30 if panel.stacked else 0, "stacking": stacking}
    return defaults
