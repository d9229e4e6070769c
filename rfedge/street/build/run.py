"""A build from its command to its manifest: cost, progress, what is left to do."""

from __future__ import annotations

import os
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.provenance import host, revision
from rfedge.street.build.cost import cost_line
from rfedge.street.build.crew import take_all
from rfedge.street.build.listing import list_dataset
from rfedge.street.build.origin import claim_folder, origin_of
from rfedge.street.build.progress import show_progress
from rfedge.street.build.selection import Selection
from rfedge.street.build.shot_files import ShotFiles
from rfedge.street.build.studio import Order
from rfedge.street.render.backend import chosen_backend
from rfedge.street.render.renderer import Quality

__all__ = ["Settings", "build_scene"]


@dataclass(frozen=True)
class Settings:
    """How a scene is built, not what."""

    out: Path
    samples: int = 16
    workers: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= 256:
            raise InvalidInput("workers", f"{self.workers} is outside 1..256")


def build_scene(selection: Selection, settings: Settings, console: Console) -> None:
    """Take the shots that are not there yet, then list all that are."""
    quality = Quality(settings.samples, selection.scene.geometry.seed)
    backend = chosen_backend()
    if not backend.vectorised:
        console.print("no LLVM that Mitsuba can use (19 is known to work): scalar_rgb, 3-4x slower")
    cores = len(os.sched_getaffinity(0))
    order = Order(
        scene=selection.scene,
        folder=settings.out,
        quality=quality,
        backend=backend,
        threads=max(cores // settings.workers, 1),
        size_px=selection.size_px,
    )
    claim_folder(order)
    shots = selection.shots()
    missing = [shot for shot in shots if not ShotFiles.of(order.folder, shot).done]
    if len(missing) < len(shots):
        console.print(f"{len(shots) - len(missing)} of {len(shots)} frames are there already")
    if missing:
        console.print(cost_line(missing, quality, backend, cores, settings.workers))
        taken = take_all(order, missing, min(settings.workers, len(missing)))
        show_progress(taken, len(missing), console, time.monotonic)
    counts = list_dataset(order, _about(order))
    console.print(f"{settings.out}: " + ", ".join(f"{n} {split}" for split, n in counts.items()))


def _about(order: Order) -> dict[str, Any]:
    command = ["rfedge", *sys.argv[1:]]
    return {
        "command": shlex.join(command),
        "revision": revision(),
        "host": host(),
        "build": origin_of(order),
    }
