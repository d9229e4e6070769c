"""``rfedge-lab world``: how true the twin's objects and views are, and what they cost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfedge.samples import sample_path

__all__ = ["EvalWorld"]


@dataclass(frozen=True)
class EvalWorld:
    """Compare objects and views of the twin with the generator's truth; time views, and notices.

    Truth (where vehicles stand, what of them a camera sees, how the street looks from beside the
    drive) is computed from the scene file: it needs the extra scene. The rows of latency run real
    processes and want an idle machine.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) of the street without vehicles."""
    empty: str = (
        f"{sample_path('street/empty.toml')},{sample_path('street/transforms_drive_empty.json')}"
    )
    """SCENE.toml,DATASET of the unchanged street's drive."""
    vehicles: str = (
        f"{sample_path('street/vehicles.toml')},"
        f"{sample_path('street/transforms_drive_vehicles.json')}"
    )
    """SCENE.toml,DATASET of the drive through the street with vehicles."""
    long_empty: str = ""
    """SCENE.toml,DATASET of a longer drive through the unchanged street, for the empty minute."""
    aside_m: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Distances to the left of the drive at which views are compared."""
    every: int = 6
    """Compare a view at every Nth picture of a drive."""
    notices_hz: float = 5.0
    """Rate of the two vehicles of which one is told what the other sees."""
    seconds: float = 30.0
    """Duration of each measurement with processes."""
    rounds: int = 3
    """Number of times that ingest is measured without and with a live view, in turn."""
    only: tuple[str, ...] = ()
    """Measure only these parts: objects, dusk, views, cost, notices, ingest. Rows of the others are
    kept if the result file is of this revision."""
    work: Path = Path("out/eval/world")
    """Folder of logs, prerecorded drives and the pictures of dusk, which take minutes to render."""
    out: Path = Path("out/eval/world.json")
    """The result file to write."""

    def run(self) -> None:
        """Measure, write the rows, print them."""
        from lab.world.run import run_world

        run_world(self)
