"""Notices from a server to a vehicle about the street: values, and their form on the wire.

See ``StreetNotice`` in ``edge.proto``. Times are durations, since the clocks of both ends may
differ: a notice expires ``valid_for_s`` after it arrived.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rfcore.errors import InvalidInput, ProtocolError
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import (
    check_field_id,
    check_label,
    check_name,
    check_range,
    motion_from_wire,
    motion_to_wire,
    same_named,
)

OBJECT = "object"
MAX_VALID_S = 3600.0
MAX_AGE_MS = 2**32 - 1

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class ObjectAhead:
    """An object that other cameras see and the field does not have.

    ``at_m`` is where it stands; like ``velocity_mps`` it is in the axes of the tile of field
    ``field_id``. ``confidence`` is 0 to 1. ``age_s`` counts from when it was first seen,
    ``unseen_s`` from the capture of the picture that showed it last. ``vehicles`` is how many
    vehicles' cameras see it. ``label`` names its class, empty where the server has no detector.
    """

    field_id: str
    at_m: Vec3
    velocity_mps: Vec3
    width_m: float
    height_m: float
    distance_m: float
    confidence: float
    age_s: float
    unseen_s: float
    vehicles: int
    label: str = ""


class FieldChangeKind(StrEnum):
    """Relation of a newly published field to its tile."""

    MAP = "map"
    LIGHT = "light"


NOTICE_KINDS = (OBJECT, *map(str, FieldChangeKind))


@dataclass(frozen=True)
class FieldChange:
    """A field that was published for a tile; ``light`` is its name, empty for a map."""

    kind: FieldChangeKind
    tile: str
    field_id: str
    version: int
    light: str = ""


Subject = ObjectAhead | FieldChange


@dataclass(frozen=True)
class StreetNotice:
    """A notice; ``notice_id`` stays the same as long as a stream tells of the same subject."""

    notice_id: int
    valid_for_s: float
    subject: Subject

    @property
    def kind(self) -> str:
        """Kind of its subject: one of ``NOTICE_KINDS``."""
        subject = self.subject
        return str(subject.kind) if isinstance(subject, FieldChange) else OBJECT


KINDS = {
    kind: pb.FieldChangeKind.Value(f"FIELD_CHANGE_KIND_{kind.name}") for kind in FieldChangeKind
}
KINDS_BACK = {number: kind for kind, number in KINDS.items()}


def notice_to_wire(notice: StreetNotice) -> pb.StreetNotice:
    """Return a notice as protobuf."""
    message = pb.StreetNotice(
        notice_id=notice.notice_id, valid_for_ms=_milliseconds(notice.valid_for_s)
    )
    match notice.subject:
        case ObjectAhead() as ahead:
            message.object.CopyFrom(_object_to_wire(ahead))
        case FieldChange(kind, tile, field_id, version, light):
            change = pb.FieldChange(
                kind=KINDS[kind], tile=tile, field_id=field_id, version=version, light=light
            )
            message.field_change.CopyFrom(change)
    return message


def notice_from_wire(message: pb.StreetNotice) -> StreetNotice | None:
    """Return a notice, ``None`` for one of a subject or kind that only a newer server knows.

    Raises ``ProtocolError`` for values that cannot be.
    """
    try:
        subject = _subject_from_wire(message)
        valid_for_s = check_range("valid_for_s", message.valid_for_ms / 1e3, 0.0, MAX_VALID_S)
    except InvalidInput as error:
        raise ProtocolError(f"the server sent an impossible notice: {error}") from error
    return None if subject is None else StreetNotice(message.notice_id, valid_for_s, subject)


def _subject_from_wire(message: pb.StreetNotice) -> Subject | None:
    match message.WhichOneof("subject"):
        case "object":
            return _object_from_wire(message.object)
        case "field_change":
            change = message.field_change
            kind = KINDS_BACK.get(change.kind)
            if kind is None:
                return None
            light = check_name("light", change.light) if change.light else ""
            return FieldChange(
                kind,
                check_name("tile", change.tile),
                check_field_id("field_id", change.field_id),
                change.version,
                light,
            )
    return None


def _object_to_wire(ahead: ObjectAhead) -> pb.ObjectAhead:
    return pb.ObjectAhead(
        field_id=ahead.field_id,
        **motion_to_wire(ahead.at_m, ahead.velocity_mps),
        width_m=ahead.width_m,
        height_m=ahead.height_m,
        distance_m=ahead.distance_m,
        confidence=ahead.confidence,
        age_ms=_milliseconds(ahead.age_s),
        unseen_ms=_milliseconds(ahead.unseen_s),
        vehicles=ahead.vehicles,
        label=ahead.label,
    )


def _object_from_wire(message: pb.ObjectAhead) -> ObjectAhead:
    at_m, velocity_mps = motion_from_wire(message)
    for size_m in (message.width_m, message.height_m, message.distance_m):
        check_range("object", size_m, 0.0, 1e9)
    return same_named(
        ObjectAhead,
        message,
        field_id=check_field_id("field_id", message.field_id),
        at_m=at_m,
        velocity_mps=velocity_mps,
        confidence=check_range("confidence", message.confidence, 0.0, 1.0),
        age_s=message.age_ms / 1e3,
        unseen_s=message.unseen_ms / 1e3,
        label=check_label("label", message.label),
    )


def _milliseconds(seconds: float) -> int:
    return min(MAX_AGE_MS, max(0, round(1e3 * seconds)))
