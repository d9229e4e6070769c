"""Every error rfedge raises on purpose, as one tree.

::

    RfedgeError
    ├── InvalidInput            a caller's value is outside its contract (also a ValueError)
    ├── InvalidData             a file or archive cannot be what it claims to be
    │   ├── BitstreamError          H.264 bytes that break the syntax
    │   ├── FieldFormatError        radiance field archive, .ply
    │   └── DatasetError            posed pictures on disk
    ├── UnknownField            a field id that no store here holds
    ├── PacketRejected          a delta packet that must not be shown; carries a RejectReason
    ├── ProtocolError           the peer broke the session's rules
    ├── AccessDenied            a certificate is refused, or does not permit what was asked
    ├── LimitExceeded           a peer asks for more than it may have
    ├── BackendUnavailable      an instruction set or device this machine does not have
    ├── CodecError              encoder or decoder did not do what its configuration promises
    └── TrainingDiverged        a training run no longer converges

A message names the offending value, the limit it broke and what to do about it. Commands print
it as one line and exit with status 2; services map it to one gRPC status (``rfcore.wire``).
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Any

MOST_NAMED = 8


def named(names: Iterable[str], none: str) -> str:
    """Return the first of many names for a message, and how many more there are; or ``none``.

    >>> named((f"f{n}" for n in range(10)), "nothing")
    'f0, f1, f2, f3, f4, f5, f6, f7 and 2 more'
    """
    all_names = list(names)
    more = len(all_names) - MOST_NAMED
    first = ", ".join(all_names[:MOST_NAMED]) or none
    return f"{first} and {more} more" if more > 0 else first


class RfedgeError(Exception):
    """Base of all errors rfedge raises on purpose; it can be pickled with all its attributes."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self.args, vars(self))


def _restored(
    kind: type[RfedgeError], args: tuple[Any, ...], values: dict[str, Any]
) -> RfedgeError:
    """Return a pickled error without calling its constructor, which takes other arguments."""
    error = kind.__new__(kind, *args)
    vars(error).update(values)
    return error


class InvalidInput(RfedgeError, ValueError):
    """A caller's value is outside its contract.

    ``field`` is the dotted name of the value, as the caller knows it (``pose.rotation``).
    """

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field
        self.problem = problem


class InvalidData(RfedgeError):
    """A file or archive cannot be what it claims to be."""


class BitstreamError(InvalidData):
    """H.264 bytes break the syntax, or use a part of it that is not used here."""


class FieldFormatError(InvalidData):
    """A radiance field file is damaged, truncated or of another format."""


class DatasetError(InvalidData):
    """A dataset on disk is incomplete or inconsistent."""


class UnknownField(RfedgeError):
    """No store here holds the radiance field asked for."""


class RejectReason(StrEnum):
    """Reason why a delta packet was refused. The wire's Nack carries the same names."""

    STALE_EPOCH = "stale_epoch"
    STALE_SEQUENCE = "stale_sequence"
    SEQUENCE_GAP = "sequence_gap"
    CRC_MISMATCH = "crc_mismatch"
    RENDER_MISMATCH = "render_mismatch"
    MALFORMED_PAYLOAD = "malformed_payload"
    DECODER_FAILED = "decoder_failed"
    RECONSTRUCTION_MISMATCH = "reconstruction_mismatch"
    INVALID_ARGUMENT = "invalid_argument"
    OVERLOADED = "overloaded"
    UNKNOWN_STATE = "unknown_state"
    UNSPECIFIED = "unspecified"
    """A newer server's reason, which this vehicle does not know."""


class PacketRejected(RfedgeError):
    """A delta packet that must not become a shown frame."""

    def __init__(self, reason: RejectReason, problem: str) -> None:
        super().__init__(f"{reason}: {problem}")
        self.reason = reason
        self.problem = problem


class ProtocolError(RfedgeError):
    """The peer broke the rules of the session."""


class AccessDenied(RfedgeError):
    """A certificate is refused, or does not permit what was asked."""


class LimitExceeded(RfedgeError):
    """A peer asks for more than it may have; ``limit`` is a word that can be counted.

    ``retry_after_s`` says when it may ask again, if that is known.
    """

    def __init__(self, limit: str, problem: str, retry_after_s: float | None = None) -> None:
        super().__init__(f"{limit}: {problem}")
        self.limit = limit
        self.retry_after_s = retry_after_s


class BackendUnavailable(RfedgeError):
    """This machine lacks the instruction set or device that was asked for."""


class CodecError(RfedgeError):
    """The encoder or decoder did not do what its configuration promises."""


class TrainingDiverged(RfedgeError):
    """A training run diverged: its last parameters are worth nothing.

    ``group`` is the group of parameters that moved furthest, or that is not finite.
    """

    def __init__(self, iteration: int, group: str, problem: str) -> None:
        super().__init__(f"training diverged at iteration {iteration}, {group}: {problem}")
        self.iteration = iteration
        self.group = group
