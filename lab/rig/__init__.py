"""``rfedge-lab rig``: several cameras in one session against a session each, on one link."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rfedge.samples import sample_path

__all__ = ["EvalRig"]


@dataclass(frozen=True)
class EvalRig:
    """Send a rig's cameras in one session, and in a session each, through one link.

    Server, link and vehicles are processes. Two comparisons: at one CRF, every picture delivered;
    and at the drive's rate within a delay, where one rate control stands against one a camera.
    Bits, PSNR and CRF of each camera are in the rows, and how far apart the pictures of an instant
    come at the server. `streetgen build street-traffic --split rig --out FOLDER` records a rig.
    """

    rig: Path
    """Rig file of drives (rig.toml), or its folder."""
    many: Path | None = None
    """Rig file of many cameras, such as the published 18, which is to be accepted and served."""
    field: Path = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    link_bps: float = 4e6
    """Rate of the link, both directions, bit/s."""
    rate_hz: float = 2.0
    """Instants a second of the second comparison, Hz."""
    max_delay_ms: float = 1000.0
    """Time from capture to Ack, in the second comparison."""
    crf: float = 23.0
    """CRF of the first comparison."""
    effort: str = "fast"
    """Effort of the slice coder: fast, default, thorough."""
    threads: int = 1
    """Threads of each process' renderer."""
    out: Path = Path("out/eval/rig.json")
    """The result file to write."""
    work: Path = Path("out/eval/rig")
    """Folder for logs and reports of the processes."""

    def run(self) -> None:
        """Run, write the rows, print them."""
        from rich.console import Console

        from lab.rig.report import rig_parts
        from lab.rig.run import run_rig
        from rfcore.dataset.rig import read_rig
        from rfedge.arguments import field_path
        from rfedge.report.tables import print_tables
        from rfedge.results import write_result

        for path in filter(None, (self.rig, self.many)):
            read_rig(path)
        console = Console()
        result = run_rig(replace(self, field=field_path(self.field)), console)
        write_result(self.out, result)
        print_tables(rig_parts(result), console)
