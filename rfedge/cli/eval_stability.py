"""``rfedge eval stability``: the hard cases, as a result file and a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["EvalStability"]


@dataclass(frozen=True)
class EvalStability:
    """Run the hard cases and write what came of each, as JSON and as a page."""

    json: Path = Path("results/stability.json")
    """Where the result goes."""
    page: Path = Path("docs/stability.md")
    """Where the page made of it goes."""

    def run(self) -> None:
        """Run every case; a broken one is an error, after both files are written."""
        from json import dumps

        from rfcore.errors import RfedgeError
        from rfcore.files import write_whole
        from rfedge.evaluate.stability.results import run_cases, stability_page

        result = run_cases()
        for path, text in (
            (self.json, dumps(result, indent=1)),
            (self.page, stability_page(result)),
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, (text.rstrip() + "\n").encode())
        broken = [row["name"] for row in result["cases"] if not row["holds"]]
        if broken:
            raise RfedgeError(f"{len(broken)} of {len(result['cases'])} cases: {', '.join(broken)}")
        print(f"{len(result['cases'])} cases hold: {self.json}, {self.page}")
