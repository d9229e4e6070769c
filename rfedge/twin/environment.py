"""A street to drive through as a Gymnasium environment (``pip install 'rfedge[gymnasium]'``).

Frames: those of the car (``ahead``, ``left``) for what is observed, the tile's for ``info``. Over a
``RecordedStreet`` an environment repeats: the same seed and actions give the same bytes. Its API is
that of Gymnasium 1 (https://gymnasium.farama.org/api/env/).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfedge.twin.simulation import (
    MOST_SPEED_MPS,
    RATE_HZ,
    Observation,
    Place,
    Street,
    TwinDrive,
)

with needs("gymnasium"):
    import gymnasium
    from gymnasium import spaces

__all__ = ["MOST_DEPTH_M", "OBJECTS", "OBJECT_COLUMNS", "DriveEnvironment", "metres_driven"]

MOST_DEPTH_M = 1000.0
"""Depths and distances are cut here, since an observation space has bounds."""
OBJECTS = 16
"""So many rows has ``objects``: the nearest things, then rows of zeros."""
OBJECT_COLUMNS = (
    *("ahead_m", "left_m", "speed_ahead_mps", "speed_left_mps"),
    *("width_m", "height_m", "confidence"),
)

Seen = dict[str, Any]
Reward = Callable[[Observation, Observation], float]
"""Takes what was seen before and after a step."""


def metres_driven(before: Observation, after: Observation) -> float:
    """Return how far the car went in a step: a reward that the end of the field ends."""
    here, there = before.place, after.place
    return math.dist((here.x_m, here.y_m), (there.x_m, there.y_m))


class DriveEnvironment(gymnasium.Env[Seen, NDArray[np.float32]]):
    """A car in a street: the action is [steer, throttle], each -1 to 1.

    Observed are ``picture`` uint8 [H, W, 3], ``depth`` float32 [H, W] (metres, 0 for nothing),
    ``speed_mps`` float32 [1] and ``objects`` float32 [OBJECTS, 7] (``OBJECT_COLUMNS``; speeds are
    over ground). ``info`` has the ``place``, the ``live_share`` of the picture's pixels, and
    ``objects`` in full. ``reset`` draws one of ``starts``, or takes ``options={"place": Place}``.
    Leaving the field, or driving into a wall, terminates; ``most_steps`` truncate.
    """

    render_mode = "rgb_array"

    def __init__(
        self,
        street: Street,
        intrinsics: Intrinsics,
        starts: Sequence[Place],
        reward: Reward = metres_driven,
        most_steps: int = 600,
    ) -> None:
        if not starts:
            raise InvalidInput("starts", "there are none; give at least one place")
        if most_steps < 1:
            raise InvalidInput("most_steps", f"{most_steps} is not above 0")
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": RATE_HZ}
        self._drive = TwinDrive(street, intrinsics)
        self._starts = tuple(starts)
        self._reward = reward
        self._most_steps = most_steps
        self._seen: Observation | None = None
        self._steps = 0
        size = (intrinsics.height_px, intrinsics.width_px)
        low, high = _object_bounds()
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Dict(
            {
                "picture": spaces.Box(0, 255, (*size, 3), np.uint8),
                "depth": spaces.Box(0.0, MOST_DEPTH_M, size, np.float32),
                "speed_mps": spaces.Box(0.0, MOST_SPEED_MPS, (1,), np.float32),
                "objects": spaces.Box(low, high, dtype=np.float32),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Begin anew; raise ``InvalidInput`` for a place outside of the field, or other options."""
        super().reset(seed=seed)
        unknown = sorted(set(options or {}) - {"place"})
        if unknown:
            raise InvalidInput("options", f"{unknown[0]!r} is none; there is: place")
        drawn = self._starts[int(self.np_random.integers(len(self._starts)))]
        self._seen = self._drive.reset((options or {}).get("place", drawn))
        self._steps = 0
        return observed(self._seen), _info(self._seen)

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Drive on for one step.

        Raises ``InvalidInput`` for an action outside of -1 to 1 and after the end of an episode.
        """
        before = self._seen
        if before is None:
            raise InvalidInput("step", "no episode runs; call reset()")
        if np.shape(action) != (2,):
            raise InvalidInput("action", f"has the shape {np.shape(action)}; [steer, throttle]")
        seen = self._drive.step(float(action[0]), float(action[1]))
        self._steps += 1
        truncated = not seen.ended and self._steps >= self._most_steps
        self._seen = None if seen.ended or truncated else seen
        reward = float(self._reward(before, seen))
        return observed(seen), reward, seen.ended, truncated, _info(seen)

    def render(self) -> Any:
        """Return the newest picture, uint8 [H, W, 3]."""
        seen = self._drive.seen
        if seen is None:
            raise InvalidInput("render", "nothing was seen yet; call reset()")
        return seen.picture.copy()


def observed(seen: Observation) -> Seen:
    """Return what the observation space describes."""
    return {
        "picture": seen.picture.copy(),
        "depth": np.clip(seen.depth, 0.0, MOST_DEPTH_M),
        "speed_mps": np.array([seen.place.speed_mps], np.float32),
        "objects": _object_rows(seen),
    }


def _info(seen: Observation) -> dict[str, Any]:
    return {"place": seen.place, "live_share": float(seen.live.mean()), "objects": seen.objects}


def _object_bounds() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    signed, most = [True] * 4 + [False] * 3, [MOST_DEPTH_M] * 6 + [1.0]
    high = np.tile(np.array(most, np.float32), (OBJECTS, 1))
    return np.where(signed, -high, np.float32(0)), high


def _object_rows(seen: Observation) -> NDArray[np.float32]:
    """Return the nearest objects as the car sees them, [OBJECTS, 7]."""
    place, rows = seen.place, np.zeros((OBJECTS, len(OBJECT_COLUMNS)), np.float32)
    cos, sin = math.cos(place.heading_rad), math.sin(place.heading_rad)
    own_from_tile = np.array([[cos, sin], [-sin, cos]])
    things = []
    for thing in seen.objects:
        at_m = own_from_tile @ np.subtract(thing.at_m[:2], (place.x_m, place.y_m))
        speed_mps = own_from_tile @ thing.velocity_mps[:2]
        things.append((*at_m, *speed_mps, thing.width_m, thing.height_m, thing.confidence))
    things.sort(key=lambda row: math.hypot(row[0], row[1]))
    for row, values in zip(rows, things, strict=False):
        row[:] = values
    return np.clip(rows, *_object_bounds())
