"""How long a link was really busy, from the moments at which packets were really released.

The union of the intervals from the start of a busy period to the release of its last packet, less
what the packet spent in propagation. Against ``expected_s``, the time the link's machine gave those
bytes (bytes over rate where the rate is constant), it says how true the driver was: a late release
shows up as too much.
"""

from __future__ import annotations

from typing import Any

from rfcore.link.shaper import Delivery

__all__ = ["BusyMeter"]


class BusyMeter:
    """Measures one link; tell it of every release, in order.

    ``expected_s`` is how long the machine said the link would be busy.
    """

    def __init__(self) -> None:
        self._period_start_s = 0.0
        self._scheduled_end_s = float("-inf")
        self._measured_end_s = float("-inf")
        self._closed_s = 0.0
        self.expected_s = 0.0
        self.wire_bytes = 0
        self.periods = 0
        self.largest_lateness_s = 0.0

    def released(self, delivery: Delivery[Any], at_s: float) -> None:
        """``delivery`` left the link at ``at_s``."""
        if delivery.start_s > self._scheduled_end_s:
            self.periods += 1
            self._closed_s = self.busy_s
            self._period_start_s = max(delivery.start_s, self._measured_end_s)
        in_propagation_s = delivery.due_s - delivery.end_s
        self._scheduled_end_s = delivery.end_s
        self._measured_end_s = max(at_s - in_propagation_s, self._period_start_s)
        self.expected_s += delivery.end_s - delivery.start_s
        self.wire_bytes += delivery.size_bytes
        self.largest_lateness_s = max(self.largest_lateness_s, at_s - delivery.due_s)

    @property
    def busy_s(self) -> float:
        """Seconds the link was busy, measured."""
        if self._measured_end_s == float("-inf"):
            return 0.0
        return self._closed_s + self._measured_end_s - self._period_start_s

    @property
    def tau_error_percent(self) -> float | None:
        """How much longer (+) or shorter (-) than it should; None before the first byte."""
        if not self.expected_s:
            return None
        return 100.0 * (self.busy_s / self.expected_s - 1.0)
