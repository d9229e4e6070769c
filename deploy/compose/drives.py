"""Make the drives of docker-compose.yml: along the sample street and back, for four vehicles.

``python deploy/compose/drives.py FOLDER`` writes a transforms file for each vehicle. It belongs
beside the picture folders of ``samples/street``. A drive that comes back repeats without a jump.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

__all__ = ["DRIVES", "write_drives"]

SAMPLES = Path(__file__).parents[2] / "samples/street"
RATE_HZ = 10.0

DRIVES = {
    "cav-1": ("drive_empty", range(24)),
    "cav-2": ("drive_vehicles", range(24)),
    "cav-3": ("drive_vehicles", range(12)),
    "cav-4": ("drive_empty", range(12, 24)),
}
"""Recorded drive and frames of each vehicle; cav-1 and cav-2 pass between tiles, others stay."""


def write_drives(folder: Path) -> None:
    """Write ``VEHICLE.json`` for each vehicle into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for vehicle, (recorded, indices) in DRIVES.items():
        content = json.loads((SAMPLES / f"transforms_{recorded}.json").read_text())
        there = [content["frames"][index] for index in indices]
        there_and_back = [*there, *there[-2:0:-1]]
        content["frames"] = [
            {**frame, "time": round(index / RATE_HZ, 3)}
            for index, frame in enumerate(there_and_back)
        ]
        (folder / f"{vehicle}.json").write_text(json.dumps(content) + "\n")


if __name__ == "__main__":
    write_drives(Path(sys.argv[1]))
