"""The metrics that the services and the link declare; `make docs` makes a page of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from prometheus_client import CollectorRegistry

from cav_agent import vehicle
from mec_server import server
from rfcore.wire.instruments import Family
from rfedge.link.direction import LinkMetrics


def families() -> Mapping[str, Sequence[Family]]:
    """Return what each command declares, with everything that a flag can add."""
    return {
        "mec-server": server.metric_families(),
        "cav-agent": vehicle.metric_families(),
        "rfedge link": LinkMetrics(CollectorRegistry()).instruments.families,
    }
