"""Passes of vehicles along a street, and the frames of them that an update learns from.

Every fourth frame of a pass is held back for the trial; poses are rounded as vehicles send them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.train.targets import Target
from rfcore.views import PosedPicture

HOLD_BACK_EVERY = 4
FEWEST_FRAMES = 8
"""Fewest frames of a pass: two of eight are held back, and not next to each other."""


@dataclass(frozen=True)
class Pass:
    """One drive of one vehicle, in time order; ``identity`` says whose."""

    identity: str
    pictures: tuple[PosedPicture, ...]


@dataclass(frozen=True)
class SeenFrame(Target):
    """A camera and its picture, with the number of the pass it belongs to."""

    pass_number: int


def check_passes(passes: Sequence[Pass], min_identities: int) -> None:
    """Raise ``InvalidInput`` for too few vehicles, or a pass of too few frames."""
    identities = {drive.identity for drive in passes}
    if len(identities) < min_identities:
        raise InvalidInput(
            "min_identities",
            f"passes of {len(identities)} vehicle(s) ({', '.join(sorted(identities)) or 'none'}), "
            f"at least {min_identities} are asked for",
        )
    for drive in passes:
        if len(drive.pictures) < FEWEST_FRAMES:
            raise InvalidInput(
                "from", f"{drive.identity}: {len(drive.pictures)} frames, at least {FEWEST_FRAMES}"
            )


def split_frames(passes: Sequence[Pass], most: int) -> tuple[list[SeenFrame], list[SeenFrame]]:
    """Return the frames to learn from and those held back, ``most`` in all, evenly over the passes.

    Raises ``DatasetError`` for a picture that cannot be read.
    """
    learnt: list[SeenFrame] = []
    held_back: list[SeenFrame] = []
    for number, drive in enumerate(passes):
        for place, picture in enumerate(spread(drive.pictures, max(2, most // len(passes)))):
            camera = picture.camera.rounded()
            frame = SeenFrame(camera, picture.read(), number)
            is_held_back = place % HOLD_BACK_EVERY == HOLD_BACK_EVERY // 2
            (held_back if is_held_back else learnt).append(frame)
    return learnt, held_back


def spread(pictures: Sequence[PosedPicture], most: int) -> list[PosedPicture]:
    """Return at most ``most`` of the pictures, evenly over all of them."""
    if len(pictures) <= most:
        return list(pictures)
    return [pictures[i] for i in np.linspace(0, len(pictures) - 1, most).round().astype(int)]
