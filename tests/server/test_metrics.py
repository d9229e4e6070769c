"""Vehicles are told apart in the metrics only when asked, and leave nothing behind."""

import pytest
from prometheus_client import CollectorRegistry

from mec_server.metrics import ServerMetrics
from rfcore.errors import RejectReason
from rfcore.wire.messages import Ack, Frame, FrameAddress, Nack, StageTimes

ADDRESS = FrameAddress("front", 0, 0)


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


def vehicles(registry: CollectorRegistry) -> set[str]:
    return {
        sample.labels["vehicle"]
        for family in registry.collect()
        for sample in family.samples
        if "vehicle" in sample.labels
    }


def drive(metrics: ServerMetrics, vehicle_id: str, frame: Frame) -> None:
    stream = metrics.of(vehicle_id)
    stream.received(frame, 500)
    stream.answered([Ack(ADDRESS, StageTimes(10**6, 10**7), b"d" * 16)])
    stream.answered([Nack(ADDRESS, RejectReason.SEQUENCE_GAP, "never arrived", count=3)])
    stream.reconstructed(0.05)


def test_without_the_flag_no_series_names_a_vehicle(
    registry: CollectorRegistry, make_frame: object
) -> None:
    drive(ServerMetrics(registry), "cav-1", make_frame(0))  # type: ignore[operator]
    assert vehicles(registry) == set()
    lost = {"result": "nacked", "reason": "sequence_gap"}
    assert registry.get_sample_value("rfedge_server_frames_total", lost) == 3
    assert registry.get_sample_value("rfedge_server_received_bytes_total") == 500


def test_with_the_flag_a_vehicles_series_leave_with_its_last_stream(
    registry: CollectorRegistry, make_frame: object
) -> None:
    metrics = ServerMetrics(registry, per_vehicle=True)
    for name in ("cav-1", "cav-1", "cav-2"):
        drive(metrics, name, make_frame(0))  # type: ignore[operator]
    assert vehicles(registry) == {"cav-1", "cav-2"}
    metrics.forget("cav-1")
    assert vehicles(registry) == {"cav-1", "cav-2"}, "its other stream lives"
    metrics.forget("cav-1")
    assert vehicles(registry) == {"cav-2"}
