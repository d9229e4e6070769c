"""What a vehicle counts: ends by reason, bytes by reference, and its name only when asked."""

import re
from collections.abc import Callable
from dataclasses import replace

import pytest
from prometheus_client import CollectorRegistry

from cav_agent.deadline import Step
from cav_agent.frames import (
    Capture,
    EncodedFrame,
    EncodeJob,
    EndReason,
    FrameResult,
    Outcome,
)
from cav_agent.handover import HandoverCause
from cav_agent.metrics import AgentMetrics
from rfcore.codec.sender.ladder import MeasuredRung, Rung
from rfcore.errors import RejectReason
from rfcore.wire.messages import StageTimes


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


@pytest.fixture
def metrics(registry: CollectorRegistry) -> AgentMetrics:
    return AgentMetrics(registry)


@pytest.fixture
def acked(
    make_capture: Callable[..., Capture], encode: Callable[[EncodeJob], EncodedFrame]
) -> FrameResult:
    capture = make_capture(0)
    done = encode(EncodeJob(capture, 0, 1))
    return FrameResult(
        capture,
        Outcome.ACKED,
        encoded=done,
        packet_bytes=340,
        server=StageTimes(total_ns=10**7),
        latency_s=0.08,
        link_s=0.04,
    )


def test_an_acknowledged_picture_is_counted_with_its_bytes_and_times(
    metrics: AgentMetrics, registry: CollectorRegistry, acked: FrameResult
) -> None:
    metrics.ended(acked)
    value = registry.get_sample_value
    assert value("rfedge_agent_frames_total", {"result": "acked", "reason": ""}) == 1
    assert value("rfedge_agent_payload_bytes_total", {"references": "render"}) == 100
    assert value("rfedge_agent_sent_bytes_total") == 340
    for stage, spent_s in (("render", 0.01), ("encode", 0.02), ("link", 0.04)):
        assert value("rfedge_agent_stage_seconds_sum", {"stage": stage}) == spent_s
    assert value("rfedge_agent_capture_to_ack_seconds_sum") == 0.08


def test_a_picture_dropped_before_it_was_coded_has_a_reason_and_no_bytes(
    metrics: AgentMetrics, registry: CollectorRegistry, make_capture: Callable[..., Capture]
) -> None:
    metrics.ended(FrameResult(make_capture(0), Outcome.DROPPED, EndReason.SUPERSEDED))
    dropped = {"result": "dropped", "reason": "superseded"}
    assert registry.get_sample_value("rfedge_agent_frames_total", dropped) == 1
    assert registry.get_sample_value("rfedge_agent_sent_bytes_total") == 0


def test_a_lost_connection_is_counted_and_shown(
    metrics: AgentMetrics, registry: CollectorRegistry
) -> None:
    metrics.connected(True)
    assert registry.get_sample_value("rfedge_agent_connected") == 1
    metrics.connected(False)
    assert registry.get_sample_value("rfedge_agent_connected") == 0
    assert registry.get_sample_value("rfedge_agent_connections_lost_total") == 1


def test_a_vehicle_is_named_only_when_asked(
    metrics: AgentMetrics, registry: CollectorRegistry
) -> None:
    named = {"vehicle": "cav-7", "camera": "front"}
    assert registry.get_sample_value("rfedge_agent_info", named) is None
    metrics.identify("cav-7", "front")
    assert registry.get_sample_value("rfedge_agent_info", named) == 1


def test_a_picture_coded_again_to_fit_is_counted(
    metrics: AgentMetrics, registry: CollectorRegistry, acked: FrameResult
) -> None:
    metrics.ended(acked)
    assert acked.encoded is not None
    metrics.ended(replace(acked, encoded=replace(acked.encoded, tries=3)))
    assert registry.get_sample_value("rfedge_agent_recoded_frames_total") == 1


def test_a_vehicle_under_a_deadline_shows_its_rung_its_steps_and_what_was_late(
    metrics: AgentMetrics, registry: CollectorRegistry
) -> None:
    good = MeasuredRung(Rung(), 80.0, 30.0, 0.0)
    quick = MeasuredRung(Rung(references=0), 20.0, 12.0, 60.0)
    metrics.coded_under_deadline(1, Step(good, quick, 2.0), late=True)
    metrics.coded_under_deadline(1, None, late=False)
    assert registry.get_sample_value("rfedge_agent_rung") == 1
    metrics.coded_under_deadline(0, Step(quick, good, 1.0), late=False)
    assert registry.get_sample_value("rfedge_agent_rung") == 0
    for direction in ("down", "up"):
        labels = {"direction": direction}
        assert registry.get_sample_value("rfedge_agent_rung_steps_total", labels) == 1
    assert registry.get_sample_value("rfedge_agent_deadline_missed_frames_total") == 1


@pytest.mark.parametrize("outcome", list(Outcome))
@pytest.mark.parametrize("problem", ["", "no answer to a frame within 1.4 s", "000123.png: gone"])
def test_the_labels_of_a_frame_are_its_outcome_and_a_word_for_the_reason(
    registry: CollectorRegistry,
    metrics: AgentMetrics,
    make_capture: Callable[..., Capture],
    outcome: Outcome,
    problem: str,
) -> None:
    """Whatever the problem says, a reason is one of a closed set."""
    reasons: list[EndReason | RejectReason] = [*EndReason, *RejectReason]
    for reason in reasons:
        metrics.ended(FrameResult(make_capture(0), outcome, reason, problem))
    labels = [
        sample.labels
        for family in registry.collect()
        for sample in family.samples
        if sample.name == "rfedge_agent_frames_total"
    ]
    assert {entry["result"] for entry in labels} == {str(outcome)}
    assert {entry["reason"] for entry in labels} == {str(reason) for reason in reasons}
    assert all(re.fullmatch("[a-z_]*", entry["reason"]) for entry in labels)


def test_every_label_but_a_fields_id_has_few_values(
    registry: CollectorRegistry, metrics: AgentMetrics, acked: FrameResult
) -> None:
    metrics.ended(acked)
    metrics.field_ready("ab" * 32, "splats")
    for cause in HandoverCause:
        metrics.handed_over(cause)
    names = {
        name
        for family in registry.collect()
        for sample in family.samples
        for name in sample.labels
        if family.name.startswith("rfedge_agent_")
    }
    closed = {
        "result",
        "reason",
        "references",
        "stage",
        "cause",
        "direction",
        "kind",
        "state",
        "le",
    }
    assert names - closed == {"field"}
