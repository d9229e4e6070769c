"""Which of a scene's shots a command asks for."""

from __future__ import annotations

import re
from dataclasses import dataclass

from rfcore.errors import InvalidInput
from rfedge.street.scene_file import Scene
from rfedge.street.shots import Shot, Split, shots_of

__all__ = ["Selection"]


@dataclass(frozen=True)
class Selection:
    """``splits`` and ``frames`` as the command line has them; raises ``InvalidInput``."""

    scene: Scene
    splits: str = "default"
    frames: str | None = None
    size_px: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        self.shots()

    def shots(self) -> list[Shot]:
        """Return the chosen shots in the order in which they are taken."""
        every = [
            shot for split in self._splits() for shot in shots_of(self.scene, split, self.size_px)
        ]
        chosen = every[self._slice(len(every))]
        if not chosen:
            raise InvalidInput("frames", f"'{self.frames}' leaves none of {len(every)} frames")
        return chosen

    def _splits(self) -> list[Split]:
        if self.splits == "all":
            return list(Split)
        if self.splits == "default":
            own_field = self.scene.field == self.scene.name
            return [split for split in Split if own_field or split is not Split.TRAIN]
        names = self.splits.split(",")
        for name in names:
            if name not in list(Split):
                known = ", ".join(Split)
                raise InvalidInput("split", f"'{name}' is none of {known} and all")
        return [split for split in Split if split in names]

    def _slice(self, count: int) -> slice:
        if self.frames is None:
            return slice(None)
        match = re.fullmatch(r"(\d{0,9}):(\d{0,9})", self.frames, re.ASCII)
        if match is None:
            raise InvalidInput("frames", f"'{self.frames}' is not a:b, such as 0:8")
        return slice(int(match[1] or 0), int(match[2] or count))
