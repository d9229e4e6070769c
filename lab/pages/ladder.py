"""The ladder that ships with ``cav-agent``, from the recorded one: rungs, their times and rates.

python -m lab.pages.ladder > cav_agent/ladder.json
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rfedge.results import Result, read_result

__all__ = ["RECORDED", "shipped_ladder"]

RECORDED = Path(__file__).parents[1] / "results/ladder.json"
MADE = ("kind", "command", "revision", "host", "threads", "size_px", "fields")
RUNG = ("settings", "sender_ms", "receiver_ms", "rate_percent")
TRACKING = ("settings", "tracking", "track_ms", "rate_percent")


def shipped_ladder(result: Result) -> str:
    """Return the content of the file that ships: how it was made, and a line for each rung."""
    head = {key: result[key] for key in MADE}
    rows, tracking = _lines(result["rows"], RUNG), _lines(result["tracking"], TRACKING)
    text = json.dumps(head, indent=1).removesuffix("\n}")
    return f'{text},\n "rows": [\n{rows}\n ],\n "tracking": [\n{tracking}\n ]\n}}\n'


def _lines(rows: Iterable[Mapping[str, Any]], keys: tuple[str, ...]) -> str:
    kept = ({key: row[key] for key in keys if key in row} for row in rows)
    return ",\n".join(f"  {json.dumps(row)}" for row in kept)


if __name__ == "__main__":
    print(shipped_ladder(read_result(RECORDED, "ladder")), end="")
