"""``rfedge-lab live``: how old a picture is that is shown, and what showing costs the server."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rfcore.errors import InvalidInput
from rfedge.arguments import DATASET, FIELD, FOLDER, JSON, field_path
from rfedge.results import check_result_path
from rfedge.samples import sample_path

__all__ = ["EvalLive"]

KINDS = ("rtsp", "rtp")
MOST_SECONDS = 86_400.0


@dataclass(frozen=True)
class EvalLive:
    """Measure the twin with a browser, and live cameras that die and come back, as processes.

    Chromium and GStreamer's RTSP server must be there (`make test-system-packages`). All processes
    share this machine, the browser at low priority: it stands for another machine.
    """

    cameras: tuple[int, ...] = (1, 4, 8)
    """Numbers of vehicles whose pictures' ages are measured in the browser; none: not measured."""
    hz: float = 2.0
    """Pictures per second of each of them, and of those of --rounds."""
    seconds: float = 30.0
    """Counted seconds of each number of cameras, and of each half round."""
    rounds: int = 3
    """Rounds of four vehicles without and with consumers and a browser, in turn; 0: none."""
    consumers: int = 10
    """Consumers of the twin beside the browser."""
    sources: tuple[str, ...] = ("rtsp", "rtp")
    """Live cameras: rtsp, rtp; none: not measured."""
    source_seconds: float = 300.0
    """Duration of each drive at 10 Hz."""
    kill_every_s: float = 60.0
    """Seconds after which a live camera's sender is killed, and started again."""
    field: Annotated[Path, FIELD] = sample_path("fields/street.rff")
    """Field archive, the only one in its folder."""
    drive: Annotated[Path, DATASET] = sample_path("street/transforms_drive_vehicles.json")
    """Drive whose pictures are sent."""
    work: Annotated[Path, FOLDER] = Path("out/eval/live")
    """Folder for logs and for the drive that is coded once."""
    out: Annotated[Path, JSON] = Path("out/eval/live.json")
    """The result file to write."""

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if any(not 1 <= count <= 64 for count in self.cameras):
            raise InvalidInput("cameras", f"{self.cameras} are not all within 1..64")
        for name in ("hz", "seconds", "source_seconds", "kill_every_s"):
            if not 0 < getattr(self, name) <= MOST_SECONDS:
                raise InvalidInput(name, f"{getattr(self, name):g} is outside 0..{MOST_SECONDS:g}")
        if not 0 <= self.consumers <= 50:
            raise InvalidInput("consumers", f"{self.consumers} is outside 0..50")
        for kind in self.sources:
            if kind not in KINDS:
                raise InvalidInput("sources", f"{kind!r} is none of {', '.join(KINDS)}")

    def run(self) -> None:
        """Measure, print and write the rows."""
        from rich.console import Console

        from lab.live.run import run_live

        run_live(replace(self, field=field_path(self.field)), Console())
