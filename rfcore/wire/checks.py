"""Checks of single values that came from a peer or a file.

Each raises ``InvalidInput`` naming the field, the value and the limit. What a dataclass of
``rfcore`` already checks (intrinsics, poses) is left to it.
"""

from __future__ import annotations

import re

from rfcore.errors import InvalidInput
from rfcore.field.store import FIELD_ID

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

FIELD_ID_PREFIX_BYTES = 8
"""Of the 32 bytes of a field's sha256, how many each frame repeats."""

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


def check_absent_or(field: str, value: bytes, length: int) -> bytes:
    """Return ``value`` if it is ``length`` bytes long, or empty because it was left out."""
    if len(value) not in (0, length):
        raise InvalidInput(field, f"{len(value)} bytes, expected 0 or {length}")
    return value


def check_range(field: str, value: float, lowest: float, highest: float) -> float:
    """Return ``value`` if it is in ``lowest..highest``; NaN never is."""
    if not lowest <= value <= highest:
        raise InvalidInput(field, f"{value} is outside {lowest:g}..{highest:g}")
    return value
