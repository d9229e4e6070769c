"""Warnings to vehicles: objects that others see ahead of them, and new fields of their tile.

A vehicle that asks for notices in Hello gets one for every confirmed object
(``rfcore.perception.objects``) that

* stands within ``REACH_M`` ahead of it, in the same tile,
* is seen by another vehicle's camera, and was not seen by its own within the last second,
* is not the vehicle itself: further than ``OWN_M`` from where its cameras are and were since.

The notice is sent with a picture that shows the object: when it is confirmed and again every
``REPEAT_S`` while that holds, the nearest first, at most ``MOST_PER_S`` notices a second. The
server knows a vehicle's position from its pictures: one whose pictures have no pose gets no
notices of objects. Ahead is the direction of travel over the last ``LEAST_WAY_M``; for a standing
vehicle it is where its camera ``front`` looks, or else the first camera of its Hello.

Pictures are analysed only while a vehicle takes notices, by the thread that finds objects
(``mec_server.twin.rendering``): it gives way to decoding, waits for no view, takes the newest
picture first, and is charged like a consumer to ``NOTICES_IDENTITY``, so that its time is bounded.
Pictures for which there is no time are missed, and delay nothing.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.rendering import ViewedTile, ViewService, viewed_tile
from mec_server.twin.state import ReceivedPicture, Twin
from rfcore.camera import Camera, Pose
from rfcore.errors import LimitExceeded
from rfcore.perception.objects import FollowedObject, ObjectTracker
from rfcore.wire.messages import Hello
from rfcore.wire.notices import FieldChange, FieldChangeKind, ObjectAhead, StreetNotice
from rfcore.wire.tiles import Tile
from rfcore.wire.twin import PictureEncoding, Subscription
from rfcore.wire.twin_render import ObjectsRequest

NOTICES_IDENTITY = "server: notices"
"""The identity that the analysis of pictures is charged to."""

REACH_M = 100.0
OWN_M = 3.5
"""Distance from a vehicle's own camera, 1.5 m above the road, to the foot of its front, side or
rear as others see it: 3.2 m on the ground."""
LEAST_WAY_M, WAY_S = 1.0, 2.0
"""A vehicle that moved less than this in this time counts as standing."""
FRONT = "front"
REPEAT_S = 0.5
MOST_PER_S = 10
VALID_S = 1.0
"""Validity of an object's notice: two repetitions may be lost. The server has dropped the object by
then, too."""
FIELD_VALID_S = 600.0

KNOWN_FOR_S = 2.0
"""Greatest age of the picture that a vehicle's position is taken from."""
LOOK_AGAIN_S = 1.0
"""Longest wait for a picture before checking whether any vehicle still takes notices."""


Vec3 = tuple[float, float, float]


class NoticeTaker(Protocol):
    """A stream of a vehicle that takes notices."""

    @property
    def session_id(self) -> str:
        """The id of the stream."""

    @property
    def hello(self) -> Hello:
        """The Hello of its vehicle."""

    def tell(self, notice: StreetNotice) -> None:
        """Send a notice."""


@dataclass(frozen=True)
class OwnCamera:
    """Position of a vehicle's camera at the capture of its newest picture, and its velocity."""

    captured_s: float
    at_m: Vec3
    velocity_mps: Vec3

    @staticmethod
    def of(views: Sequence[ReceivedPicture]) -> OwnCamera:
        """Return it from one camera's pictures, all of known pose, the oldest first."""
        newest = views[-1]
        at_m, velocity_mps = _place_of(newest), (0.0, 0.0, 0.0)
        for view in reversed(views[:-1]):
            before_m, elapsed_s = _place_of(view), newest.captured_s - view.captured_s
            if elapsed_s > WAY_S:
                break
            if elapsed_s > 0 and math.dist(at_m, before_m) >= LEAST_WAY_M:
                x, y, z = (a - b for a, b in zip(at_m, before_m, strict=True))
                velocity_mps = (x / elapsed_s, y / elapsed_s, z / elapsed_s)
                break
        return OwnCamera(newest.captured_s, at_m, velocity_mps)

    def at(self, time_s: float) -> Vec3:
        """Return the position at another time, at constant velocity."""
        elapsed_s = time_s - self.captured_s
        x, y, z = (a + elapsed_s * v for a, v in zip(self.at_m, self.velocity_mps, strict=True))
        return x, y, z

    def passed_m(self, point_m: Vec3, from_s: float, to_s: float) -> float:
        """Return the least distance from a point between two times."""
        start_m, end_m = np.array(self.at(from_s)), np.array(self.at(to_s))
        way_m, length2 = end_m - start_m, float(((end_m - start_m) ** 2).sum())
        share = float((point_m - start_m) @ way_m) / length2 if length2 else 0.0
        return float(np.linalg.norm(start_m + min(1.0, max(0.0, share)) * way_m - point_m))


@dataclass(frozen=True)
class VehiclePosition:
    """A vehicle's cameras, the one of its newest picture first, and the direction ahead."""

    cameras: tuple[OwnCamera, ...]
    ahead: Vec3

    @staticmethod
    def of(
        cameras: Sequence[Sequence[ReceivedPicture]], camera_ids: Sequence[str]
    ) -> VehiclePosition:
        """Return it from the pictures of a vehicle's cameras.

        There is at least one camera; pictures have known poses and come oldest first.
        ``camera_ids``: the cameras in the order of the vehicle's Hello.
        """
        newest_first = sorted(cameras, key=lambda views: -views[-1].captured_s)
        own = tuple(OwnCamera.of(views) for views in newest_first)
        way = own[0].velocity_mps
        if any(way):
            return VehiclePosition(own, way)
        order = (FRONT, *camera_ids, *(views[-1].frame.camera_id for views in newest_first))
        by_id = {views[-1].frame.camera_id: views[-1] for views in cameras}
        pose = _pose_of(next(by_id[name] for name in order if name in by_id))
        origin_m, on_axis_m = pose.apply((0.0, 0.0, 0.0)), pose.apply((0.0, 0.0, 1.0))
        x, y, z = (a - b for a, b in zip(on_axis_m, origin_m, strict=True))
        return VehiclePosition(own, (x, y, z))

    def distance_ahead_m(self, each: FollowedObject, now: float) -> float | None:
        """Return the distance of an object in front of the vehicle.

        None for one that is behind it or out of reach, and for the vehicle itself.
        """
        at_m, eye_m = each.at(now), self.cameras[0].at(now)
        distance_m = math.dist(at_m, eye_m)
        along_m = sum((a - b) * c for a, b, c in zip(at_m, eye_m, self.ahead, strict=True))
        if along_m <= 0 or distance_m > REACH_M:
            return None
        if any(own.passed_m(at_m, min(each.last_s, now), now) <= OWN_M for own in self.cameras):
            return None
        return distance_m


def _pose_of(view: ReceivedPicture) -> Pose:
    assert view.frame.pose is not None
    return view.frame.pose


def _place_of(view: ReceivedPicture) -> Vec3:
    return _pose_of(view).translation_m


@dataclass
class _SentNotice:
    notice_id: int
    at_s: float
    seen_s: float


class StreamNotices:
    """Decides which notices one vehicle gets, when they are repeated, and numbers them.

    Without clock or sockets.
    """

    def __init__(self, vehicle_id: str) -> None:
        self._vehicle_id = vehicle_id
        self._sent: dict[tuple[str, int], _SentNotice] = {}
        self._next_id = 1
        self._recent_s: deque[float] = deque(maxlen=MOST_PER_S)

    def about_objects(
        self, field_id: str, own: VehiclePosition, objects: Iterable[FollowedObject], now: float
    ) -> list[StreetNotice]:
        """Return the notices of ``objects`` that the vehicle, at ``own``, gets now."""
        ahead = []
        for each in objects:
            seen_by = {vehicle_id for vehicle_id, _ in each.seen_by(now)}
            distance_m = own.distance_ahead_m(each, now)
            if distance_m is not None and seen_by and self._vehicle_id not in seen_by:
                ahead.append((distance_m, each, len(seen_by)))
        self._forget(now)
        notices = []
        for distance_m, each, vehicles in sorted(ahead, key=lambda it: (it[0], it[1].object_id)):
            if not self._may_tell(now):
                break
            sent = self._sent.get((field_id, each.object_id))
            if sent is None or (now - sent.at_s >= REPEAT_S and each.last_s > sent.seen_s):
                notice_id = self._note((field_id, each.object_id), sent, each.last_s, now)
                subject = _object_ahead(field_id, each, distance_m, vehicles, now)
                notices.append(StreetNotice(notice_id, VALID_S, subject))
        return notices

    def about_field(self, change: FieldChange) -> StreetNotice:
        """Return the notice of a newly published field."""
        return StreetNotice(self._new_id(), FIELD_VALID_S, change)

    def _may_tell(self, now: float) -> bool:
        return len(self._recent_s) < MOST_PER_S or now - self._recent_s[0] >= 1.0

    def _note(
        self, key: tuple[str, int], sent: _SentNotice | None, seen_s: float, now: float
    ) -> int:
        self._recent_s.append(now)
        notice_id = self._new_id() if sent is None else sent.notice_id
        self._sent[key] = _SentNotice(notice_id, now, seen_s)
        return notice_id

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1

    def _forget(self, now: float) -> None:
        """Forget notices that have expired: a later one of the same object gets a new number."""
        for key in [key for key, sent in self._sent.items() if now - sent.at_s > VALID_S]:
            del self._sent[key]


def _object_ahead(
    field_id: str, each: FollowedObject, distance_m: float, vehicles: int, now: float
) -> ObjectAhead:
    return ObjectAhead(
        field_id=field_id,
        at_m=each.at(now),
        velocity_mps=each.velocity_mps,
        width_m=each.width_m,
        height_m=each.height_m,
        distance_m=distance_m,
        confidence=each.confidence(now),
        age_s=max(0.0, now - each.first_s),
        unseen_s=max(0.0, now - each.last_s),
        vehicles=vehicles,
        label=each.label,
    )


def field_changes(before: Sequence[Tile], after: Sequence[Tile]) -> list[tuple[Tile, FieldChange]]:
    """Return the fields that ``after`` adds to tiles of ``before``, with the old tile of each."""
    known = {tile.name: tile for tile in before}
    changes = []
    for tile in after:
        old = known.get(tile.name)
        if old is None:
            continue
        if tile.field_id != old.field_id:
            change = FieldChange(FieldChangeKind.MAP, tile.name, tile.field_id, tile.version)
            changes.append((old, change))
        for light in tile.lights:
            if light.field_id not in old.renderable_ids:
                change = FieldChange(
                    FieldChangeKind.LIGHT, tile.name, light.field_id, light.version, light.name
                )
                changes.append((old, change))
    return changes


class StreetNotices:
    """Finds objects in the pictures of ``twin`` and warns the streams that ``takers`` returns."""

    def __init__(
        self,
        twin: Twin,
        views: ViewService,
        takers: Callable[[], Sequence[NoticeTaker]],
        tiles: Callable[[], tuple[Tile, ...]],
        metrics: TwinMetrics,
    ) -> None:
        self._twin = twin
        self._views = views
        self._takers = takers
        self._tiles = tiles
        self._metrics = metrics
        self._streams: dict[str, StreamNotices] = {}
        self._trackers: dict[frozenset[str], ObjectTracker] = {}

    async def follow(self) -> None:
        """Analyse pictures until no vehicle takes notices."""
        if not self._takers():
            return
        arrived = asyncio.Event()
        every = Subscription(encoding=PictureEncoding.NONE)
        mailbox = self._twin.watch(every, arrived.set, counts_misses=False)
        self._twin.expect = self._expect
        for taker in self._takers():
            for field_id in taker.hello.field_ids:
                self._views.prepare(self._tile_of(field_id), NOTICES_IDENTITY)
        try:
            while self._takers():
                entry = mailbox.take()
                if isinstance(entry, ReceivedPicture):
                    await self._look_at(entry)
                elif entry is None:
                    arrived.clear()
                    with suppress(TimeoutError):
                        async with asyncio.timeout(LOOK_AGAIN_S):
                            await arrived.wait()
        finally:
            self._twin.ignore_expected()
            self._twin.unwatch(mailbox)
            self._streams.clear()
            self._trackers.clear()

    def _expect(self, field_id: str, camera: Camera) -> None:
        """Prepare for a picture of ``camera``, coded against a field, that is being decoded."""
        self._views.expect_picture(camera, self._tile_of(field_id), NOTICES_IDENTITY)

    def _tile_of(self, field_id: str) -> ViewedTile:
        return viewed_tile(ObjectsRequest(field_id=field_id), self._tiles())

    def fields_changed(self, before: Sequence[Tile], after: Sequence[Tile]) -> None:
        """Notify the vehicles of a tile of its new field."""
        for tile, change in field_changes(before, after):
            for taker in self._takers():
                if tile.archive_ids.intersection(taker.hello.field_ids):
                    self._tell(taker, self._stream(taker).about_field(change))

    async def _look_at(self, picture: ReceivedPicture) -> None:
        """Find the objects in a picture, and send notices to the vehicles that they concern."""
        tile = self._tile_of(picture.field_id)
        takers = [
            taker for taker in self._takers() if tile.field_ids.intersection(taker.hello.field_ids)
        ]
        if not takers:
            self._trackers.pop(tile.field_ids, None)
            return
        try:
            found = await self._views.objects_in(picture, tile, NOTICES_IDENTITY)
        except LimitExceeded:
            return
        tracker = self._trackers.setdefault(tile.field_ids, ObjectTracker())
        tracker.take(
            found.detections, picture.key, picture.captured_s, found.rules_out, found.labels
        )
        now = time.monotonic()
        objects = [
            each
            for each in tracker.confirmed(now)
            if each.last_s == picture.captured_s and not each.is_doubtful
        ]
        self._forget_streams()
        for taker in takers:
            self._tell_of(taker, tile, objects, now)

    def _tell_of(
        self, taker: NoticeTaker, tile: ViewedTile, objects: Sequence[FollowedObject], now: float
    ) -> None:
        cameras = [
            [view for view in views if view.frame.pose is not None]
            for views in self._twin.cameras_of(taker.session_id)
            if views[-1].field_id in tile.field_ids and views[-1].age_s(now) <= KNOWN_FOR_S
            if views[-1].frame.pose is not None
        ]
        if not cameras:
            return
        camera_ids = [camera.camera_id for camera in taker.hello.cameras]
        stream, own = self._stream(taker), VehiclePosition.of(cameras, camera_ids)
        for notice in stream.about_objects(tile.field_id, own, objects, now):
            self._tell(taker, notice)

    def _tell(self, taker: NoticeTaker, notice: StreetNotice) -> None:
        taker.tell(notice)
        self._metrics.noticed(notice)

    def _stream(self, taker: NoticeTaker) -> StreamNotices:
        return self._streams.setdefault(taker.session_id, StreamNotices(taker.hello.vehicle_id))

    def _forget_streams(self) -> None:
        open_now = {taker.session_id for taker in self._takers()}
        for session_id in [each for each in self._streams if each not in open_now]:
            del self._streams[session_id]
