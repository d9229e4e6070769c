"""Drive a car of one's own through a street as vehicles see it, or saw it.

``TwinDrive`` moves a camera by a kinematic bicycle model through a ``Street``: one that a server
shows (``ServedStreet``), or one that was recorded (``RecordedStreet``, from what ``mec-server
--record`` keeps or any posed pictures with times). Every step takes ``1 / RATE_HZ`` seconds of the
street's time and returns picture, depth and objects. A recorded street has no clock: the same
recording and the same actions give the same bytes. Nothing in the street reacts to the car, and
nothing stops it but the end of the field.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Protocol

import grpc
import numpy as np
from numpy.typing import NDArray

from mec_server.twin.rendering import check_inside, check_outside_of_walls
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.dataset.picture_file import read_picture
from rfcore.dataset.recorded_session import (
    RecordedPart,
    RecordedPicture,
    read_recorded_part,
    recordings_under,
)
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.image import Rgb
from rfcore.perception.composition import LivePicture, compose, live_picture, nearest
from rfcore.perception.contacts import cut_out
from rfcore.perception.ground import FieldGround
from rfcore.perception.objects import CameraKey, ObjectTracker, StreetObject
from rfcore.views import PosedPicture
from rfcore.wire.twin import PictureEncoding
from rfcore.wire.twin_render import (
    ObjectsRequest,
    ViewRequest,
    objects_from_wire,
    objects_request_to_wire,
    render_view,
)
from rfcore.wire.v1 import twin_pb2_grpc

__all__ = [
    "RATE_HZ",
    "Observation",
    "Place",
    "RecordedStreet",
    "ServedStreet",
    "Street",
    "TwinDrive",
    "place_of",
    "steering_towards",
]

RATE_HZ = 10.0
WHEELBASE_M = 2.7
MOST_STEERING_RAD = 0.6
ACCELERATION_MPS2, BRAKING_MPS2 = 3.0, 8.0
MOST_SPEED_MPS = 15.0
LOOKS_AHEAD_M = 6.0
MAX_AGE_S = 2.0
"""As a server's views: older pictures vouch for nothing."""

SAME_TIME_S = 1e-6
MOST_CLOCK_ERROR_S = 2.0
"""Of a recorded vehicle: one whose pictures were recorded that much before or after they say they
were taken is timed by the server's clock."""

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Place:
    """Where the car's camera is, above the middle of the rear axle: relative to the tile's origin,
    heading from x towards y, and how fast the car goes."""

    x_m: float
    y_m: float
    z_m: float
    heading_rad: float
    speed_mps: float = 0.0

    def camera(self, intrinsics: Intrinsics) -> Camera:
        """Return the level camera that looks ahead."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        rows = [[sin, 0.0, cos, self.x_m], [-cos, 0.0, sin, self.y_m], [0.0, -1.0, 0.0, self.z_m]]
        return Camera(intrinsics, Pose.from_matrix(rows))

    def after(self, steer: float, throttle: float, seconds: float) -> Place:
        """Return the place a moment later: the kinematic bicycle model, about the rear axle.

        ``steer`` and ``throttle`` are -1 to 1, left and forward; a negative throttle brakes, and
        the car does not reverse. (Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.2.)
        """
        pull = throttle * (ACCELERATION_MPS2 if throttle > 0 else BRAKING_MPS2)
        speed = min(MOST_SPEED_MPS, max(0.0, self.speed_mps + pull * seconds))
        driven_m = (self.speed_mps + speed) / 2 * seconds
        turn_rad = driven_m / WHEELBASE_M * math.tan(steer * MOST_STEERING_RAD)
        middle_rad = self.heading_rad + turn_rad / 2
        return replace(
            self,
            x_m=self.x_m + driven_m * math.cos(middle_rad),
            y_m=self.y_m + driven_m * math.sin(middle_rad),
            heading_rad=math.remainder(self.heading_rad + turn_rad, math.tau),
            speed_mps=speed,
        )


def place_of(pose: Pose) -> Place:
    """Return the place of a camera, world_from_cam: as it stands and looks, but level."""
    forward = np.array(pose.rotation_matrix())[:, 2]
    return Place(*pose.translation_m, heading_rad=math.atan2(forward[1], forward[0]))


@dataclass(frozen=True, eq=False)
class Observation:
    """``picture`` uint8 [H, W, 3]; ``depth`` float32 [H, W], metres along the optical axis, 0 for
    nothing; ``live`` bool [H, W]: where a vehicle's picture vouches, else the field; ``objects``:
    what the field does not have; ``ended``: the car has left the field, and stays where it is."""

    place: Place
    picture: Rgb
    depth: F32
    live: NDArray[np.bool_]
    objects: tuple[StreetObject, ...]
    ended: bool = False

    def digest(self) -> bytes:
        """Return the SHA-256 of picture, depth and objects."""
        seen = hashlib.sha256(self.picture.tobytes() + self.depth.tobytes())
        seen.update(repr(self.objects).encode())
        return seen.digest()


def steering_towards(place: Place, way: Sequence[Sequence[float]]) -> float:
    """Return -1 to 1: pure pursuit of the first point of ``way`` (x, y) that is ``LOOKS_AHEAD_M``
    ahead, 0 where there is none (Coulter, CMU-RI-TR-92-01)."""
    cos, sin = math.cos(place.heading_rad), math.sin(place.heading_rad)
    for x_m, y_m in way:
        dx, dy = x_m - place.x_m, y_m - place.y_m
        if dx * cos + dy * sin >= LOOKS_AHEAD_M:
            return max(-1.0, min(1.0, 4 * (dy * cos - dx * sin) / math.hypot(dx, dy)))
    return 0.0


class Street(Protocol):
    """What can be driven through."""

    def begin(self) -> None:
        """Begin at the street's first moment."""

    def pass_time(self, seconds: float) -> None:
        """Let time pass."""

    def look(self, camera: Camera) -> tuple[Rgb, F32, NDArray[np.bool_], tuple[StreetObject, ...]]:
        """Return picture, depth, where it is live, and objects; raise ``InvalidInput`` where there
        is nothing to see."""


class TwinDrive:
    """A car in a street: ``reset``, then ``step`` again and again."""

    def __init__(self, street: Street, intrinsics: Intrinsics, rate_hz: float = RATE_HZ) -> None:
        if not 0.1 <= rate_hz <= 100:
            raise InvalidInput("rate_hz", f"{rate_hz:g} is outside 0.1..100")
        self._street = street
        self._intrinsics = intrinsics
        self._step_s = 1.0 / rate_hz
        self._seen: Observation | None = None

    @property
    def seen(self) -> Observation | None:
        """What ``reset`` or ``step`` returned last."""
        return self._seen

    def reset(self, place: Place) -> Observation:
        """Begin anew at a place; raise ``InvalidInput`` for one outside of the field."""
        self._street.begin()
        self._seen = Observation(place, *self._street.look(place.camera(self._intrinsics)))
        return self._seen

    def step(self, steer: float, throttle: float) -> Observation:
        """Drive on for one step; raise ``InvalidInput`` for actions outside of -1 to 1."""
        for name, value in (("steer", steer), ("throttle", throttle)):
            if not -1 <= value <= 1:
                raise InvalidInput(name, f"{value:g} is outside -1..1")
        seen = self._seen
        if seen is None:
            raise InvalidInput("step", "the drive has not begun; call reset(place) first")
        if not seen.ended:
            self._street.pass_time(self._step_s)
            place = seen.place.after(steer, throttle, self._step_s)
            try:
                seen = Observation(place, *self._street.look(place.camera(self._intrinsics)))
            except InvalidInput:
                seen = replace(seen, ended=True)
            self._seen = seen
        return seen


class RecordedStreet:
    """A street as recorded cameras saw it; it begins again when its recording ends.

    ``cameras``: each one's pictures in the order of time, on one clock (``time_ns``). ``keys``:
    which vehicle and camera each is, by which objects say who sees them; without it they are
    numbered.
    """

    def __init__(
        self,
        field: RadianceField,
        cameras: Sequence[Sequence[PosedPicture]],
        keys: Sequence[CameraKey] = (),
    ) -> None:
        self.cameras = tuple(tuple(camera) for camera in cameras)
        self._keys = tuple(keys) or tuple(
            ("recorded", f"camera-{number}") for number in range(len(cameras))
        )
        if len(self._keys) != len(cameras):
            raise InvalidInput("keys", f"{len(self._keys)} are not one for {len(cameras)} cameras")
        pictures = [(p.time_ns, n, p) for n, camera in enumerate(cameras) for p in camera]
        self._pictures = sorted(pictures, key=lambda it: it[:2])
        if not pictures:
            raise InvalidInput("recording", "it has no pictures")
        if len(pictures) > 1 and self._pictures[0][0] == self._pictures[-1][0]:
            raise InvalidInput("recording", "its pictures have no times, or all the same")
        self._field = field
        self._ground = FieldGround(field.render)
        self._live: dict[int, tuple[float, LivePicture]] = {}
        self.begin()

    @staticmethod
    def of_recording(field: RadianceField, folder: Path) -> RecordedStreet:
        """Return what ``mec-server --record`` kept in ``folder``, in the tile of ``field``.

        The parts of a camera are joined in the order of time. A vehicle whose clock was wrong is
        timed by the server's (``MOST_CLOCK_ERROR_S``). Pictures of cameras that were lost are left
        out. Raises ``DatasetError`` for a damaged recording, ``InvalidInput`` for none.
        """
        pictures: dict[CameraKey, list[PosedPicture]] = {}
        for file in recordings_under(folder):
            part = read_recorded_part(file)
            key = (part.camera.vehicle_id, part.camera.camera_id)
            pictures.setdefault(key, []).extend(_posed(part, field.metadata.tile_origin))
        cameras = {key: sorted(of, key=lambda it: it.time_ns) for key, of in pictures.items() if of}
        if not cameras:
            raise InvalidInput("recording", f"{folder} has no pictures with a pose")
        keys = sorted(cameras)
        return RecordedStreet(field, [cameras[key] for key in keys], keys)

    @property
    def lasts_s(self) -> float:
        """From the first picture to the last."""
        return (self._pictures[-1][0] - self._pictures[0][0]) / 1e9

    def begin(self) -> None:
        """Go back to the first picture."""
        self._now_s = 0.0
        self._next = 0
        self._live.clear()
        self._tracker = ObjectTracker()
        self._take_up()

    def pass_time(self, seconds: float) -> None:
        """Let time pass; raise ``InvalidInput`` for none or less."""
        if not seconds > 0:
            raise InvalidInput("seconds", f"{seconds:g} is not above 0")
        self._now_s += seconds
        self._take_up()
        if self._now_s > self.lasts_s + MAX_AGE_S + SAME_TIME_S:
            self.begin()

    def look(self, camera: Camera) -> tuple[Rgb, F32, NDArray[np.bool_], tuple[StreetObject, ...]]:
        """Return what a camera would see now; raise ``InvalidInput`` outside of the field."""
        check_inside(camera, self._field)
        view = self._field.render(camera)
        check_outside_of_walls(view)
        live = [
            (picture, self._now_s - taken_s)
            for taken_s, picture in self._live.values()
            if self._now_s - taken_s < MAX_AGE_S
        ]
        near = nearest(live, camera, lambda it: it[0].camera.world_from_cam)
        seen = compose(camera, view, near, MAX_AGE_S)
        return seen.rgb, seen.depth, np.isfinite(seen.age_s), self._objects()

    def _take_up(self) -> None:
        """Look at the pictures that were taken until now."""
        first_ns = self._pictures[0][0]
        while self._next < len(self._pictures):
            time_ns, number, picture = self._pictures[self._next]
            taken_s = (time_ns - first_ns) / 1e9
            if taken_s > self._now_s + SAME_TIME_S:
                return
            self._next += 1
            live = live_picture(picture.camera, picture.read(), self._field.render(picture.camera))
            live, detections = cut_out(live, self._ground)
            self._live[number] = (taken_s, live)
            self._tracker.take(detections, self._keys[number], taken_s, live.lacks)

    def _objects(self) -> tuple[StreetObject, ...]:
        now_s = self._now_s
        return tuple(each.told(now_s) for each in self._tracker.confirmed(now_s))


def _posed(part: RecordedPart, origin: TileOrigin) -> Iterator[PosedPicture]:
    """Yield the pictures of a part that have a pose, in a tile of ``origin``."""
    offset_ns = _clock_offset_ns(part)
    for picture in part.pictures:
        if picture.world_from_cam is not None:
            camera = Camera(part.camera.intrinsics, origin.localise(picture.world_from_cam))
            yield PosedPicture(
                picture.file,
                camera,
                partial(_read, part, picture),
                picture.capture_time_ns + offset_ns,
            )


def _read(part: RecordedPart, picture: RecordedPicture) -> Rgb:
    return read_picture(part.path(picture), part.camera.intrinsics)


def _clock_offset_ns(part: RecordedPart) -> int:
    """Return what a vehicle's clock lacks, 0 for one that is about right.

    The folder of a part is named by when it was begun, on the server's clock: right after its first
    picture was taken. One that is not named so is taken to be right.
    """
    start, _, _ = part.file.parent.name.partition("-")
    if not (start.isascii() and start.isdigit() and part.pictures):
        return 0
    offset_ns = int(start) * 10**6 - part.pictures[0].capture_time_ns
    return 0 if abs(offset_ns) <= MOST_CLOCK_ERROR_S * 1e9 else offset_ns


class ServedStreet:
    """The street as a server sees it now, while it is entered; ``tile`` or ``field_id`` says which.

    Time passes by itself, on the clock ``now``: ``pass_time`` waits (``sleep``) for the next tick,
    so that steps follow each other at a fixed rate; after a step that took longer than one, the
    next follows at once, and what was late stays late. Objects are those of the newest picture of
    any vehicle.
    """

    def __init__(
        self,
        channel: grpc.Channel,
        tile: str = "",
        field_id: str = "",
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._channel = channel
        self._now, self._sleep = now, sleep
        self._tick_s = now()
        self._place = ObjectsRequest(tile, field_id)
        self._number = 0
        self._objects: tuple[StreetObject, ...] = ()
        self._call = twin_pb2_grpc.TwinServiceStub(channel).Objects(
            objects_request_to_wire(self._place), wait_for_ready=True
        )
        self._reading = Thread(target=self._read, name="objects", daemon=True)

    def __enter__(self) -> ServedStreet:
        self._reading.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._call.cancel()
        self._reading.join()

    def begin(self) -> None:
        """Count ticks from now on: the street is as it is."""
        self._tick_s = self._now()

    def pass_time(self, seconds: float) -> None:
        """Return ``seconds`` after the last tick, at once if that is past."""
        due_s, now_s = self._tick_s + seconds, self._now()
        if due_s > now_s:
            self._sleep(due_s - now_s)
        self._tick_s = max(due_s, now_s)

    def look(self, camera: Camera) -> tuple[Rgb, F32, NDArray[np.bool_], tuple[StreetObject, ...]]:
        """Return what a camera would see now.

        Raises ``InvalidInput`` outside of the field, ``grpc.RpcError`` for whatever else fails.
        """
        self._number += 1
        request = ViewRequest(
            camera,
            tile=self._place.tile,
            field_id=self._place.field_id,
            encoding=PictureEncoding.PNG,
            number=self._number,
        )
        try:
            view = render_view(self._channel, request)
        except grpc.RpcError as error:
            if error.code() is not grpc.StatusCode.INVALID_ARGUMENT:
                raise
            raise InvalidInput("place", str(error.details())) from error
        rgb = view.rgb
        assert rgb is not None
        return rgb, view.depth, view.live, self._objects

    def _read(self) -> None:
        """Keep the newest objects until the call ends, and none then; whoever looks hears why from
        ``look``."""
        with suppress(grpc.RpcError):
            for response in self._call:
                self._objects = objects_from_wire(response).objects
        self._objects = ()
