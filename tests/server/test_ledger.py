"""Identities hold and spend budgets, on a clock the test turns."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from mec_server.config import IdentityBudget, ServerBudget
from mec_server.ledger.budgets import (
    FEWEST_DECODERS,
    HELD,
    PIXELS_PER_DECODER,
    SPENT,
    Budget,
    Limit,
    Resource,
    budgets_of,
    decoders_that_fit,
    memory_limit_bytes,
    usable_processors,
)
from mec_server.ledger.ledger import (
    BARRED_S,
    BURST_S,
    HELD_RETRY_S,
    LONGER_BURST_S,
    LONGEST_PAUSE_S,
    MAX_LOST_DECODERS,
    Hold,
    Ledger,
    TokenBucket,
)
from rfcore.errors import InvalidInput, LimitExceeded

IDENTITIES = ("cav-1", "cav-2", "watch", "mallory")
GIB = 1 << 30
times = st.lists(st.tuples(st.floats(0, 2), st.floats(0.1, 20)), max_size=60)


def ledger_of(**changes: float) -> Ledger:
    """A ledger with budgets of 4 of each identity and 8 in all, and ``changes`` of the former."""
    budgets = {resource: Budget(4, 8) for resource in Resource}
    for name, value in changes.items():
        budgets[Resource(name)] = Budget(value, 2 * value)
    return Ledger(budgets, 0.0)


def refused_for_s(act: Callable[[], None]) -> float:
    """Return after how many seconds what was refused may be tried again; 0: it was not refused."""
    try:
        act()
    except LimitExceeded as error:
        return error.retry_after_s or math.nan
    return 0.0


# --- buckets


@given(times)
def test_a_bucket_never_lets_more_through_than_its_rate_one_burst_and_one_message(
    steps: list[tuple[float, float]],
) -> None:
    bucket, now, taken = TokenBucket(10.0, 0.0), 0.0, 0.0
    for pause_s, amount in steps:
        now += pause_s
        taken += amount if bucket.take(amount, now) else 0.0
        assert taken <= 10.0 * now + 10.0 + 20.0 + 1e-6


@given(times)
def test_a_bucket_says_when_it_lets_something_through_again(
    steps: list[tuple[float, float]],
) -> None:
    bucket, now = TokenBucket(10.0, 0.0), 0.0
    for pause_s, amount in steps:
        now += pause_s
        wait_s = bucket.wait_s(now)
        now += wait_s + 1e-6
        assert bucket.take(amount, now)
    assert bucket.wait_s(now + 1e3) == 0.0


def test_a_rate_that_is_lowered_takes_nothing_away_that_was_saved() -> None:
    bucket = TokenBucket(30.0, 0.0)
    bucket.set_rate(5.0, 0.0)
    assert [bucket.take(1, 0.0) for _ in range(31)] == [True] * 30 + [False]
    assert not bucket.is_full(0.9)
    assert bucket.is_full(1.1)


# --- the machine


class LedgerMachine(RuleBasedStateMachine):
    """Identities hold, give back, hand over and spend at random; a plain count is kept beside."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.ledger = Ledger({resource: Budget(4, 10) for resource in Resource}, self.now)
        self.holds: list[tuple[str, Resource, int, Hold]] = []
        self.spent = dict.fromkeys(SPENT, 0.0)
        self.allowed: dict[tuple[str, Resource], float] = {}

    def count(self, resource: Resource, identity: str | None = None) -> int:
        return sum(
            amount
            for owner, held, amount, _ in self.holds
            if held is resource and identity in (None, owner)
        )

    @rule(
        identity=st.sampled_from(IDENTITIES),
        resource=st.sampled_from(HELD),
        amount=st.integers(1, 5),
    )
    def hold(self, identity: str, resource: Resource, amount: int) -> None:
        fits = self.count(resource, identity) + amount <= 4 and self.count(resource) + amount <= 10
        if fits:
            hold = self.ledger.hold(identity, resource, self.now, amount)
            self.holds.append((identity, resource, amount, hold))
            return
        with pytest.raises(LimitExceeded) as caught:
            self.ledger.hold(identity, resource, self.now, amount)
        assert caught.value.limit in {f"identity_{resource}", f"server_{resource}"}
        assert caught.value.retry_after_s == HELD_RETRY_S

    @precondition(lambda self: self.holds)
    @rule(data=st.data())
    def release(self, data: st.DataObject) -> None:
        number = data.draw(st.integers(0, len(self.holds) - 1))
        _, _, _, hold = self.holds.pop(number)
        hold.release()
        hold.release()

    @precondition(lambda self: self.holds)
    @rule(data=st.data(), identity=st.sampled_from(IDENTITIES))
    def transfer(self, data: st.DataObject, identity: str) -> None:
        number = data.draw(st.integers(0, len(self.holds) - 1))
        owner, resource, amount, hold = self.holds[number]
        fits = owner == identity or self.count(resource, identity) + amount <= 4
        try:
            hold.transfer(identity, self.now)
        except LimitExceeded:
            assert not fits
        else:
            assert fits
            self.holds[number] = (identity, resource, amount, hold)

    @rule(
        identity=st.sampled_from(IDENTITIES),
        resource=st.sampled_from(SPENT),
        amount=st.floats(0.1, 3.0),
    )
    def spend(self, identity: str, resource: Resource, amount: float) -> None:
        wait_s = refused_for_s(lambda: self.ledger.spend(identity, resource, amount, self.now))
        if wait_s:
            return
        self.spent[resource] += amount
        key = (identity, resource)
        self.allowed[key] = self.allowed.get(key, 0.0) + amount

    @rule(pause_s=st.floats(0.0, 3.0))
    def wait(self, pause_s: float) -> None:
        self.now += pause_s

    @invariant()
    def totals_are_the_sums_of_the_identities_and_within_budget(self) -> None:
        for resource in HELD:
            own = [self.ledger.held(resource, identity) for identity in IDENTITIES]
            assert own == [self.count(resource, identity) for identity in IDENTITIES]
            assert self.ledger.held(resource) == sum(own) <= 10
            assert self.ledger.most_held(resource) == max(own) <= 4

    @invariant()
    def nobody_spends_more_than_a_rate_a_burst_and_one_amount(self) -> None:
        for (_, resource), amount in self.allowed.items():
            burst_s = LONGER_BURST_S.get(resource, BURST_S)
            assert amount <= 4 * self.now + 4 * burst_s + 3 + 1e-6
        for resource in SPENT:
            assert self.ledger.spent(resource) == pytest.approx(self.spent[resource])
            burst_s = LONGER_BURST_S.get(resource, BURST_S)
            assert self.spent[resource] <= 10 * self.now + 10 * burst_s + 3 + 1e-6

    @invariant()
    def whoever_holds_nothing_can_hold_something_beside_any_two_others(self) -> None:
        """10 in all and 4 each: no two identities together keep a third one out."""
        for resource in HELD:
            own = {identity: self.count(resource, identity) for identity in IDENTITIES}
            idle = [identity for identity, count in own.items() if count == 0]
            if len(idle) >= 2:
                self.ledger.hold(idle[0], resource, self.now).release()

    def teardown(self) -> None:
        for _, _, _, hold in self.holds:
            hold.release()
        assert all(self.ledger.held(resource) == 0 for resource in HELD)
        self.now += 1e6
        self.ledger.check("somebody", Resource.CALLS, self.now)
        assert self.ledger.identities == 1, "names cost no memory"


TestLedgerMachine = LedgerMachine.TestCase
TestLedgerMachine.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


# --- what is refused, and how


def test_what_is_held_too_much_is_named_with_its_numbers() -> None:
    ledger = ledger_of()
    ledger.hold("cav-1", Resource.DECODERS, 0.0, 3)
    with pytest.raises(
        LimitExceeded,
        match=r"^identity_decoders: this identity has 3 decoders, asked for 2 more, 4 may be; ",
    ):
        ledger.hold("cav-1", Resource.DECODERS, 0.0, 2)
    ledger.hold("cav-2", Resource.DECODERS, 0.0, 4)
    with pytest.raises(LimitExceeded, match=r"^server_decoders: all together have 7 decoders, "):
        ledger.hold("cav-3", Resource.DECODERS, 0.0, 2)


@pytest.mark.parametrize("resource", SPENT)
def test_who_spends_too_much_is_told_when_to_come_again_and_others_are_not_refused(
    resource: Resource,
) -> None:
    ledger = ledger_of()
    burst_s = LONGER_BURST_S.get(resource, BURST_S)
    ledger.charge("cav-1", resource, 4.0 * burst_s + 2.0, 0.0)
    with pytest.raises(LimitExceeded) as caught:
        ledger.spend("cav-1", resource, 0.1, 0.0)
    assert caught.value.limit == Limit(f"identity_{resource}")
    assert caught.value.retry_after_s == pytest.approx(0.5)
    ledger.spend("cav-2", resource, 0.1, 0.51)
    ledger.spend("cav-1", resource, 0.1, 0.51)


def test_a_long_render_is_paid_for_by_who_asked_for_it_alone() -> None:
    budgets = budgets_of(IdentityBudget(), ServerBudget(), workers=2, memory_bytes=8 * GIB)
    ledger = Ledger(budgets, 0.0)
    ledger.charge("mallory", Resource.WORKER_SECONDS, 11.0, 0.0)
    wait_s = 11.0 - LONGER_BURST_S[Resource.WORKER_SECONDS]
    with pytest.raises(LimitExceeded, match="identity_worker_seconds: more than 1 worker seconds"):
        ledger.check("mallory", Resource.WORKER_SECONDS, wait_s - 0.01)
    ledger.check("mallory", Resource.WORKER_SECONDS, wait_s + 0.01)
    for identity in ("cav-1", "cav-2"):
        ledger.check(identity, Resource.WORKER_SECONDS, 0.0)


def test_lost_decoders_within_a_minute_keep_an_identity_out_for_as_long() -> None:
    ledger = ledger_of()
    for i in range(MAX_LOST_DECODERS - 1):
        ledger.lost_decoder("cav-1", float(i))
    with pytest.raises(LimitExceeded, match="lost_decoders: ") as caught:
        ledger.lost_decoder("cav-1", 10.0)
    assert caught.value.retry_after_s == BARRED_S - 10.0
    with pytest.raises(LimitExceeded):
        ledger.check_decoders("cav-1", BARRED_S - 0.1)
    ledger.check_decoders("cav-1", BARRED_S)
    ledger.check_decoders("cav-2", 10.0)


def test_lost_decoders_far_apart_are_accidents() -> None:
    ledger = ledger_of()
    for i in range(10):
        ledger.lost_decoder("cav-1", i * BARRED_S / (MAX_LOST_DECODERS - 1))


def test_openings_that_come_to_nothing_in_a_row_are_waited_for_longer_and_longer() -> None:
    ledger, now, pauses = ledger_of(), 0.0, []
    for _ in range(12):
        ledger.opening_failed("cav-1", now)
        pauses.append(refused_for_s(lambda at_s=now: ledger.check_opening("cav-1", at_s)))
        now += pauses[-1]
        ledger.check_opening("cav-1", now)
    assert pauses[:5] == [0.0, 0.0, 0.5, 1.0, 2.0]
    assert pauses[-1] == LONGEST_PAUSE_S
    ledger.check_opening("cav-2", now)
    ledger.opening_paid("cav-1", now)
    ledger.opening_failed("cav-1", now)
    ledger.check_opening("cav-1", now)


def test_an_opening_that_came_to_nothing_is_remembered_over_a_pause() -> None:
    ledger = ledger_of()
    ledger.opening_failed("cav-1", 0.0)
    for second in range(round(LONGEST_PAUSE_S)):
        ledger.charge(f"other-{second}", Resource.CALLS, 1.0, float(second))
        assert ledger.is_doubtful("cav-1", float(second))
    ledger.charge("another", Resource.CALLS, 1.0, LONGEST_PAUSE_S + 1.0)
    assert not ledger.is_doubtful("cav-1", LONGEST_PAUSE_S + 1.0)


# --- budgets


@given(
    st.floats(0.01, 1.0),
    st.integers(1, 300),
    st.integers(1, 300),
    st.integers(1, 64),
)
def test_no_identity_has_more_than_its_share_of_the_total_and_each_can_have_one(
    share: float, own: int, total: int, workers: int
) -> None:
    identity = IdentityBudget(share=share, streams=own, fetches=own, messages_per_s=own)
    server = ServerBudget(streams=total, fetches=total, messages_per_s=total)
    budgets = budgets_of(identity, server, workers, GIB)
    for resource in (Resource.STREAMS, Resource.FETCHES):
        assert budgets[resource].identity == min(own, max(1, math.floor(share * total)))
    assert budgets[Resource.MESSAGES].identity == min(own, share * total)
    assert budgets[Resource.WORKER_SECONDS].identity == share * workers


def test_decoders_fit_into_the_memory_there_is() -> None:
    assert decoders_that_fit(GIB) == 13
    assert decoders_that_fit(0) == FEWEST_DECODERS
    assert decoders_that_fit(64 * GIB) == 256
    budgets = budgets_of(IdentityBudget(), ServerBudget(decoders=5), 2, GIB)
    assert budgets[Resource.DECODERS] == Budget(2, 5)
    assert PIXELS_PER_DECODER == 1920 * 1088


@pytest.mark.parametrize(
    ("own", "folder", "name"),
    [
        ("0::/rsu.slice/mec.service", "rsu.slice/mec.service", "memory.max"),
        ("0::/rsu.slice/mec.service", "rsu.slice", "memory.max"),
        ("0::/", "", "memory.max"),
        ("4:memory:/mec\n1:cpu:/\n0::/", "memory/mec", "memory.limit_in_bytes"),
        ("4:memory:/docker/ab\n0::/", "memory", "memory.limit_in_bytes"),
    ],
)
def test_memory_is_limited_by_every_control_group_around_the_server(
    own: str, folder: str, name: str, tmp_path: Path
) -> None:
    of_all = memory_limit_bytes(tmp_path, tmp_path / "none")
    (tmp_path / "own").write_text(own + "\n")
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / folder / name).write_text(f"{GIB // 4}\n")
    assert memory_limit_bytes(tmp_path, tmp_path / "own") == GIB // 4
    (tmp_path / folder / name).write_text("max\n")
    assert memory_limit_bytes(tmp_path, tmp_path / "own") == of_all


@pytest.mark.parametrize(
    ("own", "folder", "limits", "processors"),
    [
        ("0::/rsu.slice/mec.service", "rsu.slice", {"cpu.max": "100000 100000"}, 1),
        ("0::/", "", {"cpu.max": "50000 100000"}, 1),
        ("0::/", "", {"cpu.max": "140000 100000"}, 2),
        ("0::/", "", {"cpu.max": "max 100000"}, 3),
        ("0::/", "", {"cpu.max": "900000 100000"}, 3),
        (
            "4:cpu,cpuacct:/mec\n0::/",
            "cpu/mec",
            {"cpu.cfs_quota_us": "150000", "cpu.cfs_period_us": "100000"},
            2,
        ),
        (
            "4:cpu,cpuacct:/mec\n0::/",
            "cpu",
            {"cpu.cfs_quota_us": "-1", "cpu.cfs_period_us": "100000"},
            3,
        ),
    ],
)
def test_processors_are_those_that_a_control_group_grants(
    own: str,
    folder: str,
    limits: dict[str, str],
    processors: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 5})
    assert usable_processors(tmp_path, tmp_path / "none") == 3
    (tmp_path / "own").write_text(own + "\n")
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    for name, value in limits.items():
        (tmp_path / folder / name).write_text(value + "\n")
    assert usable_processors(tmp_path, tmp_path / "own") == processors


@pytest.mark.parametrize("change", [{"streams": 0}, {"messages_per_s": 0.0}, {"share": 0.0}])
def test_a_budget_that_lets_nobody_in_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(InvalidInput, match=r"^identity.(streams|messages_per_s|share): "):
        IdentityBudget(**change)  # type: ignore[arg-type]
