"""The metrics that the services and the link declare; `make docs` makes a page of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from prometheus_client import CollectorRegistry

from cav_agent.metrics import AgentMetrics
from mec_server.server import metric_families
from rfcore.wire.instruments import Family
from rfedge.link.metrics import LinkMetrics

__all__ = ["families"]


def families() -> Mapping[str, Sequence[Family]]:
    """Return what each command declares, with everything that a flag can add."""
    agent = AgentMetrics(CollectorRegistry())
    agent.identify("cav-1", "front")
    return {
        "mec-server": metric_families(),
        "cav-agent": agent.instruments.families,
        "rfedge link": LinkMetrics(CollectorRegistry()).instruments.families,
    }
