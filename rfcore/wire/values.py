"""Values that several messages share, to and from protobuf: poses, cameras, references, qualities.

How a frame was sensed (its clock, its localisation) is for those who look at the twin; nothing is
decoded by it, so a number that this end does not know, from a newer peer, counts as not stated.

Checks of single values that came from a peer or a file stand here too. Each raises ``InvalidInput``
naming the field, the value and the limit. What a dataclass of ``rfcore`` already checks
(intrinsics, poses) is left to it.
"""

from __future__ import annotations

import re
from dataclasses import fields
from enum import StrEnum
from functools import lru_cache
from typing import Any, Final, TypeVar, cast

from google.protobuf.message import Message

from rfcore.camera import Intrinsics, Pose, Vec3
from rfcore.codec.references import Reference, References
from rfcore.errors import InvalidInput
from rfcore.field.folder import FIELD_ID
from rfcore.field.quality import Quality
from rfcore.localise.estimate import LocalisationState
from rfcore.wire.v1 import edge_pb2 as pb

MAX_CAMERAS = 32
"""Cameras in one Hello: teleoperation has 4 (3GPP TS 22.156), the published rig 18."""

MAX_LEVER_ARM_M = 100.0
"""A camera this far from its rig's origin is on another vehicle."""

MAX_FIELDS = 64
"""Fields in one Hello or FieldNotice."""

MAX_PAYLOAD_BYTES = 1_000_000
"""One picture's P slice; with its header it stays below the 1 MiB receive limit."""

MAX_RATE_HZ = 1000.0
"""Pictures per second of one camera; faster ones exist, but not on a vehicle."""

MAX_TRANSLATION_M = 1e6
"""A pose this far from its tile's origin belongs to another tile."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def shown(text: str) -> str:
    """Return untrusted text as it may stand in a message: quoted, escaped, at most 80 long."""
    return ascii(text if len(text) <= 80 else text[:77] + "...")


def check_name(field: str, name: str) -> str:
    """Return a vehicle or camera id; it also has to serve as the name of a folder."""
    if not NAME.fullmatch(name):
        raise InvalidInput(
            field,
            f"{shown(name)} must be 1 to 64 letters, digits, '.', '_' or '-', "
            "beginning with a letter or digit",
        )
    return name


def check_label(field: str, label: str) -> str:
    """Return what an object is called: a name, or nothing."""
    return check_name(field, label) if label else ""


def check_field_id(field: str, field_id: str) -> str:
    """Return a field id."""
    if not FIELD_ID.fullmatch(field_id):
        raise InvalidInput(
            field, f"{shown(field_id)} must be the 64 hexadecimal digits of a sha256"
        )
    return field_id


def check_bytes(field: str, value: bytes, shortest: int, longest: int) -> bytes:
    """Return ``value`` if it is ``shortest..longest`` bytes long."""
    if not shortest <= len(value) <= longest:
        limit = f"{shortest}" if shortest == longest else f"{shortest}..{longest}"
        raise InvalidInput(field, f"{len(value)} bytes, expected {limit}")
    return value


def check_range(field: str, value: float, lowest: float, highest: float) -> float:
    """Return ``value`` if it is in ``lowest..highest``; NaN never is."""
    if not lowest <= value <= highest:
        raise InvalidInput(field, f"{value} is outside {lowest:g}..{highest:g}")
    return value


Value = TypeVar("Value")


def same_named(kind: type[Value], message: Message, **others: Any) -> Value:
    """Return a dataclass whose fields are those of a message by name, but ``others`` as given."""
    names = [field.name for field in fields(kind) if field.name not in others]  # type: ignore[arg-type]
    return kind(**{name: getattr(message, name) for name in names}, **others)


def intrinsics_to_wire(k: Intrinsics) -> pb.Intrinsics:
    """Return intrinsics as protobuf."""
    return pb.Intrinsics(**vars(k))


def intrinsics_from_wire(k: pb.Intrinsics) -> Intrinsics:
    """Return checked intrinsics; raise ``InvalidInput`` for impossible ones."""
    return Intrinsics(k.width_px, k.height_px, k.fx_px, k.fy_px, k.cx_px, k.cy_px)


def pose_to_wire(pose: Pose) -> pb.Pose:
    """Return a pose as protobuf."""
    x_m, y_m, z_m = pose.translation_m
    w, x, y, z = pose.rotation
    return pb.Pose(
        x_m=x_m, y_m=y_m, z_m=z_m, rotation_w=w, rotation_x=x, rotation_y=y, rotation_z=z
    )


def pose_from_wire(pose: pb.Pose) -> Pose:
    """Return a checked pose; raise ``InvalidInput`` for what is not finite or not a rotation."""
    rotation = (pose.rotation_w, pose.rotation_x, pose.rotation_y, pose.rotation_z)
    return Pose((pose.x_m, pose.y_m, pose.z_m), rotation)


def references_to_wire(references: References) -> list[pb.Reference.ValueType]:
    """Return the numbers of references."""
    return [cast(pb.Reference.ValueType, int(reference)) for reference in references]


@lru_cache(maxsize=64)
def references_from_wire(field: str, numbers: tuple[int, ...]) -> References:
    """Return the references of these numbers; raise ``InvalidInput`` naming ``field``."""
    try:
        return tuple(Reference(number) for number in numbers)
    except ValueError as error:
        raise InvalidInput(field, f"{error}; update this end") from error


def quality_to_wire(quality: Quality) -> pb.Quality:
    """Return a quality as protobuf."""
    return pb.Quality(
        detail_percent=0 if quality.detail == 1 else round(100 * quality.detail),
        sh_degree=quality.sh_degree,
        samples_per_ray=quality.samples_per_ray or 0,
        scale_percent=0 if quality.scale == 1 else round(100 * quality.scale),
    )


def quality_from_wire(quality: pb.Quality) -> Quality:
    """Return a checked quality; ``Quality`` itself refuses what is not on the ladder."""
    return Quality(
        (quality.detail_percent or 100) / 100,
        quality.sh_degree if quality.HasField("sh_degree") else None,
        quality.samples_per_ray or None,
        (quality.scale_percent or 100) / 100,
    )


def motion_to_wire(at_m: Vec3, velocity_mps: Vec3) -> dict[str, float]:
    """Return where an object is and how it moves, by the names of its message's fields."""
    (x_m, y_m, z_m), (vx, vy, vz) = at_m, velocity_mps
    place = {"x_m": x_m, "y_m": y_m, "z_m": z_m}
    return place | {"velocity_x_mps": vx, "velocity_y_mps": vy, "velocity_z_mps": vz}


def motion_from_wire(message: Any) -> tuple[Vec3, Vec3]:
    """Return where an object is and how it moves; raise ``InvalidInput`` for impossible values."""
    at_m = (message.x_m, message.y_m, message.z_m)
    velocity_mps = (message.velocity_x_mps, message.velocity_y_mps, message.velocity_z_mps)
    for value in (*at_m, *velocity_mps):
        check_range("object", value, -1e9, 1e9)
    return at_m, velocity_mps


class ClockKind(StrEnum):
    """Sources of a live camera's capture time."""

    SENDER_REPORT = "sender_report"
    ARRIVAL = "arrival"


CLOCKS: Final = {
    ClockKind.SENDER_REPORT: pb.CAPTURE_CLOCK_SENDER_REPORT,
    ClockKind.ARRIVAL: pb.CAPTURE_CLOCK_ARRIVAL,
}
STATES: Final = {
    LocalisationState.LOST: pb.LOCALISATION_LOST,
    LocalisationState.LOCALISING: pb.LOCALISATION_LOCALISING,
    LocalisationState.TRACKING: pb.LOCALISATION_TRACKING,
}
CLOCK_OF: Final[dict[int, ClockKind]] = {number: clock for clock, number in CLOCKS.items()}
STATE_OF: Final[dict[int, LocalisationState]] = {number: state for state, number in STATES.items()}


def clock_to_wire(clock: ClockKind | None) -> pb.CaptureClock.ValueType:
    """Return the number of ``clock``; 0 for none."""
    return pb.CAPTURE_CLOCK_UNSPECIFIED if clock is None else CLOCKS[clock]


def clock_from_wire(number: int) -> ClockKind | None:
    """Return the clock that ``number`` stands for, if any."""
    return CLOCK_OF.get(number)


def localisation_to_wire(state: LocalisationState | None) -> pb.Localisation.ValueType:
    """Return the number of ``state``; 0 for none: the pose was given."""
    return pb.LOCALISATION_UNSPECIFIED if state is None else STATES[state]


def localisation_from_wire(number: int) -> LocalisationState | None:
    """Return the state that ``number`` stands for, if any."""
    return STATE_OF.get(number)
