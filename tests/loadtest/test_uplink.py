"""How many vehicles an uplink carries, against what algebra says."""

import pytest

from rfedge.loadtest.uplink import Traffic, on_time_share, vehicles_carried


def test_evenly_spread_packets_fill_the_uplink_to_its_throughput() -> None:
    """1000 bytes at 10 Hz are 80 kbit/s: 12 vehicles fit into 1 Mbit/s, each packet finds it
    idle; a thirteenth makes the queue grow."""
    traffic = Traffic([1000], 10.0, 0.0081)
    assert vehicles_carried(traffic, 1e6) == 12


def test_a_packet_that_is_too_long_for_the_budget_is_never_in_time() -> None:
    assert vehicles_carried(Traffic([10_000], 1.0, 0.05), 1e6) == 0


@pytest.mark.parametrize("vehicles", [1, 5, 30])
def test_a_faster_uplink_is_never_worse(vehicles: int) -> None:
    traffic = Traffic([900, 5000, 300], 10.0, 0.03)
    shares = [on_time_share(traffic, rate, vehicles) for rate in (2e5, 1e6, 5e6, 2e7)]
    assert shares == sorted(shares)
