"""Things that cameras see and the field does not have, followed over time and over cameras.

Without clock, sockets or threads, and deterministic: the same pictures in the same order give the
same objects.

A detection (``mec_server.twin.contacts``) belongs to the nearest object not further away than
``GATE_M`` and a part of its distance from the camera, for that is how its error grows; greedy, the
nearest pair first. Between pictures objects move at constant velocity (an alpha-beta filter). One
is *confirmed* by a third picture and forgotten ``FORGOTTEN_S`` after its last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from mec_server.twin.contacts import Detection
from mec_server.twin.state import CameraKey
from rfcore.wire.twin_render import StreetObject

__all__ = ["FollowedObject", "ObjectTracker"]

GATE_M = 1.5
GATE_PER_M = 0.1
POSITION_GAIN, VELOCITY_GAIN = 0.4, 0.15
MOST_SPEED_MPS = 60.0
SEEN_BY_S = 1.0
FORGOTTEN_S = 1.0
CONFIRMED_BY = 3
SURE_BY = 4
"""Pictures that saw an object until nothing is missing from its confidence."""

Vec3 = tuple[float, float, float]


@dataclass
class FollowedObject:
    """A thing over time. ``seen``: pictures that showed it; ``cameras``: when each saw it last."""

    object_id: int
    at_m: Vec3
    velocity_mps: Vec3
    width_m: float
    height_m: float
    first_s: float
    last_s: float
    seen: int = 1
    cameras: dict[CameraKey, float] = field(default_factory=dict)

    @property
    def is_confirmed(self) -> bool:
        """Whether enough pictures showed it."""
        return self.seen >= CONFIRMED_BY

    def confidence(self, now: float) -> float:
        """Return 0 to 1: less after few pictures, and while nobody sees it."""
        fresh = max(0.0, 1.0 - max(0.0, now - self.last_s) / FORGOTTEN_S)
        return fresh * min(1.0, self.seen / SURE_BY)

    def seen_by(self, now: float) -> list[CameraKey]:
        """Return the cameras that saw it lately, sorted."""
        return sorted(key for key, at_s in self.cameras.items() if now - at_s <= SEEN_BY_S)

    def at(self, time_s: float) -> Vec3:
        """Return where it is at a time, which may be before its last picture."""
        elapsed_s = max(-FORGOTTEN_S, min(FORGOTTEN_S, time_s - self.last_s))
        x, y, z = (
            at_m + elapsed_s * mps for at_m, mps in zip(self.at_m, self.velocity_mps, strict=True)
        )
        return x, y, z

    def told(self, now: float) -> StreetObject:
        """Return what is known of it, where it is now."""
        return StreetObject(
            object_id=self.object_id,
            at_m=self.at(now),
            velocity_mps=self.velocity_mps,
            width_m=self.width_m,
            height_m=self.height_m,
            confidence=self.confidence(now),
            age_s=max(0.0, now - self.first_s),
            unseen_s=max(0.0, now - self.last_s),
            seen_by=tuple(self.seen_by(now)),
        )

    def take(self, detection: Detection, camera: CameraKey, time_s: float) -> None:
        """Move to what a picture of ``camera`` shows."""
        expected = self.at(time_s)
        off = [a - b for a, b in zip(detection.at_m, expected, strict=True)]
        elapsed_s = time_s - self.last_s
        gain = max(POSITION_GAIN, 1.0 / (self.seen + 1))
        x, y, z = (at_m + gain * by for at_m, by in zip(expected, off, strict=True))
        self.at_m = (x, y, z)
        if elapsed_s > 1e-3:
            vx, vy, vz = (
                mps + VELOCITY_GAIN * by / max(elapsed_s, 0.05)
                for mps, by in zip(self.velocity_mps, off, strict=True)
            )
            speed = math.hypot(vx, vy, vz)
            slower = min(1.0, MOST_SPEED_MPS / speed) if speed else 1.0
            self.velocity_mps = (slower * vx, slower * vy, slower * vz)
        self.last_s = max(self.last_s, time_s)
        self.width_m, self.height_m = detection.width_m, detection.height_m
        self.seen += 1
        self.cameras[camera] = time_s


class ObjectTracker:
    """Follows things through the pictures of all cameras of a place."""

    def __init__(self) -> None:
        self._objects: list[FollowedObject] = []
        self._next_id = 1

    def take(self, detections: Sequence[Detection], camera: CameraKey, time_s: float) -> None:
        """Take in what one picture of ``camera``, captured at ``time_s``, shows."""
        self._objects = [each for each in self._objects if time_s - each.last_s <= FORGOTTEN_S]
        pairs = sorted(
            (distance_m, each.object_id, index)
            for each in self._objects
            for index, detection in enumerate(detections)
            if (distance_m := math.dist(each.at(time_s), detection.at_m))
            <= GATE_M + GATE_PER_M * detection.distance_m
        )
        by_id = {each.object_id: each for each in self._objects}
        free = set(range(len(detections)))
        for _, object_id, index in pairs:
            if object_id in by_id and index in free:
                by_id.pop(object_id).take(detections[index], camera, time_s)
                free.discard(index)
        for index in sorted(free):
            self._begin(detections[index], camera, time_s)

    def confirmed(self, now: float) -> list[FollowedObject]:
        """Return the confirmed objects that are not forgotten, sorted by id."""
        return [
            each for each in self._objects if each.is_confirmed and now - each.last_s <= FORGOTTEN_S
        ]

    def _begin(self, detection: Detection, camera: CameraKey, time_s: float) -> None:
        begun = FollowedObject(
            self._next_id,
            detection.at_m,
            (0.0, 0.0, 0.0),
            detection.width_m,
            detection.height_m,
            time_s,
            time_s,
            cameras={camera: time_s},
        )
        self._objects.append(begun)
        self._next_id += 1
