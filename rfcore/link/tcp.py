"""One direction of one TCP connection, as Linux sends it: what loses packets makes it slow.

A state machine without a clock or packets: ``Sender`` says which bytes to send, ``Receiver`` which
bytes the application gets and what is acknowledged. Modelled is what decides throughput and delay
on a link that loses packets:

* CUBIC with its TCP-friendly region (RFC 9438; constants and rounding of Linux's tcp_cubic.c)
* selective acknowledgements, loss detection by time and tail loss probes (RACK-TLP, RFC 8985)
* proportional rate reduction (RFC 6937) while losses are repaired
* retransmission timeouts of at least 200 ms, doubled each time (RFC 6298 as in Linux)
* restart of the window after an idle time; delayed acknowledgements (40 ms)

Not modelled: HyStart, pacing, ECN, limits of the receive window, undoing of a spurious reduction.
``rfcore.link.lossy`` puts packets on a link; ``rfedge-lab tcp`` compares with the kernel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto

MSS_BYTES = 1448
"""Payload of a full packet: 1500 bytes less headers of IPv4 and TCP with timestamps."""
INITIAL_WINDOW = 10
MIN_RTO_S, MAX_RTO_S = 0.2, 120.0
DELAYED_ACK_S = 0.04
PROBE_MARGIN_S = 0.002
BETA, CUBIC_C = 717 / 1024, 0.4
FRIENDLY_ACKS = 15 / 8
"""Acknowledged packets, in windows, for which the friendly window grows by one packet."""
EARLY_SACKS = 3
"""Packets acknowledged out of order after which RACK waits no longer for reordering."""
MIN_WINDOW = 2


class Cubic:
    """The congestion window's growth and reduction, in packets."""

    def __init__(self) -> None:
        self._last_max = 0.0
        self._epoch_s: float | None = None
        self._k_s = self._origin = 0.0
        self._acks = self._friendly = 0.0

    def reduced(self, window: int) -> int:
        """Note a loss; return the window to go on with."""
        self._epoch_s = None
        is_lower = window < self._last_max
        self._last_max = window * (1 + BETA) / 2 if is_lower else float(window)
        return max(MIN_WINDOW, int(window * BETA))

    def acks_per_packet(self, window: int, acked: int, now: float, min_rtt_s: float) -> int:
        """Return after how many acknowledged packets the window grows by one."""
        if self._epoch_s is None:
            self._epoch_s, self._acks, self._friendly = now, 0.0, float(window)
            below = max(0.0, self._last_max - window)
            self._k_s, self._origin = math.cbrt(below / CUBIC_C), window + below
        after_s = now - self._epoch_s + min_rtt_s
        target = self._origin + CUBIC_C * (after_s - self._k_s) ** 3
        count = window / (target - window) if target > window else 100.0 * window
        if not self._last_max:
            count = min(count, 20.0)
        self._acks += acked
        per_packet = window * FRIENDLY_ACKS
        grown = max(0, math.ceil(self._acks / per_packet) - 1)
        self._acks -= grown * per_packet
        self._friendly += grown
        if self._friendly > window:
            count = min(count, window / (self._friendly - window))
        return max(2, int(count))

    def forget(self) -> None:
        """Begin anew after a timeout."""
        self.__init__()  # type: ignore[misc]


@dataclass(slots=True)
class Sent:
    """A packet that was sent and is not acknowledged up to its end."""

    start: int
    end: int
    sent_s: float
    is_again: bool = False
    is_sacked: bool = False
    is_lost: bool = False


@dataclass(frozen=True)
class AckPacket:
    """States that a receiver has everything below ``upto``, and ``ranges`` beyond it.

    ``is_repeated``: it got something that it had.
    """

    upto: int
    ranges: tuple[tuple[int, int], ...] = ()
    is_repeated: bool = False


class Phase(Enum):
    """Phase of the sender."""

    OPEN = auto()
    RECOVERY = auto()
    TIMED_OUT = auto()


class Timer(Enum):
    """Action when the timer runs out."""

    RTO = auto()
    PROBE = auto()
    REORDER = auto()


class Sender:
    """Sends a stream of bytes; ``rtt_s`` is what its handshake measured.

    The caller writes (``written``), asks for packets (``packets``), brings acknowledgements
    (``acked``), and calls ``expired`` at ``timer_s``.
    """

    def __init__(self, rtt_s: float) -> None:
        self.timer_s: float | None = None
        self.window = INITIAL_WINDOW
        self.sent_upto = 0
        self.written_upto = 0
        self._timer = Timer.RTO
        self._phase = Phase.OPEN
        self._sent: list[Sent] = []
        self._cubic = Cubic()
        self._slow_start_below = math.inf
        self._grown = 0
        self._srtt_s, self._rttvar_s, self._min_rtt_s = rtt_s, rtt_s / 2, rtt_s
        self._backoff = 1
        self._newest_s, self._newest_rtt_s = -math.inf, rtt_s
        self._recover_upto = 0
        self._before = self._delivered = self._resent = 0
        self._probe_upto: int | None = None
        self._probed_again = False
        self._most_out = 0
        self._is_limited = False
        self._usage_upto = 0
        self._last_s = -math.inf

    @property
    def unsent_bytes(self) -> int:
        """Bytes that were written and not sent."""
        return self.written_upto - self.sent_upto

    def written(self, size_bytes: int, now: float) -> None:
        """Append bytes to the stream."""
        idle_s = now - self._last_s
        if not self._sent and idle_s > self._rto_s:
            halvings = int(min(idle_s / self._rto_s, 20))
            self.window = max(self.window >> halvings, min(self.window, INITIAL_WINDOW))
        self.written_upto += size_bytes

    def packets(self, now: float) -> Iterator[tuple[int, int]]:
        """Yield the bytes, as (start, end), that are to be sent now."""
        while self._in_flight < self.window:
            lost = next((packet for packet in self._sent if packet.is_lost), None)
            if lost is not None:
                yield self._again(lost, now)
            elif self.unsent_bytes:
                yield self._new(now)
            else:
                break
        self._note_usage()

    def acked(self, ack: AckPacket, now: float) -> None:
        """Take an acknowledgement."""
        before = self._sent[0].start if self._sent else self.sent_upto
        newly = self._take_off(ack, now)
        advanced = ack.upto > before
        if advanced:
            self._backoff = 1
        self._end_probe(ack)
        newly_lost = self._find_lost(now)
        if self._phase is not Phase.OPEN and ack.upto >= self._recover_upto:
            if self._phase is Phase.RECOVERY:
                self.window = int(self._slow_start_below)
            self._phase = Phase.OPEN
        if self._phase is Phase.OPEN and any(packet.is_lost for packet in self._sent):
            self._begin_recovery()
        if self._phase is Phase.RECOVERY:
            self._reduce(newly, advanced and not newly_lost)
        elif newly and advanced:
            self._grow(newly, now)
        self._arm(now, anew=advanced)

    def expired(self, now: float) -> Iterator[tuple[int, int]]:
        """Yield the bytes to send at once, since the timer ran out at ``now``."""
        match self._timer:
            case Timer.REORDER:
                self._find_lost(now)
                if self._phase is Phase.OPEN and any(packet.is_lost for packet in self._sent):
                    self._begin_recovery()
                    self._reduce(0, grows=False)
                self._arm(now, anew=True)
            case Timer.PROBE:
                yield from self._probe(now)
            case Timer.RTO:
                self._time_out(now)
                yield self._again(self._sent[0], now)
        yield from self.packets(now)

    # --- sending

    @property
    def _in_flight(self) -> int:
        return sum(not (packet.is_sacked or packet.is_lost) for packet in self._sent)

    def _new(self, now: float) -> tuple[int, int]:
        start = self.sent_upto
        self.sent_upto = min(start + MSS_BYTES, self.written_upto)
        self._sent.append(Sent(start, self.sent_upto, now))
        self._resent += self._phase is Phase.RECOVERY
        self._last_s = now
        self._arm(now, anew=self.timer_s is None or self._timer is Timer.PROBE)
        return start, self.sent_upto

    def _again(self, packet: Sent, now: float) -> tuple[int, int]:
        packet.is_lost, packet.is_again, packet.sent_s = False, True, now
        self._resent += 1
        self._last_s = now
        self._arm(now, anew=packet is self._sent[0])
        return packet.start, packet.end

    def _note_usage(self) -> None:
        """Note whether the window is what limits the sender: else it does not grow."""
        out, is_limited = len(self._sent), self.unsent_bytes > 0
        first = self._sent[0].start if self._sent else self.sent_upto
        if first >= self._usage_upto or is_limited or out > self._most_out:
            self._is_limited, self._most_out = is_limited, out
            self._usage_upto = self.sent_upto

    # --- acknowledgements

    def _take_off(self, ack: AckPacket, now: float) -> int:
        """Note what has arrived; return how many packets that are."""
        newly, rtt_s = 0, None
        for packet in self._sent:
            arrived = packet.end <= ack.upto or any(
                start <= packet.start and packet.end <= end for start, end in ack.ranges
            )
            if packet.is_sacked or not arrived:
                continue
            packet.is_sacked, packet.is_lost = True, False
            newly += 1
            took_s = now - packet.sent_s
            if packet.is_again and took_s < self._min_rtt_s:
                continue  # it was the first one that arrived
            if packet.sent_s >= self._newest_s:
                self._newest_s, self._newest_rtt_s = packet.sent_s, took_s
            if not packet.is_again and rtt_s is None:
                rtt_s = took_s
        self._sent = [packet for packet in self._sent if packet.end > ack.upto]
        if rtt_s is not None:
            self._min_rtt_s = min(self._min_rtt_s, rtt_s)
            self._rttvar_s += (abs(rtt_s - self._srtt_s) - self._rttvar_s) / 4
            self._srtt_s += (rtt_s - self._srtt_s) / 8
        return newly

    def _find_lost(self, now: float) -> bool:
        """Mark what was sent so long before something that arrived that it must be lost (RACK)."""
        sacked = sum(packet.is_sacked for packet in self._sent)
        patience_s = 0.0
        if self._phase is Phase.OPEN and sacked < EARLY_SACKS:
            patience_s = min(self._min_rtt_s / 4, self._srtt_s)
        wait_s, found = 0.0, False
        for packet in self._sent:
            if packet.is_sacked or packet.is_lost or packet.sent_s > self._newest_s:
                continue
            if packet.sent_s == self._newest_s and not self._is_passed(packet):
                continue
            left_s = packet.sent_s + self._newest_rtt_s + patience_s - now
            if left_s <= 1e-9:
                packet.is_lost = found = True
            else:
                wait_s = max(wait_s, left_s)
        if wait_s:
            self._timer, self.timer_s = Timer.REORDER, now + wait_s
        elif self._timer is Timer.REORDER:
            self.timer_s = None
        return found

    def _is_passed(self, packet: Sent) -> bool:
        """Return whether something arrived that was sent at the same moment, behind it."""
        return any(
            other.is_sacked and other.sent_s == packet.sent_s and other.start > packet.start
            for other in self._sent
        )

    def _begin_recovery(self) -> None:
        self._phase, self._recover_upto = Phase.RECOVERY, self.sent_upto
        self._before, self._delivered, self._resent = self.window, 0, 0
        self._slow_start_below = self._cubic.reduced(self.window)
        self._probe_upto = None

    def _reduce(self, newly: int, grows: bool) -> None:
        """Set the window while losses are repaired (RFC 6937)."""
        self._delivered += newly
        out, goal = self._in_flight, int(self._slow_start_below)
        if out > goal:
            share = math.ceil(self._delivered * goal / self._before)
            count = share - self._resent
        else:
            count = min(goal - out, max(self._delivered - self._resent, newly) + grows)
        self.window = out + max(count, 0 if self._resent else 1)

    def _grow(self, newly: int, now: float) -> None:
        if self.window < self._slow_start_below:
            if self.window < 2 * self._most_out or self._is_limited:
                self.window = int(min(self.window + newly, self._slow_start_below))
            return
        if not self._is_limited:
            return
        count = self._cubic.acks_per_packet(self.window, newly, now, self._min_rtt_s)
        self._grown += newly
        self.window += self._grown // count
        self._grown %= count

    # --- timers

    @property
    def _rto_s(self) -> float:
        return min(self._backoff * (self._srtt_s + max(MIN_RTO_S, 4 * self._rttvar_s)), MAX_RTO_S)

    def _arm(self, now: float, *, anew: bool) -> None:
        """Set the timer; a running one is only replaced ``anew``."""
        if not self._sent:
            self.timer_s = None
            return
        if self.timer_s is not None and (not anew or self._timer is Timer.REORDER):
            return
        self._timer, self.timer_s = Timer.RTO, now + self._rto_s
        in_order = not any(packet.is_sacked for packet in self._sent)
        if self._phase is Phase.OPEN and in_order and self._probe_upto is None:
            margin_s = MIN_RTO_S if len(self._sent) == 1 else PROBE_MARGIN_S
            probe_s = now + 2 * self._srtt_s + margin_s
            if probe_s < self.timer_s:
                self._timer, self.timer_s = Timer.PROBE, probe_s

    def _probe(self, now: float) -> Iterator[tuple[int, int]]:
        """Send one packet so that its acknowledgement shows what is lost (RFC 8985, 7)."""
        self.timer_s = None
        self._probed_again = not self.unsent_bytes
        sent = self._new(now) if self.unsent_bytes else self._again(self._sent[-1], now)
        self._probe_upto = self.sent_upto
        self._timer, self.timer_s = Timer.RTO, now + self._rto_s
        yield sent

    def _end_probe(self, ack: AckPacket) -> None:
        """Reduce the window if the probe itself has repaired a loss."""
        if self._probe_upto is None:
            return
        if ack.is_repeated and self._probed_again:
            self._probe_upto = None
        elif ack.upto >= self._probe_upto:
            self._probe_upto = None
            if self._probed_again and self._phase is Phase.OPEN:
                self.window = self._cubic.reduced(self.window)
                self._slow_start_below = self.window

    def _time_out(self, now: float) -> None:
        if self._phase is not Phase.TIMED_OUT:
            self._slow_start_below = self._cubic.reduced(self.window)
        self._phase, self._recover_upto = Phase.TIMED_OUT, self.sent_upto
        self._probe_upto = None
        self.window, self._grown = 1, 0
        self._backoff *= 2
        for packet in self._sent:
            is_recent = packet is not self._sent[0] and now - packet.sent_s < self._newest_rtt_s
            packet.is_lost = not (packet.is_sacked or is_recent)
        self.timer_s = None


class Receiver:
    """Puts the stream together; ``received`` returns what to acknowledge at once."""

    def __init__(self) -> None:
        self.upto = 0
        self.timer_s: float | None = None
        self._ranges: list[tuple[int, int]] = []
        self._unacknowledged = 0

    def received(self, start: int, end: int, now: float) -> AckPacket | None:
        """Take a packet; return its acknowledgement, None if that may wait until ``timer_s``."""
        is_repeated = end <= self.upto or any(a <= start and end <= b for a, b in self._ranges)
        was_whole = not self._ranges
        self._add(start, end)
        self._unacknowledged += 1
        is_short = end - start < MSS_BYTES
        waits = was_whole and not self._ranges and not is_repeated and not is_short
        if waits and self._unacknowledged < 2:
            self.timer_s = now + DELAYED_ACK_S
            return None
        return self.acknowledgement(is_repeated)

    def acknowledgement(self, is_repeated: bool = False) -> AckPacket:
        """Return what has arrived."""
        self._unacknowledged, self.timer_s = 0, None
        return AckPacket(self.upto, tuple(self._ranges), is_repeated)

    def _add(self, start: int, end: int) -> None:
        merged: list[tuple[int, int]] = []
        for a, b in sorted([*self._ranges, (start, end)]):
            if a <= self.upto:
                self.upto = max(self.upto, b)
            elif merged and a <= merged[-1][1]:
                merged[-1] = (merged[-1][0], max(b, merged[-1][1]))
            else:
                merged.append((a, b))
        self._ranges = merged
