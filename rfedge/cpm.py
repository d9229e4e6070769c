"""The twin's objects as Collective Perception Messages (ETSI TS 103 324 V2.1.1) of a roadside unit.

Positions are metres east, north and up of a reference position on the Earth: the origin of the
field's axes, to the next 1e-7 degrees. Values are rounded up to the standard's units. A value
outside its range becomes the standard's code for that; what the twin does not know becomes
unavailable, as every confidence, or is left out, as acceleration and angles. An object is sent as
it was when last seen, ``measurementDeltaTime`` before the message's time. Its box is upright and as
deep as it is wide; its position is the middle. ``cpm.asn`` declares what is encoded. Nothing is
signed.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

from rfcore.camera import Vec3
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.field import FieldMetadata
from rfcore.geodesy import Anchor
from rfcore.perception.objects import StreetObject

with needs("v2x"):
    import asn1tools

MS, S = 1_000_000, 1_000_000_000
"""Nanoseconds."""
SAME_NS = 2 * MS
"""Times of one sighting differ so much: servers round the time since it to milliseconds."""

# Clause 6.1.2 and the recommended values of table F.1.
LEAST_PERIOD_NS, MOST_PERIOD_NS = 100 * MS, S
"""T_GenCpmMin and T_GenCpmMax."""
MOVED_M, FASTER_MPS, TURNED_DEG = 4.0, 0.5, 4.0
LEAST_QUALITY = 3
AVERAGING = 0.5
"""Weight of the newest value in the moving averages of an object's quality."""

STANDS_MPS = FASTER_MPS
"""Speed up to which the direction of a velocity is noise, and its change no reason to send."""
OBJECTS_EACH, MOST_OBJECTS = 32, 255
"""Objects in a message, which then stays below 1100 bytes; and in all messages of one time."""

ITS_EPOCH_S = 1_072_915_200
LEAP_SECONDS_S = (1136073600, 1230768000, 1341100800, 1435708800, 1483228800)
"""Unix times from which on TAI was a second further ahead of UTC than at the ITS epoch, 2004."""

RSU_CONTAINER, OBJECT_CONTAINER = 2, 5
LABELS = {
    **dict.fromkeys(("person", "pedestrian"), ("vruSubClass", ("pedestrian", 0))),
    **dict.fromkeys(("bicycle", "cyclist"), ("vruSubClass", ("bicyclistAndLightVruVehicle", 0))),
    "motorcycle": ("vruSubClass", ("motorcyclist", 0)),
    **dict.fromkeys(("animal", "dog", "horse"), ("vruSubClass", ("animal", 0))),
    **dict.fromkeys(("vehicle", "truck"), ("vehicleSubClass", 0)),
    "car": ("vehicleSubClass", 5),
    "bus": ("vehicleSubClass", 6),
    "tram": ("vehicleSubClass", 11),
}
"""The standard's class for a detector's name; others are sent without a class."""
TYPE_A = ("pedestrian", "bicyclistAndLightVruVehicle", "animal")
"""Classes that are sent twice as often, all together."""


@dataclass(frozen=True)
class Cpm:
    """A message: in UPER, and the same content as dicts with the standard's names and units."""

    uper: bytes
    content: dict[str, Any]

    def line(self) -> str:
        """Return both as one line of JSON, UPER as hexadecimal digits."""
        return json.dumps({"uper": self.uper.hex(), "cpm": _plain(self.content)})


def anchor_of(metadata: FieldMetadata) -> Anchor:
    """Return a field's anchor; raise ``InvalidInput`` if it states none."""
    if metadata.anchor is None:
        raise InvalidInput(
            "field",
            "states no place on the Earth, which these messages need: rfedge field anchor FIELD "
            "--at LATITUDE LONGITUDE HEIGHT --out FILE.rff, and serve that file",
        )
    return metadata.anchor


def its_time_ms(time_ns: int) -> int:
    """Return a Unix time as TimestampIts: milliseconds of TAI since 2004 began in UTC.

    Raises ``InvalidInput`` for a time that it cannot state.
    """
    leaps = sum(time_ns >= leap_s * S for leap_s in LEAP_SECONDS_S)
    time_ms = (time_ns - ITS_EPOCH_S * S) // MS + 1000 * leaps
    if not 0 <= time_ms < 1 << 42:
        year = 1970 + time_ns / S / 31_556_952
        raise InvalidInput("time", f"the year {year:.0f} is outside 2004..2143: set the clock")
    return time_ms


class MessageWriter:
    """Makes the messages of one roadside unit from objects placed in a field's axes."""

    def __init__(self, anchor: Anchor, station_id: int = 0) -> None:
        """Raise ``InvalidInput`` for a ``station_id`` that does not have 32 bits."""
        if not 0 <= station_id < 1 << 32:
            raise InvalidInput("station", f"{station_id} is outside 0..{(1 << 32) - 1}")
        latitude_deg, longitude_deg, height_m = anchor.geodetic_from_world((0.0, 0.0, 0.0))
        latitude, longitude = round(1e7 * latitude_deg), round(1e7 * longitude_deg)
        altitude = _up(height_m, 0.01)
        reference = Anchor(latitude / 1e7, longitude / 1e7, altitude * 0.01)
        self._origin_m, *ends_m = (
            reference.world_from_geodetic(*anchor.geodetic_from_world(point_m))
            for point_m in ((0.0, 0.0, 0.0), (1e2, 0.0, 0.0), (0.0, 1e2, 0.0), (0.0, 0.0, 1e2))
        )
        self._axes = [
            [(end - start) / 1e2 for end, start in zip(end_m, self._origin_m, strict=True)]
            for end_m in ends_m
        ]
        self._header = {"protocolVersion": 2, "messageId": 14, "stationId": station_id}
        self._reference = {
            "latitude": latitude,
            "longitude": 1_800_000_000 if longitude == -1_800_000_000 else longitude,
            "positionConfidenceEllipse": {
                "semiMajorConfidence": 4095,
                "semiMinorConfidence": 4095,
                "semiMajorOrientation": 3601,
            },
            "altitude": {
                "altitudeValue": min(max(altitude, -100_000), 800_000),
                "altitudeConfidence": "unavailable",
            },
        }

    def turned(self, vector: Vec3) -> Vec3:
        """Return a vector of the field's axes as east, north, up."""
        x, y, z = (
            sum(part * axis[i] for part, axis in zip(vector, self._axes, strict=True))
            for i in range(3)
        )
        return x, y, z

    def middle_m(self, one: StreetObject) -> Vec3:
        """Return east, north, up of an object's middle when it was last seen, m."""
        seen_at = [at - one.unseen_s * v for at, v in zip(one.at_m, one.velocity_mps, strict=True)]
        turned = self.turned((seen_at[0], seen_at[1], seen_at[2]))
        east, north, up = (o + t for o, t in zip(self._origin_m, turned, strict=True))
        return east, north, up + 0.5 * one.height_m

    def messages(
        self, objects: Sequence[tuple[StreetObject, int]], perceived: int, time_ns: int
    ) -> list[Cpm]:
        """Return messages with ``objects`` and their qualities, of ``perceived`` in all.

        One without objects is a message, too.
        """
        starts = range(0, max(1, len(objects)), OBJECTS_EACH)
        parts = [objects[start : start + OBJECTS_EACH] for start in starts]
        return [
            self._message(part, perceived, time_ns, (len(parts), number))
            for number, part in enumerate(parts, 1)
        ]

    def _message(
        self,
        objects: Sequence[tuple[StreetObject, int]],
        perceived: int,
        time_ns: int,
        segment: tuple[int, int],
    ) -> Cpm:
        management: dict[str, Any] = {
            "referenceTime": its_time_ms(time_ns),
            "referencePosition": self._reference,
        }
        if segment[0] > 1:
            management["segmentationInfo"] = {"totalMsgNo": segment[0], "thisMsgNo": segment[1]}
        containers = {
            RSU_CONTAINER: ("OriginatingRsuContainer", {}),
            OBJECT_CONTAINER: (
                "PerceivedObjectContainer",
                {
                    "numberOfPerceivedObjects": min(perceived, MOST_OBJECTS),
                    "perceivedObjects": [self._object(one, quality) for one, quality in objects],
                },
            ),
        }

        def message(data: dict[int, Any]) -> dict[str, Any]:
            wrapped = [{"containerId": i, "containerData": each} for i, each in data.items()]
            payload = {"managementContainer": management, "cpmContainers": wrapped}
            return {"header": self._header, "payload": payload}

        encoded = {i: _uper(*container) for i, container in containers.items()}
        uper = _uper("CollectivePerceptionMessage", message(encoded))
        return Cpm(uper, message({i: values for i, (_, values) in containers.items()}))

    def _object(self, one: StreetObject, quality: int) -> dict[str, Any]:
        velocity_mps = self.turned(one.velocity_mps)[:2]
        width, height = _dimension(one.width_m), _dimension(one.height_m)
        values: dict[str, Any] = {
            "objectId": one.object_id % (1 << 16),
            "measurementDeltaTime": max(-2048, math.ceil(-1e3 * one.unseen_s)),
            "position": {
                f"{axis}Coordinate": _confidence_unknown(_up(m, 0.01), (-131072, 131071), 4096)
                for axis, m in zip("xyz", self.middle_m(one), strict=True)
            },
            "velocity": (
                "cartesianVelocity",
                {
                    f"{axis}Velocity": _confidence_unknown(_up(mps, 0.01), (-16383, 16382), 127)
                    for axis, mps in zip("xy", velocity_mps, strict=True)
                },
            ),
            "objectDimensionZ": height,
            "objectDimensionY": width,
            "objectDimensionX": width,
            "objectAge": min(math.ceil(1e3 * one.age_s), 1500),
            "objectPerceptionQuality": quality,
        }
        if one.label in LABELS:
            values["classification"] = [{"objectClass": LABELS[one.label], "confidence": 101}]
        return values


@dataclass(frozen=True)
class _Told:
    """An object as it was last included in a message."""

    time_ns: int
    middle_m: Vec3
    velocity_mps: Vec3


@dataclass
class _Known:
    """Moving averages of an object's confidence and of whether it was seen; when it was told of."""

    confidence: float
    seen_ns: int
    seen: float = 1.0
    told: _Told | None = None

    def look(self, one: StreetObject, seen_ns: int) -> None:
        """Take in the object as it is now, last seen at a Unix time."""
        again = float(seen_ns - self.seen_ns > SAME_NS)
        self.confidence += AVERAGING * (one.confidence - self.confidence)
        self.seen += AVERAGING * (again - self.seen)
        self.seen_ns = seen_ns

    def quality(self, age_s: float) -> int:
        """Return objectPerceptionQuality: the mean of three ratings of 0 to 15, rounded down."""
        age = min(math.floor(10 * age_s), 15)
        return (math.floor(15 * self.confidence) + math.floor(15 * self.seen) + age) // 3


class CollectivePerception:
    """Decides by the standard's rules when to send a message, and which objects it tells of.

    Messages are at least 0.1 s apart, and at most 1 s while ``take`` is called. A message tells of
    an object that is new, or that since it was told of moved more than 4 m, changed its speed by
    more than 0.5 m/s or, moving, its direction by 4 degrees, or that was told of 1 s ago. People,
    bicycles and animals are told of when new, and all together when one of them was 0.5 s ago.
    Doubtful objects, and those of a quality below 3, do not count. Without clock and threads.
    """

    def __init__(self, writer: MessageWriter) -> None:
        self._writer = writer
        self._known: dict[int, _Known] = {}
        self._looked_ns: int | None = None
        self._sent_ns: int | None = None

    def take(self, objects: Iterable[StreetObject], time_ns: int) -> list[Cpm]:
        """Return the messages that are due when ``objects`` are there at a Unix time.

        Raises ``InvalidInput`` for an object whose values are not finite. A clock that is set back
        makes all objects new.
        """
        if self._looked_ns is not None and 0 <= time_ns - self._looked_ns < LEAST_PERIOD_NS:
            return []
        if self._looked_ns is not None and time_ns < self._looked_ns:
            self._known, self._sent_ns = {}, None
        self._looked_ns = time_ns
        there = [_finite(one) for one in objects if not one.is_doubtful]
        self._know(there, time_ns)
        rated = [(one, self._known[one.object_id].quality(one.age_s)) for one in there]
        sure = [pair for pair in rated if pair[1] >= LEAST_QUALITY]
        all_type_a = any(self._is_due(one, time_ns) for one, _ in sure if _is_type_a(one))
        due = [
            pair
            for pair in sure
            if self._known[pair[0].object_id].told is None
            or (all_type_a if _is_type_a(pair[0]) else self._is_due(pair[0], time_ns))
        ]
        due = sorted(due, key=lambda pair: -pair[1])[:MOST_OBJECTS]
        if not due and self._sent_ns is not None and time_ns - self._sent_ns < MOST_PERIOD_NS:
            return []
        self._sent_ns = time_ns
        for one, _ in due:
            told = _Told(time_ns, self._writer.middle_m(one), one.velocity_mps)
            self._known[one.object_id].told = told
        return self._writer.messages(due, len(there), time_ns)

    def _know(self, there: Iterable[StreetObject], time_ns: int) -> None:
        before, self._known = self._known, {}
        for one in there:
            seen_ns = time_ns - round(one.unseen_s * S)
            known = before.get(one.object_id)
            if known is None:
                known = _Known(one.confidence, seen_ns)
            else:
                known.look(one, seen_ns)
            self._known[one.object_id] = known

    def _is_due(self, one: StreetObject, time_ns: int) -> bool:
        """Whether an object that was told of is to be told of again."""
        told = self._known[one.object_id].told
        if told is None:
            return False
        if _is_type_a(one):
            return time_ns - told.time_ns >= MOST_PERIOD_NS / 2
        return (
            time_ns - told.time_ns >= MOST_PERIOD_NS
            or math.dist(self._writer.middle_m(one), told.middle_m) > MOVED_M
            or abs(math.hypot(*one.velocity_mps) - math.hypot(*told.velocity_mps)) > FASTER_MPS
            or _turned_deg(one.velocity_mps, told.velocity_mps) >= TURNED_DEG
        )


class CpmFile(AbstractContextManager["CpmFile"]):
    """A file with a line of JSON for each message, written at once; for several threads.

    Raises ``InvalidInput`` for a field without an anchor and a station id that is none.
    """

    def __init__(self, path: Path, metadata: FieldMetadata, station_id: int = 0) -> None:
        self._rules = CollectivePerception(MessageWriter(anchor_of(metadata), station_id))
        self._lock = threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("w", encoding="ascii")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._lock:
            self._file.close()

    def show_objects(self, objects: Iterable[StreetObject], time_ns: int) -> None:
        """Write the messages that are due when ``objects`` are there at a Unix time."""
        with self._lock:
            if self._file.closed:
                return
            for message in self._rules.take(objects, time_ns):
                self._file.write(message.line() + "\n")
            self._file.flush()


@cache
def _declaration() -> Any:
    return asn1tools.compile_files(str(Path(__file__).with_name("cpm.asn")), "uper")


def _uper(name: str, values: Any) -> bytes:
    return bytes(_declaration().encode(name, values, check_constraints=True))


def _up(value: float, unit: float) -> int:
    """Return a value in units, rounded up; what floating point adds does not count."""
    return math.ceil(round(value / unit, 2))


def _confidence_unknown(value: int, limits: tuple[int, int], unavailable: int) -> dict[str, int]:
    """Return a value within its limits, whose ends are the codes for what is outside them."""
    return {"value": min(max(value, limits[0]), limits[1]), "confidence": unavailable}


def _dimension(size_m: float) -> dict[str, int]:
    tenths = _up(size_m, 0.1)
    return _confidence_unknown(tenths, (1, 255), 32) if tenths > 0 else UNKNOWN_SIZE


UNKNOWN_SIZE = {"value": 256, "confidence": 32}


def _plain(value: Any) -> Any:
    """Return values as JSON has them; a choice is an object with one key."""
    if isinstance(value, tuple):
        return {value[0]: _plain(value[1])}
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value


def _finite(one: StreetObject) -> StreetObject:
    numbers = (*one.at_m, *one.velocity_mps, one.width_m, one.height_m, one.confidence)
    if not all(map(math.isfinite, (*numbers, one.age_s, one.unseen_s))):
        raise InvalidInput("object", f"{one.object_id} has values that are not finite: {one}")
    return one


def _is_type_a(one: StreetObject) -> bool:
    kind = LABELS.get(one.label, ("", ""))[1]
    return isinstance(kind, tuple) and kind[0] in TYPE_A


def _turned_deg(now: Vec3, before: Vec3) -> float:
    """Return the angle between two velocities; 0 if one is of a thing that stands."""
    speeds = math.hypot(*now) * math.hypot(*before)
    if min(math.hypot(*now), math.hypot(*before)) <= STANDS_MPS:
        return 0.0
    cosine = sum(a * b for a, b in zip(now, before, strict=True)) / speeds
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
