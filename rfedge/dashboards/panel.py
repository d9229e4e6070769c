"""What a dashboard is made of. Expressions are PromQL.

``$instance`` stands for the targets chosen above the panels, ``$__rate_interval`` for a time that
holds at least four scrapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rfcore.errors import InvalidInput

__all__ = ["Dashboard", "Look", "Panel", "Query", "Unit", "share_of", "stages_of"]


class Unit(StrEnum):
    """Grafana's names of units."""

    BITS_PER_S = "bps"
    BYTES = "bytes"
    COUNT = "short"
    PER_S = "hertz"
    SECONDS = "s"
    SHARE = "percentunit"


class Look(StrEnum):
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
    look: Look = Look.LINES
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
