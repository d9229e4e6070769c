"""Tracking of objects that cameras see and the field lacks, over time and over cameras.

Without clock, sockets or threads, and deterministic: the same pictures in the same order give the
same objects.

A detection (``rfcore.perception.contacts``) is assigned to the nearest object within ``GATE_M`` and
a part of its distance from the camera, since its error grows with that; greedy, the nearest pair
first. The position and velocity of an object are estimated from its sightings of the last
``REMEMBERED_S`` by all cameras (``rfcore.perception.triangulation``).

A vehicle counts once at an instant, however many pictures it sends: the cameras of a rig see one
moment together, and with one pose. Pictures of a vehicle within ``SAME_INSTANT_S`` are of one
instant.

An object is *confirmed* by a third instant, by a second one of another vehicle, and at once by
``LARGE_PX`` marked pixels. A picture *misses* it if it should show the object and shows the field
there instead (``LivePicture.rules_out``), and no other picture of the vehicle at that instant shows
it. Its *confidence* is the share of the last ``LOOKS`` instants that did not miss it, and lower
after few. It is *doubtful* while no vehicle shows it whose pictures have a mean trust of
``LEAST_TRUST``: a picture of a wrong pose shows objects wherever the field has edges. It is
forgotten ``FORGOTTEN_S`` after its last picture.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import fmean

from rfcore.camera import Pose, Vec3
from rfcore.perception.contacts import Detection
from rfcore.perception.triangulation import Sighting, placed
from rfcore.vertical import upright_from

GATE_M = 1.5
GATE_PER_M = 0.1
REMEMBERED_S, MOST_REMEMBERED = 1.0, 12
"""Age and number of instants whose sightings place an object."""
SAME_INSTANT_S = 0.01
LOOKS = 40
MOST_SPEED_MPS = 60.0
SEEN_BY_S = 1.0
FORGOTTEN_S = 1.0
CONFIRMED_BY = 3
LARGE_PX = 600
"""On the sample's empty drive the largest contact of all has 248."""
SURE_BY = 4
"""Number of instants after which the confidence is not lowered any more."""
REPEAT_S = 0.5
LEAST_RANGE_M = 0.1
LEAST_TRUST = 0.7
"""Pictures of the sample's drive among parked and moving vehicles have 0.77 to 0.91, those at wrong
poses at most ``composition.MISPLACED_TRUST``."""

CameraKey = tuple[str, str]
"""(vehicle id, camera id)"""
RulesOut = Callable[[Vec3, float, float], bool]
"""Tests whether a picture should show an object at a place, of a width and height in metres, and
does not."""


@dataclass(frozen=True)
class StreetObject:
    """An object that the field lacks: see twin.proto.

    ``at_m``: the foot of its visible side, relative to the tile's origin; ``seen_by``: (vehicle id,
    camera id). ``is_doubtful``: only vehicles show it whose pictures fit the field badly, as with a
    wrong pose. ``label``: a detector's name for it, empty without a detector.
    """

    object_id: int
    at_m: Vec3
    velocity_mps: Vec3
    width_m: float
    height_m: float
    confidence: float
    age_s: float
    unseen_s: float
    seen_by: tuple[tuple[str, str], ...]
    is_doubtful: bool = False
    label: str = ""


def rules_nothing_out(_at_m: Vec3, _width_m: float, _height_m: float) -> bool:
    """Rule nothing out."""
    return False


@dataclass(frozen=True)
class _Instant:
    """A vehicle at one moment."""

    vehicle_id: str
    time_s: float

    def is_of(self, camera: CameraKey, time_s: float) -> bool:
        """Whether a picture belongs to it."""
        return camera[0] == self.vehicle_id and abs(time_s - self.time_s) <= SAME_INSTANT_S


@dataclass
class _Look:
    """The pictures of an object at one instant. ``marked_px``: the most in one of them; 0 for a
    miss."""

    instant: _Instant
    marked_px: int = 0


@dataclass(frozen=True)
class _TimedDetection:
    """An object in one picture."""

    instant: _Instant
    time_s: float
    detection: Detection


@dataclass
class FollowedObject:
    """An object over time.

    ``seen``: the number of instants that showed it; ``cameras``: when each saw it last;
    ``marked_px``: its marked pixels over all instants; ``labels``: how often a detector gave each
    name.
    """

    object_id: int
    at_m: Vec3
    velocity_mps: Vec3
    width_m: float
    height_m: float
    first_s: float
    last_s: float
    seen: int = 0
    cameras: dict[CameraKey, float] = field(default_factory=dict)
    marked_px: int = 0
    labels: Counter[str] = field(default_factory=Counter)
    _sightings: list[_TimedDetection] = field(default_factory=list, init=False)
    _looks: deque[_Look] = field(default_factory=lambda: deque(maxlen=LOOKS), init=False)

    @property
    def is_confirmed(self) -> bool:
        """Whether enough instants showed it."""
        agreed = len({vehicle_id for vehicle_id, _ in self.cameras}) > 1
        return self.seen >= CONFIRMED_BY - agreed or self.marked_px >= LARGE_PX

    @property
    def is_doubtful(self) -> bool:
        """Whether only vehicles show it whose pictures fit the field badly, in the mean."""
        trusts: dict[str, list[float]] = {}
        for each in self._sightings:
            trusts.setdefault(each.instant.vehicle_id, []).append(each.detection.trust)
        best = max((fmean(each) for each in trusts.values()), default=1.0)
        return best < LEAST_TRUST

    def confidence(self, now: float) -> float:
        """Return 0 to 1: lower after few instants, after misses, and while no camera sees it."""
        fresh = max(0.0, 1.0 - max(0.0, now - self.last_s) / FORGOTTEN_S)
        missed = sum(not look.marked_px for look in self._looks)
        agreed = 1.0 - missed / max(1, len(self._looks))
        return fresh * agreed * min(1.0, self.seen / SURE_BY)

    @property
    def label(self) -> str:
        """The most frequent name, empty without a detector."""
        return max(sorted(self.labels), key=lambda label: self.labels[label], default="")

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

    def report(self, now: float) -> StreetObject:
        """Return it as of ``now``."""
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
            is_doubtful=self.is_doubtful,
            label=self.label,
        )

    def take(self, detection: Detection, camera: CameraKey, time_s: float) -> None:
        """Update the position by a detection in a picture of ``camera``."""
        look = self._look(camera, time_s)
        self.seen += not look.marked_px
        marked_px = max(look.marked_px, detection.marked_px, 1)
        self.marked_px += marked_px - look.marked_px
        look.marked_px = marked_px
        self.last_s = max(self.last_s, time_s)
        self._remember(_TimedDetection(look.instant, time_s, detection))
        shared = Counter(each.instant for each in self._sightings)
        votes = [1 / shared[each.instant] for each in self._sightings]
        upright = upright_from(detection.up)
        field_from_upright = upright.inverse()
        sightings = zip(self._sightings, votes, strict=True)
        placement = placed([_sighting(each, vote, upright) for each, vote in sightings])
        self.at_m = field_from_upright.apply((*placement.at_m, self._foot_z_m(votes, upright)))
        speed_mps = math.hypot(*placement.velocity_mps)
        slower = min(1.0, MOST_SPEED_MPS / speed_mps) if speed_mps else 1.0
        vx_mps, vy_mps = placement.velocity_mps
        self.velocity_mps = field_from_upright.apply((slower * vx_mps, slower * vy_mps, 0.0))
        self.width_m, self.height_m = detection.width_m, detection.height_m
        self.cameras[camera] = time_s

    def miss(self, camera: CameraKey, time_s: float) -> None:
        """Note that a picture should show it and does not."""
        self._look(camera, time_s)

    def _look(self, camera: CameraKey, time_s: float) -> _Look:
        """Return the look of a picture's instant at it, which may begin with this picture."""
        for look in reversed(self._looks):
            if look.instant.is_of(camera, time_s):
                return look
        begun = _Look(_Instant(camera[0], time_s))
        self._looks.append(begun)
        return begun

    def _remember(self, seen: _TimedDetection) -> None:
        """Add a sighting, and forget those that are too old or too many."""
        self._sightings.append(seen)
        late = [each for each in self._sightings if self.last_s - each.time_s <= REMEMBERED_S]
        instants = list(dict.fromkeys(each.instant for each in late))[-MOST_REMEMBERED:]
        self._sightings = [each for each in late if each.instant in instants]

    def _foot_z_m(self, votes: Sequence[float], upright: Pose) -> float:
        """Return the height of its foot: the mean, weighted as ranges are."""
        seen = zip(self._sightings, votes, strict=True)
        weights = [vote / each.detection.along_sigma_m**2 for each, vote in seen]
        heights_m = [upright.apply(each.detection.at_m)[2] for each in self._sightings]
        return sum(w * z for w, z in zip(weights, heights_m, strict=True)) / sum(weights)


def _sighting(seen: _TimedDetection, vote: float, upright: Pose) -> Sighting:
    """Return the sighting on the ground that a detection stands for; ``upright``: from its field's
    axes to those of the ground."""
    detection = seen.detection
    at_m, eye_m = upright.apply(detection.at_m), upright.apply(detection.eye_m)
    x_m, y_m = (at_m[axis] - eye_m[axis] for axis in (0, 1))
    range_m = max(math.hypot(x_m, y_m), LEAST_RANGE_M)
    return Sighting(
        seen.time_s,
        eye_m[:2],
        math.atan2(y_m, x_m),
        detection.across_sigma_m / range_m,
        range_m,
        detection.along_sigma_m,
        vote,
    )


class ObjectTracker:
    """Tracks objects through the pictures of all cameras of a place."""

    def __init__(self) -> None:
        self._objects: list[FollowedObject] = []
        self._next_id = 1

    def take(
        self,
        detections: Sequence[Detection],
        camera: CameraKey,
        time_s: float,
        rules_out: RulesOut = rules_nothing_out,
        labels: Sequence[str] = (),
    ) -> None:
        """Take in one picture of ``camera``, captured at ``time_s``.

        ``detections``: the objects that it shows; ``rules_out``: tests whether it should show an
        object and does not; ``labels``: a detector's name for each detection, if there is one.
        """
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
                each = by_id.pop(object_id)
                each.take(detections[index], camera, time_s)
                each.labels.update(filter(None, labels[index : index + 1]))
                free.discard(index)
        for each in by_id.values():
            if rules_out(each.at(time_s), each.width_m, each.height_m):
                each.miss(camera, time_s)
        for index in sorted(free):
            begun = self._begin(detections[index], camera, time_s)
            begun.labels.update(filter(None, labels[index : index + 1]))

    def confirmed(self, now: float) -> list[FollowedObject]:
        """Return the confirmed objects that are not forgotten, sorted by id."""
        return [
            each for each in self._objects if each.is_confirmed and now - each.last_s <= FORGOTTEN_S
        ]

    def _begin(self, detection: Detection, camera: CameraKey, time_s: float) -> FollowedObject:
        begun = FollowedObject(
            self._next_id,
            detection.at_m,
            (0.0, 0.0, 0.0),
            detection.width_m,
            detection.height_m,
            time_s,
            time_s,
        )
        begun.take(detection, camera, time_s)
        self._objects.append(begun)
        self._next_id += 1
        return begun


class ObjectReports:
    """Reports a tracker's objects to one consumer: whenever ``now`` is called, and again at
    ``again_s`` while there are any, so that objects that nobody sees disappear where no pictures
    come."""

    def __init__(self) -> None:
        self.tracker = ObjectTracker()
        self.again_s = math.inf

    def now(self, now: float) -> tuple[StreetObject, ...]:
        """Return the confirmed objects, as of ``now``."""
        objects = tuple(each.report(now) for each in self.tracker.confirmed(now))
        self.again_s = now + REPEAT_S if objects else math.inf
        return objects
