"""Errors come out of another process as they were raised there."""

import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

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
    PacketRejected: (RejectReason.STALE_EPOCH, "3 is before 4"),
    LimitExceeded: ("streams", "65 of 64", 2.5),
    TrainingDiverged: (17, "scales", "are not finite"),
}
KINDS = [getattr(errors, name) for name in errors.__all__ if name != "RejectReason"]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_an_error_is_the_same_after_pickling(kind: type[RfedgeError]) -> None:
    raised = kind(*OWN_ARGUMENTS.get(kind, ("field: 7 is above 5",)))
    raised.add_note("while reading street.rff")
    came = pickle.loads(pickle.dumps(raised))
    assert type(came) is kind
    assert (str(came), came.args, vars(came)) == (str(raised), raised.args, vars(raised))


def test_an_error_in_another_process_is_raised_here() -> None:
    with (
        ProcessPoolExecutor(1, get_context("spawn")) as pool,
        pytest.raises(InvalidInput, match=r"^spp: 5 is not a square number$") as caught,
    ):
        pool.submit(_refuse, 5).result()
    assert caught.value.field == "spp"


def _refuse(value: int) -> None:
    raise InvalidInput("spp", f"{value} is not a square number")
