"""A reason to wait is printed soon, and then ever more rarely."""

import threading

import pytest

from rfcore.wire.waits import FIRST_S, LONGEST_S, WaitLog, waiting


def test_a_wait_is_told_of_at_doubling_intervals_and_another_begins_anew() -> None:
    told: list[tuple[str, float]] = []
    log = WaitLog(lambda what, since_s: told.append((what, since_s)))
    for second in range(200):
        log.note("an answer", float(second))
    assert [since_s for _, since_s in told] == [2, 6, 14, 30, 62, 122, 182]
    assert told[-1][1] - told[-2][1] == LONGEST_S
    told.clear()
    for second, what in ((200, "credit"), (201, ""), (203, "credit"), (205, "credit")):
        log.note(what, float(second))
    assert told == [("credit", FIRST_S)]


def test_a_block_that_waits_is_told_of_while_it_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rfcore.wire.waits.FIRST_S", 0.02)
    told: list[str] = []
    enough = threading.Event()

    def say(what: str, _: float) -> None:
        told.append(what)
        enough.set()

    with waiting("the first", say) as wait_for:
        assert enough.wait(10)
        enough.clear()
        wait_for("the second")
        assert enough.wait(10)
    assert set(told) == {"the first", "the second"}
