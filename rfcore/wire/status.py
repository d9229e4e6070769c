"""Which gRPC status each of our errors becomes."""

from __future__ import annotations

import grpc

from rfcore.errors import (
    AccessDenied,
    BackendUnavailable,
    CodecError,
    InvalidData,
    InvalidInput,
    LimitExceeded,
    PacketRejected,
    ProtocolError,
    RfedgeError,
    UnknownField,
)

__all__ = ["status_of"]

STATUS_OF: tuple[tuple[type[RfedgeError], grpc.StatusCode], ...] = (
    (InvalidInput, grpc.StatusCode.INVALID_ARGUMENT),
    (UnknownField, grpc.StatusCode.NOT_FOUND),
    (InvalidData, grpc.StatusCode.DATA_LOSS),
    (PacketRejected, grpc.StatusCode.ABORTED),
    (ProtocolError, grpc.StatusCode.FAILED_PRECONDITION),
    (AccessDenied, grpc.StatusCode.PERMISSION_DENIED),
    (LimitExceeded, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (BackendUnavailable, grpc.StatusCode.UNIMPLEMENTED),
    (CodecError, grpc.StatusCode.INTERNAL),
)


def status_of(error: RfedgeError) -> grpc.StatusCode:
    """Return the status that tells a peer about ``error``."""
    for kind, status in STATUS_OF:
        if isinstance(error, kind):
            return status
    return grpc.StatusCode.INTERNAL
