"""Errors come out of another process as they were raised there."""

import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from every_error import every_error
from rfcore.errors import InvalidInput


@pytest.mark.parametrize("raised", every_error(), ids=lambda error: type(error).__name__)
def test_an_error_is_the_same_after_pickling(raised):
    raised.add_note("while reading street.rff")
    came = pickle.loads(pickle.dumps(raised))
    assert type(came) is type(raised)
    assert (str(came), came.args, vars(came)) == (str(raised), raised.args, vars(raised))


def test_an_error_in_another_process_is_raised_here():
    with (
        ProcessPoolExecutor(1, get_context("spawn")) as pool,
        pytest.raises(InvalidInput, match=r"^spp: 5 is not a square number$") as caught,
    ):
        pool.submit(_refuse, 5).result()
    assert caught.value.field == "spp"


def _refuse(value: int) -> None:
    raise InvalidInput("spp", f"{value} is not a square number")
