"""``python -m rfedge.dashboards FOLDER``: write every dashboard as JSON."""

from __future__ import annotations

import sys
from pathlib import Path

from rfcore.files import write_whole
from rfedge.dashboards.catalogue import DASHBOARDS
from rfedge.dashboards.grafana import dashboard_text

__all__ = ["write_dashboards"]


def write_dashboards(folder: Path) -> None:
    """Write ``folder``/UID.json for each dashboard."""
    folder.mkdir(parents=True, exist_ok=True)
    for dashboard in DASHBOARDS:
        write_whole(folder / f"{dashboard.uid}.json", dashboard_text(dashboard))


if __name__ == "__main__":
    write_dashboards(Path(sys.argv[1]))
