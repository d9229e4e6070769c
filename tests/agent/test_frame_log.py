"""What is recorded of a drive: a line per picture, log lines for what went wrong, and metrics."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry
from structlog.testing import capture_logs

from cav_agent.deadline import DeadlineController, Step
from cav_agent.frame_log import DriveObserver, FrameLog, log_line
from cav_agent.frames import (
    Capture,
    EncodedFrame,
    EncodeJob,
    EndReason,
    FrameResult,
    Outcome,
)
from cav_agent.handover import HandoverCause, ServedTile
from cav_agent.metrics import AgentMetrics
from cav_agent.rate_control import ByteBudget
from rfcore.codec.sender.ladder import MeasuredRung, Rung
from rfcore.errors import RejectReason
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.wire.address import Address
from rfcore.wire.messages import StageTimes
from rfcore.wire.tiles import Tile

ADDRESSES = (Address("127.0.0.1", 50051), Address("127.0.0.1", 50052))


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


@pytest.fixture
def observer(registry: CollectorRegistry) -> DriveObserver:
    return DriveObserver(AgentMetrics(registry), ADDRESSES)


@pytest.fixture
def acked(
    make_capture: Callable[..., Capture], encode: Callable[[EncodeJob], EncodedFrame]
) -> FrameResult:
    capture = make_capture(4)
    return FrameResult(
        capture,
        Outcome.ACKED,
        encoded=replace(encode(EncodeJob(capture, 0, 1)), crf=30.0, read_s=0.005),
        packet_bytes=340,
        budget=ByteBudget(500.0, 750, 2e6),
        session_id="5e5510",
        server=StageTimes(queue_ns=1_000_000, decode_ns=4_000_000, total_ns=6_000_000),
        server_digest=b"d" * 16,
        latency_s=0.08,
        link_s=0.04,
    )


# --- a line per picture


def test_the_line_of_an_answered_picture_has_its_sizes_digests_and_times(
    acked: FrameResult,
) -> None:
    line = log_line(acked)
    assert (line["name"], line["index"], line["capture_time_ns"]) == ("004.png", 4, 1004)
    assert (line["result"], line["reason"], line["problem"]) == ("acked", "", "")
    assert (line["epoch"], line["sequence"], line["references"]) == (0, 0, ["render"])
    assert (line["payload_bytes"], line["packet_bytes"], line["target_bytes"]) == (100, 340, 500)
    assert (line["tries"], line["crf"]) == (1, 30.0)
    assert line["server_digest"] == line["reconstruction_digest"] == (b"d" * 16).hex()
    assert line["latency_ms"] == pytest.approx(80)
    own = {"read": 5, "render": 10, "encode": 20, "link": 40}
    server = {"queue": 1, "render": 0, "splice": 0, "decode": 4, "total": 6}
    expected = own | {f"server_{stage}": ms for stage, ms in server.items()}
    assert line["stage_ms"] == pytest.approx(expected)


def test_what_a_dropped_picture_did_not_get_to_is_null(
    make_capture: Callable[..., Capture], acked: FrameResult
) -> None:
    line = log_line(FrameResult(make_capture(0), Outcome.DROPPED, EndReason.SUPERSEDED))
    assert set(line) == set(log_line(acked)), "every line has every key"
    assert (line["result"], line["reason"]) == ("dropped", "superseded")
    assert line["stage_ms"] == {}
    filled = {"name", "index", "capture_time_ns", "result", "reason", "problem", "stage_ms"}
    assert {key for key, value in line.items() if value is not None} == filled


def test_the_file_is_whole_up_to_the_last_picture_that_ended(
    tmp_path: Path, registry: CollectorRegistry, acked: FrameResult
) -> None:
    frame_log = FrameLog(tmp_path / "frames.jsonl")
    observer = DriveObserver(AgentMetrics(registry), ADDRESSES, frame_log)
    for count in (1, 2, 3):
        observer.ended(acked)
        lines = (tmp_path / "frames.jsonl").read_text().splitlines()
        assert [json.loads(line) for line in lines] == [log_line(acked)] * count
    frame_log.close()


# --- log lines


def test_a_frame_that_was_answered_at_once_is_not_logged(
    observer: DriveObserver, acked: FrameResult
) -> None:
    with capture_logs() as lines:
        observer.ended(acked)
    assert lines == []


def test_a_refused_frame_is_logged_with_what_names_it_at_both_ends(
    observer: DriveObserver, acked: FrameResult
) -> None:
    refused = replace(
        acked, outcome=Outcome.NACKED, reason=RejectReason.CRC_MISMATCH, problem="0x1 != 0x2"
    )
    with capture_logs() as lines:
        observer.ended(refused)
    (line,) = lines
    assert (line["event"], line["log_level"]) == ("frame nacked", "warning")
    assert (line["session"], line["epoch"], line["seq"]) == ("5e5510", 0, 0)
    assert (line["reason"], line["problem"]) == ("crc_mismatch", "0x1 != 0x2")


def test_a_picture_dropped_before_it_was_coded_is_counted_and_not_logged(
    observer: DriveObserver, registry: CollectorRegistry, make_capture: Callable[..., Capture]
) -> None:
    with capture_logs() as lines:
        observer.ended(FrameResult(make_capture(0), Outcome.DROPPED, EndReason.TOO_LATE))
    assert lines == []
    labels = {"result": "dropped", "reason": "too_late"}
    assert registry.get_sample_value("rfedge_agent_frames_total", labels) == 1


@pytest.mark.parametrize(("budget", "logged"), [(None, 1), (ByteBudget(500.0, 750), 0)])
def test_a_slice_coded_again_is_logged_unless_rate_control_asked_for_it(
    observer: DriveObserver, acked: FrameResult, budget: ByteBudget | None, logged: int
) -> None:
    assert acked.encoded is not None
    encoded = replace(acked.encoded, tries=3)
    with capture_logs() as lines:
        observer.ended(replace(acked, encoded=encoded, budget=budget))
    events = [line["event"] for line in lines]
    assert events == ["slice above the limit coded again"] * logged


def test_a_fall_of_quality_and_its_rise_are_logged_with_what_the_path_carries(
    observer: DriveObserver, acked: FrameResult
) -> None:
    assert acked.encoded is not None
    with capture_logs() as lines:
        for crf in (23.0, 25.0, 35.0, 23.0):
            observer.ended(replace(acked, encoded=replace(acked.encoded, crf=crf)))
    falls, rises = lines
    assert (falls["event"], falls["crf_before"], falls["crf"]) == ("quality falls", 23.0, 35.0)
    assert (rises["event"], rises["crf_before"], rises["crf"]) == ("quality rises", 35.0, 23.0)
    assert (falls["target_bytes"], falls["proven_mbps"]) == (500, 2.0)


def test_the_pose_feeds_time_offset_is_a_metric_and_logged_when_it_changed(
    observer: DriveObserver, registry: CollectorRegistry, acked: FrameResult
) -> None:
    assert acked.encoded is not None
    with capture_logs() as lines:
        for offset_s in (None, 0.21, 0.23, 0.4):
            fix = PoseEstimate(LocalisationState.TRACKING, 0, feed_offset_s=offset_s)
            observer.ended(replace(acked, encoded=replace(acked.encoded, fix=fix)))
    told = [line["seconds"] for line in lines if line["event"] == "pose feed's time offset"]
    assert told == [0.21, 0.4]
    assert registry.get_sample_value("rfedge_agent_pose_feed_offset_seconds") == 0.4


def test_a_handover_is_counted_by_its_cause_and_names_server_and_tile(
    observer: DriveObserver, registry: CollectorRegistry
) -> None:
    with capture_logs() as lines:
        observer.handed_over(ServedTile(1, Tile("east", "ab" * 32)), HandoverCause.SERVER_LOST)
    (line,) = lines
    assert (line["server"], line["tile"]) == ("127.0.0.1:50052", "east")
    labels = {"cause": "server_lost"}
    assert registry.get_sample_value("rfedge_agent_handovers_total", labels) == 1


def test_a_step_to_a_faster_rung_is_logged_with_both_rungs(observer: DriveObserver) -> None:
    good = MeasuredRung(Rung(), 80.0, 30.0, 0.0)
    quick = MeasuredRung(Rung(references=0), 20.0, 12.0, 60.0)
    controller = DeadlineController((good, quick), 33.0)
    with capture_logs() as lines:
        observer.coded_under_deadline(controller, None)
        observer.coded_under_deadline(controller, Step(good, quick, 2.251))
        observer.coded_under_deadline(controller, Step(quick, good, 1.0))
    assert [line["event"] for line in lines] == ["stepped down", "stepped up"]
    assert (lines[0]["before"], lines[0]["rung"]) == (good.rung.name, quick.rung.name)
    assert lines[0]["slowness"] == 2.25
