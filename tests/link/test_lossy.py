"""TCP over packets that are lost: when bytes arrive, by algebra, and how many, by formula."""

import heapq
import itertools
import math
from collections.abc import Callable, Iterable
from functools import partial
from random import Random
from typing import Any

import pytest

from rfcore.errors import InvalidInput
from rfcore.link.lossy import HEADER_BYTES, LossyLink, PacketLoss
from rfcore.link.plan import Arrival, LinkPlan, delivery_times
from rfcore.link.shaper import Connection, Link, LinkProfile
from rfcore.link.tcp import MSS_BYTES, AckPacket, Receiver, Sender

DELAY_S, RATE_BPS = 0.02, 12e6
RTT_S, PACKET_S = 2 * DELAY_S, 8 * (MSS_BYTES + HEADER_BYTES) / RATE_BPS
PROFILE = LinkProfile(RATE_BPS, DELAY_S)


def lost_of(numbers: Iterable[int]) -> Callable[[], bool]:
    """Lose the packets of these numbers, from 0 on."""
    lost, count = set(numbers), itertools.count()
    return lambda: next(count) in lost


def link_losing(*numbers: int) -> LossyLink[Any]:
    return LossyLink(Link(PROFILE), lost_of(numbers), DELAY_S, lost_of(()))


def random_link(percent: float, rate_bps: float, seed: int, burst: float = 1.0) -> LossyLink[Any]:
    loss = PacketLoss(percent, burst)
    up, down = (loss.losses(Random(f"{seed}/{way}")) for way in ("up", "down"))
    return LossyLink(Link(LinkProfile(rate_bps, DELAY_S)), up, DELAY_S, down)


def arrivals(link: LossyLink[Any]) -> dict[Any, float]:
    """Run a link until it is empty; return when each item arrived, in order."""
    times: dict[Any, float] = {}
    while (at_s := link.next_event_at()) is not None:
        for delivery in link.pop_due(at_s):
            times |= dict.fromkeys(delivery.item, delivery.due_s)
    return times


def sent(link: LossyLink[Any], packets: int) -> float:
    """Return when a message of so many full packets, sent at 0 s, is there."""
    link.push("message", packets * MSS_BYTES, 0.0)
    return arrivals(link)["message"]


def test_without_loss_a_message_takes_rate_and_delay() -> None:
    assert sent(link_losing(), 4) == pytest.approx(4 * PACKET_S + DELAY_S)


def test_a_lost_packet_alone_waits_for_the_timeout() -> None:
    """RTO = srtt + max(200 ms, 4 rttvar), and the handshake measured one round trip."""
    assert sent(link_losing(0), 1) == pytest.approx(RTT_S + 0.2 + PACKET_S + DELAY_S)


def test_each_further_timeout_takes_twice_as_long() -> None:
    rto_s = RTT_S + 0.2
    assert sent(link_losing(0, 1), 1) == pytest.approx(3 * rto_s + PACKET_S + DELAY_S)


def test_a_lost_tail_is_found_by_a_probe_after_two_round_trips() -> None:
    assert sent(link_losing(2), 3) == pytest.approx(
        # packets 0 and 1 are acknowledged after a round trip, which sets the probe's timer anew
        RTT_S + 2 * PACKET_S + RTT_S + 0.2 + PACKET_S + DELAY_S,
        rel=0.05,
    )
    assert sent(link_losing(2, 3), 4) == pytest.approx(2 * (2 * RTT_S) + 2 * DELAY_S, rel=0.3)


def test_a_lost_packet_with_three_behind_it_is_sent_again_after_one_round_trip() -> None:
    """Found by the third selective acknowledgement: 3 packets and a round trip after the first."""
    again_s = 4 * PACKET_S + RTT_S
    assert sent(link_losing(0), 6) == pytest.approx(again_s + PACKET_S + DELAY_S, rel=0.05)


def test_what_lies_behind_a_lost_packet_waits_and_another_connection_does_not() -> None:
    link, first, second = link_losing(0), Connection(), Connection()
    link.push("lost", MSS_BYTES, 0.0, first)
    link.push("behind", MSS_BYTES, 0.0, first)
    link.push("beside", MSS_BYTES, 0.0, second)
    times = arrivals(link)
    assert times["lost"] == times["behind"] > RTT_S + DELAY_S
    assert times["beside"] == pytest.approx(3 * PACKET_S + DELAY_S)


@pytest.mark.parametrize("percent", [1.0, 5.0, 30.0])
@pytest.mark.parametrize("burst", [1.0, 4.0])
def test_every_byte_arrives_once_and_in_order(percent: float, burst: float) -> None:
    link, random = random_link(percent, 2e6, 3, burst), Random(7)
    order = []
    for number in range(200):
        at_s = 0.05 * number
        while (due_s := link.next_event_at()) is not None and due_s <= at_s:
            order += [item for delivery in link.pop_due(due_s) for item in delivery.item]
        link.push(number, random.randrange(5000), at_s)
    order += arrivals(link)
    assert order == list(range(200))
    assert link.held_bytes == 0
    assert link.room_bytes(1e9) == link.profile.queue_limit_bytes


def arrives_over_delays_that_vary(seed: int) -> bool:
    """Write messages to a sender whose packets and acknowledgements are lost, or late by up to half
    a second; return whether all bytes arrived. Asserts that a sender that waits has a timer."""
    random, sender, receiver = Random(seed), Sender(RTT_S), Receiver()
    events: list[tuple[float, int, Callable[[float], None]]] = []
    numbers = itertools.count()

    def at(at_s: float, happen: Callable[[float], None]) -> None:
        heapq.heappush(events, (at_s, next(numbers), happen))

    def passes(now: float, share: float, happen: Callable[[float], None]) -> None:
        if random.random() >= share:
            at(now + DELAY_S + random.choice((0, 0, 0, 0, 0.5)) * random.random(), happen)

    def send(packets: Iterable[tuple[int, int]], now: float) -> None:
        for start, end in packets:
            passes(now, 0.15, partial(arrive, start, end))
        assert sender.timer_s is not None or receiver.upto == sender.sent_upto

    def arrive(start: int, end: int, now: float) -> None:
        ack = receiver.received(start, end, now) or receiver.acknowledgement()
        passes(now, 0.1, partial(take, ack))

    def take(ack: AckPacket, now: float) -> None:
        sender.acked(ack, now)
        send(sender.packets(now), now)

    def write(now: float) -> None:
        sender.written(random.choice((60, 300, 4000)), now)
        send(sender.packets(now), now)

    for number in range(200):
        at(0.1 * number, write)
    now = 0.0
    while now < 3600 and (events or sender.timer_s is not None):
        if sender.timer_s is not None and (not events or sender.timer_s <= events[0][0]):
            now = max(now, sender.timer_s)
            send(sender.expired(now), now)
        else:
            now, _, happen = heapq.heappop(events)
            happen(now)
    return receiver.upto == sender.written_upto


@pytest.mark.parametrize("seed", range(30))
def test_a_sender_that_waits_has_a_timer_and_everything_arrives(seed: int) -> None:
    assert arrives_over_delays_that_vary(seed)


@pytest.mark.parametrize("percent", [0.5, 1.0, 2.0])
def test_bulk_throughput_follows_the_square_root_law(percent: float) -> None:
    """Mathis et al. 1997: MSS / RTT sqrt(3 / 2p) for AIMD; CUBIC's friendly region is of that rate,
    its cubic one may be above, timeouts (few at these losses) are below."""
    link, got, at_s, length_s = random_link(percent, 100e6, 5), 0, 0.0, 60.0
    while at_s < length_s:
        while not link.is_full(at_s):
            link.push(4096, 4096, at_s)
        at_s = link.next_event_at() or 0.0
        got += sum(sum(delivery.item) for delivery in link.pop_due(at_s))
    law_bps = 8 * MSS_BYTES / RTT_S * math.sqrt(1.5 / (percent / 100))
    assert 0.7 < 8 * got / length_s / law_bps < 1.4


@pytest.mark.parametrize("burst", [1.0, 3.0])
def test_losses_have_their_share_and_come_in_bursts_of_their_length(burst: float) -> None:
    is_lost = PacketLoss(5.0, burst).losses(Random(1))
    runs = [
        (key, len(list(run))) for key, run in itertools.groupby(is_lost() for _ in range(200_000))
    ]
    lengths = [length for lost, length in runs if lost]
    assert sum(lengths) / 200_000 == pytest.approx(0.05, rel=0.05)
    expected = burst if burst > 1 else 1 / 0.95
    assert sum(lengths) / len(lengths) == pytest.approx(expected, rel=0.05)


def test_a_profile_names_its_loss(read: Callable[..., LinkPlan]) -> None:
    plan = read("rate_mbps = 2\nloss_percent = 5\nloss_burst = 3", "rate_mbps = 4")
    assert plan.uplink.loss == PacketLoss(5.0, 3.0)
    assert plan.downlink.loss is None
    assert plan.is_lossy
    assert "5 % of packets lost in bursts of 3" in plan.described()
    with pytest.raises(InvalidInput, match=r"uplink\.loss_percent: is 60, outside 0\.\.50"):
        read("rate_mbps = 2\nloss_percent = 60")
    with pytest.raises(InvalidInput, match="lossy_link"):
        delivery_times(plan.uplink, [Arrival(0.0, 1)])
