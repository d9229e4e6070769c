"""A mec-server on a virtual clock: its sessions, ledger and workers, with stated times of work.

Streams are served as ``mec_server.stream`` serves them, by the same machines: ``ServerSession``,
the stream's account at ``EntryControl``, and workers that take frames of their owners in turn. A
frame keeps a worker for ``Costs.server_s``. Everything happens at moments of one queue of events.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import count

from lab.city.city import City
from lab.city.flow import Costs
from mec_server.config import IdentityBudget, ServerBudget
from mec_server.event_loop import FairQueue
from mec_server.ledger.budgets import budgets_of
from mec_server.ledger.entry import EntryControl
from mec_server.ledger.ledger import Hold
from mec_server.session import DecodeJob, OpenJob, RenderTooLate, ServerSession
from rfcore.errors import LimitExceeded
from rfcore.link import Link, LinkProfile
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.convert_answers import server_messages_to_bytes
from rfcore.wire.messages import Frame, Hello, StageTimes

__all__ = [
    "DIGEST",
    "FIELD_ID",
    "Events",
    "Pipe",
    "ServerCounters",
    "ServerStream",
    "VirtualServer",
]

FIELD_ID = "ab" * 32
DIGEST = b"d" * 16
"""The digest of every render and picture: nothing is rendered or coded."""
OPEN_S = 0.05
"""Time from Hello to open decoders: no figure of the plan depends on it."""
QUEUE_BYTES = 1 << 50
MEMORY_BYTES = 1 << 40
"""Memory of every server: the plan says nothing of memory."""


class Events:
    """A queue of calls by their moment; ``now`` is the moment of the call that runs."""

    def __init__(self) -> None:
        self.now = 0.0
        self._numbers = count()
        self._waiting: list[tuple[float, int, Callable[[], None]]] = []

    def at(self, when_s: float, happen: Callable[[], None]) -> None:
        """Let it happen at ``when_s``, after everything that was put there before."""
        heapq.heappush(self._waiting, (max(when_s, self.now), next(self._numbers), happen))

    def after(self, delay_s: float, happen: Callable[[], None]) -> None:
        """Let it happen ``delay_s`` from now."""
        self.at(self.now + delay_s, happen)

    def run_until(self, end_s: float) -> None:
        """Let everything happen that is to happen until ``end_s``."""
        while self._waiting and self._waiting[0][0] <= end_s:
            self.now, _, happen = heapq.heappop(self._waiting)
            happen()
        self.now = end_s


class Pipe:
    """A link of ``rfcore.link`` that delivers when its time has come."""

    def __init__(self, events: Events, rate_bps: float, delay_s: float) -> None:
        self._events = events
        self._link: Link[Callable[[], None]] = Link(LinkProfile(rate_bps, delay_s, QUEUE_BYTES))
        self.sent_bytes = self.delivered_bytes = 0

    @property
    def held_bytes(self) -> int:
        """Sent and not delivered yet."""
        return self._link.held_bytes

    def send(self, size_bytes: int, arrive: Callable[[], None]) -> None:
        """Send so many bytes; ``arrive`` happens when they are there."""
        self.sent_bytes += size_bytes
        delivery = self._link.push(arrive, size_bytes, self._events.now)
        self._events.at(delivery.due_s, self._deliver)

    def _deliver(self) -> None:
        for delivery in self._link.pop_due(self._events.now):
            self.delivered_bytes += delivery.size_bytes
            delivery.item()


@dataclass
class ServerCounters:
    """Counts while ``on``; ``busy_s``: time of workers."""

    on: bool = False
    ages_s: list[float] = field(default_factory=list)
    busy_s: float = 0.0
    served: list[int] = field(default_factory=list)
    uplink_bytes: int = 0
    downlink_bytes: int = 0


class VirtualServer:
    """A mec-server's streams, ledger and workers."""

    def __init__(self, city: City, costs: Costs, cores: int, events: Events) -> None:
        self.events, self.costs = events, costs
        self.counted = ServerCounters()
        admission, identity = city.admission, IdentityBudget()
        server = ServerBudget(streams=admission.streams, decoders=100_000)
        budgets = budgets_of(identity, server, cores, MEMORY_BYTES)
        self.entry = EntryControl(budgets, admission.limits, cores, identity.share, events.now)
        self.streams: dict[str, ServerStream] = {}
        self._cores = cores
        self._queue: FairQueue[tuple[ServerStream, DecodeJob]] = FairQueue()
        self._in_work: Counter[str] = Counter()

    def submit(self, stream: ServerStream, job: DecodeJob) -> None:
        """Reconstruct a frame as soon as a worker is free and it is its vehicle's turn."""
        self._queue.put(stream.account.identity, (stream, job))
        self._work()

    def reallocate(self) -> None:
        """Tell the vehicles whose rate changes."""
        now = self.events.now
        for session_id, rate_hz in self.entry.reallocate_rates(now).items():
            stream = self.streams[session_id]
            stream.account.grant(rate_hz, now)
            stream.session.grant(rate_hz)
            stream.flush()

    def _may_begin(self, owner: str) -> bool:
        crowded = self.entry.promises.is_crowded
        return not crowded or self._in_work[owner] < max(1, self._cores - 1)

    def _work(self) -> None:
        while self._in_work.total() < self._cores:
            try:
                stream, job = self._queue.take(self._may_begin)
            except IndexError:
                return
            self._begin(stream, job)

    def _begin(self, stream: ServerStream, job: DecodeJob) -> None:
        if stream.is_over or stream.is_too_late(job):
            return
        owner = stream.account.identity
        self._in_work[owner] += 1

        def end() -> None:
            self._in_work[owner] -= 1
            if self.counted.on:
                self.counted.busy_s += self.costs.server_s
            stream.finished(job)
            self._work()

        self.events.after(self.costs.server_s, end)


class ServerStream:
    """One stream as ``mec_server.stream`` serves it; a ``mec_server.ledger.entry.CameraSender``.

    ``send`` takes bytes to the vehicle, ``ended`` is called when the server ends the stream. Raises
    ``LimitExceeded`` where there are too many.
    """

    def __init__(
        self,
        server: VirtualServer,
        name: str,
        send: Callable[[bytes], None],
        ended: Callable[[], None],
    ) -> None:
        self.agent = name
        self.is_over = False
        self._server, self._send, self._ended = server, send, ended
        self._held: Hold | None = None
        now = server.events.now
        self.account = server.entry.open(name, name, named=False, now=now)
        self.session = ServerSession(name, [FIELD_ID], now)
        server.streams[name] = self

    def silent_s(self, now: float) -> float:
        """Return for how long the vehicle has sent nothing."""
        return self.session.silent_s(now)

    def displace(self, error: LimitExceeded) -> None:
        """End the stream: another agent sends its cameras."""
        self.session.end(error)
        self.flush()

    def receive(self, data: bytes) -> None:
        """Take a message, charge it, and start what it allows."""
        if self.is_over:
            return
        now, message = self._server.events.now, client_message_from_bytes(data)
        excess = self._excess(lambda: self.account.spend_message(len(data), now))
        if isinstance(message, Frame):
            frame = message
            excess = excess or self._excess(lambda: self.account.spend_frame(frame, len(data), now))
            if excess is None:
                self.session.receive(frame, now)
            else:
                self.session.overrun(frame, excess, now)
        elif excess is not None:
            self.session.end(excess)
        else:
            self._receive_hello(message, now)
        self._advance()

    def _excess(self, spend: Callable[[], None]) -> LimitExceeded | None:
        try:
            spend()
        except LimitExceeded as error:
            return error
        return None

    def _receive_hello(self, hello: Hello, now: float) -> None:
        self.session.receive(hello, now)
        try:
            self.session.grant(self.account.enter(hello, self, now))
        except LimitExceeded as error:
            self.session.end(error)

    def _advance(self) -> None:
        for job in self.session.jobs_to_start(self._server.events.now):
            if isinstance(job, OpenJob):
                self._server.events.after(OPEN_S, partial(self._opened, job))
            else:
                self._server.submit(self, job)
        self.flush()

    def _opened(self, job: OpenJob) -> None:
        if self.is_over:
            return
        self._held = self.account.take_decoders()
        self.session.opened(job, self._server.events.now)
        self._advance()

    def is_too_late(self, job: DecodeJob) -> bool:
        """Reject a frame that would be reconstructed after its deadline; return whether it was."""
        now, deadline_s = self._server.events.now, self._server.entry.render_deadline_s
        waited_s, expected_s = now - job.received_s, self.account.expected_s()
        if waited_s + expected_s <= deadline_s:
            return False
        self.session.rejected(job, RenderTooLate(waited_s, expected_s, deadline_s), now)
        self._advance()
        return True

    def finished(self, job: DecodeJob) -> None:
        """A worker has reconstructed a frame."""
        if self.is_over:
            return
        server, now = self._server, self._server.events.now
        self.account.worked(job.field_id, server.costs.server_s, now)
        server.reallocate()
        times = StageTimes(render_ns=round(1e9 * server.costs.server_s))
        self.session.decoded(job, DIGEST, times, now)
        if server.counted.on:
            server.counted.ages_s.append(now - job.frame.capture_time_ns / 1e9)
        self._advance()

    def flush(self) -> None:
        """Send what there is to send, and end the stream if it is over."""
        for data in server_messages_to_bytes(
            self.session.messages_to_send(self._server.events.now)
        ):
            self._send(data)
        if self.session.closed is not None and not self.is_over:
            self.close()
            self._ended()

    def close(self) -> None:
        """Give back everything."""
        if self.is_over:
            return
        self.is_over = True
        self._server.streams.pop(self.agent, None)
        if self._held is not None:
            self._held.release()
        self.account.close()
