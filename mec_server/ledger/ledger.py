"""The ledger: what each identity holds and has spent; the only place that refuses more.

Sans-IO: ``now`` is an argument. An identity is named by a certificate; without certificates it is a
vehicle's name or a connection, and budgets guard against mistakes, not against lies. A refusal
changes nothing, and its error names the limit and when to try again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from mec_server.ledger.budgets import HELD, SPENT, Budget, Limit, Resource
from rfcore.errors import LimitExceeded

MAX_LOST_DECODERS = 3
BARRED_S = 60.0
"""An identity whose packets crash this many decoder processes within this time is refused for as
long."""

FREE_FAILURES = 2
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
"""Openings in a row that come to nothing, without a picture in between: two are answered at once,
for one may be a mistake; after each further one the identity waits, twice as long each time."""

HELD_RETRY_S = 1.0
"""Delay before trying again for a resource that others hold: when they return it is unknown."""

BURST_S = 1.0
LONGER_BURST_S = {Resource.WORKER_SECONDS: 5.0, Resource.REJECTED_SECONDS: 2.0}
"""A bucket holds what its rate gives in this time; of worker time it is more, since a frame that
meets a busy machine, or replaces its decoder, takes seconds, and since the frames in flight are
rejected together."""


class TokenBucket:
    """Lets ``rate`` per second through, in bursts of up to ``burst`` (a second's worth).

    Whoever finds anything left may take more than that, and is refused until the debt is refilled:
    a message's size, or a frame's time, is known only when it has been received or spent.
    """

    def __init__(self, rate: float, now: float, burst: float | None = None) -> None:
        self._rate = rate
        self._burst = rate * BURST_S if burst is None else burst
        self._left = self._burst
        self._filled_s = now

    def set_rate(self, rate: float, now: float, burst: float | None = None) -> None:
        """Refill at ``rate`` from now on; keep the present level, even above the new burst."""
        self._fill(now)
        self._rate = rate
        self._burst = rate * BURST_S if burst is None else burst

    def is_full(self, now: float) -> bool:
        """Return whether nothing was taken lately."""
        self._fill(now)
        return self._left >= self._burst

    def wait_s(self, now: float) -> float:
        """Return in how many seconds something will be left; 0 if something is."""
        self._fill(now)
        return 0.0 if self._left > 0 else max(1e-3, -self._left / self._rate)

    def charge(self, amount: float, now: float, *, lent: bool = False) -> None:
        """Take ``amount``, whatever is left; if it is ``lent``, no more than is left."""
        self._fill(now)
        self._left -= min(amount, max(0.0, self._left)) if lent else amount

    def take(self, amount: float, now: float) -> bool:
        """Return whether anything is left; if so take ``amount``, even if that is more."""
        self._fill(now)
        if self._left <= 0:
            return False
        self._left -= amount
        return True

    def _fill(self, now: float) -> None:
        elapsed_s = now - self._filled_s
        if elapsed_s <= 0:
            return
        self._filled_s = now
        if self._left < self._burst:
            self._left = min(self._burst, self._left + elapsed_s * self._rate)


@dataclass
class Account:
    """The resources that one identity holds and has spent, and its recent failures."""

    spent: dict[Resource, TokenBucket]
    held: dict[Resource, int] = field(default_factory=lambda: dict.fromkeys(HELD, 0))
    lost_decoders_s: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_LOST_DECODERS))
    failed_openings: int = 0
    opens_again_s: float = float("-inf")

    def barred_until_s(self) -> float:
        """Return the time until which it is barred because its packets cost too many decoders."""
        lost = self.lost_decoders_s
        return lost[0] + BARRED_S if len(lost) == MAX_LOST_DECODERS else float("-inf")

    def is_idle(self, now: float) -> bool:
        """Return whether forgetting it would change nothing."""
        return (
            not any(self.held.values())
            and now >= max(self.barred_until_s(), self.opens_again_s + LONGEST_PAUSE_S)
            and all(bucket.is_full(now) for bucket in self.spent.values())
        )


class Hold:
    """An amount of a resource that an identity holds; ``release`` gives it back, once."""

    def __init__(self, ledger: Ledger, identity: str, resource: Resource, amount: int) -> None:
        self._ledger: Ledger | None = ledger
        self._identity = identity
        self._resource = resource
        self._amount = amount

    def __enter__(self) -> Hold:
        return self

    def __exit__(self, *raised: object) -> None:
        self.release()

    def release(self) -> None:
        """Give it back; does nothing the second time."""
        ledger, self._ledger = self._ledger, None
        if ledger is not None:
            ledger._release(self._identity, self._resource, self._amount)

    def transfer(self, identity: str, now: float) -> None:
        """Let ``identity`` hold it instead; raise ``LimitExceeded`` and leave it where it was."""
        ledger = self._ledger
        if ledger is None or identity == self._identity:
            return
        ledger._release(self._identity, self._resource, self._amount)
        try:
            ledger._take(identity, self._resource, self._amount, now)
        except LimitExceeded:
            ledger._take(self._identity, self._resource, self._amount, now)
            raise
        self._identity = identity


class Ledger:
    """Charges identities for what they use, within ``budgets``."""

    def __init__(self, budgets: Mapping[Resource, Budget], now: float) -> None:
        self._budgets = dict(budgets)
        self._accounts: dict[str, Account] = {}
        self._held = dict.fromkeys(HELD, 0)
        totals = {name: budgets[name].total for name in SPENT}
        self._buckets = _full_buckets(totals, now)
        self._rates = {name: budgets[name].identity for name in SPENT}
        self._spent = dict.fromkeys(SPENT, 0.0)
        self._swept_s = now

    def budget(self, resource: Resource) -> Budget:
        """Return what an identity may use of ``resource``, and all of them."""
        return self._budgets[resource]

    def held(self, resource: Resource, identity: str | None = None) -> int:
        """Return how much of a resource is held, by all identities or by one."""
        if identity is None:
            return self._held[resource]
        account = self._accounts.get(identity)
        return account.held[resource] if account is not None else 0

    def most_held(self, resource: Resource) -> int:
        """Return the largest amount that one identity holds."""
        return max(
            (account.held[resource] for account in tuple(self._accounts.values())), default=0
        )

    def spent(self, resource: Resource) -> float:
        """Return how much was spent in all."""
        return self._spent[resource]

    @property
    def identities(self) -> int:
        """The number of identities that have an account."""
        return len(self._accounts)

    # --- what is held

    def hold(self, identity: str, resource: Resource, now: float, amount: int = 1) -> Hold:
        """Let ``identity`` hold ``amount`` of a resource; raise ``LimitExceeded``."""
        self._take(identity, resource, amount, now)
        return Hold(self, identity, resource, amount)

    def _take(self, identity: str, resource: Resource, amount: int, now: float) -> None:
        account, budget = self._account(identity, now), self._budgets[resource]
        own = account.held[resource]
        if own + amount > budget.identity:
            raise _too_much_held("identity", resource, own, amount, budget.identity)
        if self._held[resource] + amount > budget.total:
            raise _too_much_held("server", resource, self._held[resource], amount, budget.total)
        account.held[resource] += amount
        self._held[resource] += amount

    def _release(self, identity: str, resource: Resource, amount: int) -> None:
        self._accounts[identity].held[resource] -= amount
        self._held[resource] -= amount

    # --- what is spent

    def spend(self, identity: str, resource: Resource, amount: float, now: float) -> None:
        """Charge ``identity`` with ``amount``; raise ``LimitExceeded`` while it is in debt."""
        self.check(identity, resource, now)
        self.charge(identity, resource, amount, now)

    def check(self, identity: str, resource: Resource, now: float) -> None:
        """Raise ``LimitExceeded`` while ``identity``, or all of them together, spent too much."""
        own = self._account(identity, now).spent[resource]
        budget = self._budgets[resource]
        if (wait_s := own.wait_s(now)) > 0:
            raise _too_much_spent("identity", resource, budget.identity, wait_s)
        if (wait_s := self._buckets[resource].wait_s(now)) > 0:
            raise _too_much_spent("server", resource, budget.total, wait_s)

    def charge(
        self, identity: str, resource: Resource, amount: float, now: float, *, lent: bool = False
    ) -> None:
        """Charge ``identity`` for use that has happened. ``lent``: nobody else wanted it, so it
        leaves no debt to be paid when somebody does."""
        self._account(identity, now).spent[resource].charge(amount, now, lent=lent)
        self._buckets[resource].charge(amount, now)
        self._spent[resource] += amount

    def refill(self, identity: str, resource: Resource, rate: float, now: float) -> None:
        """Refill at ``rate`` what ``identity`` spends, from now on, instead of its budget."""
        account = self._accounts.get(identity)
        if account is not None:
            account.spent[resource].set_rate(rate, now, rate * _burst_s(resource))

    # --- what went wrong

    def is_doubtful(self, identity: str, now: float) -> bool:
        """Return whether work for ``identity`` came to nothing lately: its last opening, or frames
        that were themselves to blame for being rejected."""
        account = self._accounts.get(identity)
        if account is None:
            return False
        rejected = account.spent[Resource.REJECTED_SECONDS]
        return account.failed_openings > 0 or not rejected.is_full(now)

    def check_decoders(self, identity: str, now: float) -> None:
        """Raise ``LimitExceeded`` if packets of ``identity`` cost too many decoders lately."""
        account = self._accounts.get(identity)
        if account is not None and now < (until_s := account.barred_until_s()):
            raise LimitExceeded(
                Limit.LOST_DECODERS,
                f"packets of this vehicle cost {MAX_LOST_DECODERS} decoders within {BARRED_S:g} s; "
                f"it is let in again {BARRED_S:g} s after the first",
                until_s - now,
            )

    def lost_decoder(self, identity: str, now: float) -> None:
        """Count a decoder that a packet cost; raise ``LimitExceeded`` if that bars the identity."""
        self._account(identity, now).lost_decoders_s.append(now)
        self.check_decoders(identity, now)

    def check_opening(self, identity: str, now: float) -> None:
        """Raise ``LimitExceeded`` while ``identity`` is to wait after openings that failed."""
        account = self._accounts.get(identity)
        if account is not None and now < account.opens_again_s:
            wait_s = account.opens_again_s - now
            raise LimitExceeded(
                Limit.FAILED_OPENINGS,
                f"{account.failed_openings} openings of this vehicle came to nothing one after "
                f"another; come again in {wait_s:.3g} s",
                wait_s,
            )

    def opening_failed(self, identity: str, now: float) -> None:
        """Count an opening that came to nothing; a row of them makes the identity wait."""
        account = self._account(identity, now)
        account.failed_openings += 1
        doublings = account.failed_openings - FREE_FAILURES - 1
        pause_s = 0.0 if doublings < 0 else FIRST_PAUSE_S * 2 ** min(doublings, 16)
        account.opens_again_s = now + min(pause_s, LONGEST_PAUSE_S)

    def opening_paid(self, identity: str, now: float) -> None:
        """Note that a stream gave a picture: the openings before it were worth their cost."""
        self._account(identity, now).failed_openings = 0

    # --- accounts

    def _account(self, identity: str, now: float) -> Account:
        account = self._accounts.get(identity)
        if account is None:
            self._forget_idle(now)
            account = self._accounts[identity] = Account(_full_buckets(self._rates, now))
        return account

    def _forget_idle(self, now: float) -> None:
        """Drop the accounts of those who hold nothing, once a second: names cost no memory."""
        if now < self._swept_s + 1.0:
            return
        self._swept_s = now
        for name in [name for name, kept in self._accounts.items() if kept.is_idle(now)]:
            del self._accounts[name]


def _too_much_held(
    scope: str, resource: Resource, held: int, amount: int, most: float
) -> LimitExceeded:
    whose = "this identity has" if scope == "identity" else "all together have"
    return LimitExceeded(
        Limit(f"{scope}_{resource}"),
        f"{whose} {held} {resource}, asked for {amount} more, {most:g} may be; give some back, "
        f"or come again in {HELD_RETRY_S:g} s",
        HELD_RETRY_S,
    )


def _too_much_spent(scope: str, resource: Resource, rate: float, wait_s: float) -> LimitExceeded:
    return LimitExceeded(
        Limit(f"{scope}_{resource}"),
        f"more than {rate:g} {_words(resource)} a second; come again in {wait_s:.3g} s",
        wait_s,
    )


def _full_buckets(rates: Mapping[Resource, float], now: float) -> dict[Resource, TokenBucket]:
    return {name: TokenBucket(rate, now, rate * _burst_s(name)) for name, rate in rates.items()}


def _burst_s(resource: Resource) -> float:
    return LONGER_BURST_S.get(resource, BURST_S)


def _words(resource: Resource) -> str:
    return resource.replace("_", " ")
