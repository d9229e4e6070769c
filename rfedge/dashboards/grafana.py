"""Grafana's JSON of a dashboard (schema version 39, Grafana 10.4 and later)."""

from __future__ import annotations

import json
from typing import Any

from rfedge.dashboards.panel import Dashboard, Look, Panel

__all__ = ["DATASOURCE", "dashboard_text"]

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
        "type": str(panel.look),
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
                "instant": panel.look is Look.TABLE,
                "range": panel.look is not Look.TABLE,
                "format": "table" if panel.look is Look.TABLE else "time_series",
            }
            for number, query in enumerate(panel.queries)
        ],
        "fieldConfig": {"defaults": _defaults(panel), "overrides": []},
        "options": {"legend": {"displayMode": "list", "placement": "bottom", "showLegend": True}}
        if panel.look is Look.LINES
        else {},
    }


def _defaults(panel: Panel) -> dict[str, Any]:
    defaults: dict[str, Any] = {"unit": str(panel.unit), "min": 0}
    if panel.look is Look.LINES:
        stacking = {"mode": "normal" if panel.stacked else "none"}
        defaults["custom"] = {"fillOpacity": 30 if panel.stacked else 0, "stacking": stacking}
    return defaults
