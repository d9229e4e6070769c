"""One error of each kind that rfedge raises on purpose."""

from rfcore import errors
from rfcore.errors import (
    InvalidInput,
    LimitExceeded,
    PacketRejected,
    RejectReason,
    RfedgeError,
    TrainingDiverged,
)

OWN_ARGUMENTS = {
    InvalidInput: ("pose.rotation", "is no rotation"),
    PacketRejected: (RejectReason.CRC_MISMATCH, "of 37 bytes"),
    LimitExceeded: ("streams", "65 of 64", 2.5),
    TrainingDiverged: (7, "means", "are not finite"),
}


def every_error() -> list[RfedgeError]:
    """Return an error of each kind of ``rfcore.errors``, made as it is raised."""
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    kinds = [kind for kind in kinds if issubclass(kind, RfedgeError)]
    return [kind(*OWN_ARGUMENTS.get(kind, ("problem",))) for kind in kinds]
