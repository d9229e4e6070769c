"""Tells which colours an ICC profile states (ICC.1:2022), by its numbers, not by its name.

A matrix profile has the colours of its red, green and blue under D50. Known ones become sRGB; the
others are taken as sRGB, and that is said. Their transfer is taken to be about sRGB's, unless it
is linear.
"""

from __future__ import annotations

import numpy as np

P3, REC2020, OTHER_PROFILE = "Display P3", "Rec. 2020", "other"
PRIMARIES = {P3: 12, REC2020: 9}
"""Codes of ITU-T H.273, by the profile's name."""
COLORANTS = {
    None: ((0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141)),
    P3: ((0.5151, 0.2412, -0.0011), (0.2920, 0.6922, 0.0419), (0.1571, 0.0666, 0.7841)),
    REC2020: ((0.6734, 0.2790, -0.0019), (0.1656, 0.6753, 0.0300), (0.1251, 0.0456, 0.7968)),
}
"""XYZ of red, green and blue; ``None``: sRGB's."""
TOLERANCE = 0.004
"""Profiles were adapted to D50 by several roundings of one matrix."""
HEADER_BYTES, ENTRY_BYTES, MOST_TAGS = 128, 12, 100
UNIT = 65536
"""One, of the fixed-point numbers of a profile."""


def profile_of(icc: bytes) -> str | None:
    """Return ``P3``, ``REC2020``, ``OTHER_PROFILE``, or ``None`` for sRGB and without a profile."""
    if not icc:
        return None
    tags = _tags(icc)
    xyz = [_xyz(tags.get(name, b"")) for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    if not all(xyz):  # grey, or by tables: only its text says what it is
        return None if b"sRGB" in icc.replace(b"\0", b"") else OTHER_PROFILE
    if _is_linear(tags.get(b"rTRC", b"")):
        return OTHER_PROFILE
    for name, known in COLORANTS.items():
        if np.abs(np.array(xyz) - known).max() <= TOLERANCE:
            return name
    return OTHER_PROFILE


def _tags(icc: bytes) -> dict[bytes, bytes]:
    """Return the content of each tag; what lies outside the file is empty."""
    count = min(int.from_bytes(icc[HEADER_BYTES : HEADER_BYTES + 4]), MOST_TAGS)
    tags = {}
    for number in range(count):
        at = HEADER_BYTES + 4 + ENTRY_BYTES * number
        start, size = (int.from_bytes(icc[at + k : at + k + 4]) for k in (4, 8))
        tags[icc[at : at + 4]] = icc[start : start + size]
    return tags


def _xyz(tag: bytes) -> tuple[float, ...]:
    if tag[:4] != b"XYZ " or len(tag) < 20:
        return ()
    return tuple(int.from_bytes(tag[k : k + 4], signed=True) / UNIT for k in (8, 12, 16))


def _is_linear(curve: bytes) -> bool:
    """Return whether a transfer curve is the identity."""
    if curve[:4] == b"curv":
        count = int.from_bytes(curve[8:12])
        return count == 0 or (count == 1 and curve[12:14] == b"\1\0")
    if curve[:4] == b"para":
        return curve[8:10] == b"\0\0" and int.from_bytes(curve[12:16]) == UNIT
    return False
