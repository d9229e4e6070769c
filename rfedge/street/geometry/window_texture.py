"""What is seen through panes: rooms with curtains or blinds, side by side in one picture."""

from __future__ import annotations

import numpy as np

from rfedge.street.geometry.grain import texture
from rfedge.street.geometry.material import Texture
from rfedge.street.geometry.mesh import F32

__all__ = ["ROOMS", "room_uv", "rooms"]

ROOMS = 16
SIDE_PX = 256
CURTAINS = ((128, 120, 105), (90, 45, 38), (142, 142, 138), (68, 75, 90))


def rooms(rng: np.random.Generator) -> Texture:
    """Return 16 rooms beside each other, 256 px each."""
    return texture(np.concatenate([_room(i, rng) for i in range(ROOMS)], axis=1))


def room_uv(rng: np.random.Generator, count: int) -> F32:
    """Return where ``count`` panes show a room each [N, 4, 2], as ``solids.quads`` takes it."""
    left = rng.integers(0, ROOMS, count) / ROOMS
    right = left + 1 / ROOMS
    inset = 0.02 / ROOMS
    u = np.stack([left + inset, right - inset, right - inset, left + inset], axis=1)
    v = np.broadcast_to([0.99, 0.99, 0.01, 0.01], (count, 4))
    return np.stack([u, v], axis=2).astype(np.float32)


def _room(number: int, rng: np.random.Generator) -> F32:
    grey = np.float32(rng.uniform(14, 34))
    room = np.full((SIDE_PX, SIDE_PX, 3), grey, np.float32)
    room *= np.array([1.0, 1.02, 1.08], np.float32)
    room *= np.linspace(1.5, 0.6, SIDE_PX, dtype=np.float32)[:, None, None]
    if number % 4 == 3:
        _lower_blind(room, rng)
    else:
        _draw_curtains(room, CURTAINS[number // 4], rng)
    return room


def _draw_curtains(room: F32, colour: tuple[int, int, int], rng: np.random.Generator) -> None:
    width = int(rng.uniform(0.12, 0.48) * SIDE_PX)
    folds = 0.75 + 0.25 * np.sin(np.arange(SIDE_PX) / rng.uniform(3, 6))
    cloth = (folds[:, None] * np.array(colour)).astype(np.float32)
    room[:, :width] = cloth[:width]
    room[:, SIDE_PX - width :] = cloth[SIDE_PX - width :]


def _lower_blind(room: F32, rng: np.random.Generator) -> None:
    height = int(rng.uniform(0.2, 0.8) * SIDE_PX)
    slats = np.where(np.arange(height) % 12 < 9, 1.0, 0.55).astype(np.float32)
    room[:height] = slats[:, None, None] * np.array((118, 116, 110), np.float32)
