"""A drive is recorded as a line per picture, log lines for what went wrong, and metrics."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry
from structlog.testing import capture_logs

from cav_agent.deadline import DeadlineController, Step
from cav_agent.frame_log import DriveObserver, log_line
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
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.wire.address import Address
from rfcore.wire.messages import StageTimes
from rfcore.wire.tiles import Tile

Value = Callable[..., float | None]
ADDRESSES = (Address("127.0.0.1", 50051), Address("127.0.0.1", 50052))


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


@pytest.fixture
def metrics(registry: CollectorRegistry) -> AgentMetrics:
    return AgentMetrics(registry)


@pytest.fixture
def observer(metrics: AgentMetrics) -> DriveObserver:
    return DriveObserver(metrics, ADDRESSES)


@pytest.fixture
def value(registry: CollectorRegistry) -> Value:
    """Return a function that reads an agent's metric by the rest of its name and its labels."""

    def read(name: str, **labels: str) -> float | None:
        return registry.get_sample_value(f"rfedge_agent_{name}", labels)

    return read


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
        server_digest=b"digest",
        latency_s=0.08,
        link_s=0.04,
    )


def test_a_drive_ends_with_the_mean_errors_quality_and_the_latency_of_what_was_shown(
    metrics, acked
):
    """Half of 100 and of 300 is 200: 25.12 dB."""
    observer = DriveObserver(metrics, ADDRESSES)
    assert observer.quality() == {}
    for mse in (100.0, 300.0):
        shown = replace(acked, encoded=replace(acked.encoded, luma_mse=mse), latency_s=mse / 1e3)
        observer.ended(shown)
        observer.ended(replace(shown, outcome=Outcome.LOST))
    observer.ended(replace(acked, outcome=Outcome.LOST))
    assert observer.quality() == {
        "psnr_db": 25.12,
        "latency_p50_ms": 200.0,
        "latency_p99_ms": 298.0,
    }
    assert log_line(shown)["psnr_db"] == 23.36
    assert log_line(acked)["psnr_db"] is None


# --- the delay that processors take


def test_processors_that_exceed_the_delay_are_logged_once_until_they_keep_it(
    metrics: AgentMetrics, acked: FrameResult
) -> None:
    observer = DriveObserver(metrics, ADDRESSES, max_delay_ms=70)
    with capture_logs() as log:
        for latency_s, frames in [(0.05, 20), (0.08, 40), (0.05, 20), (0.08, 20)]:
            for _ in range(frames):
                observer.ended(replace(acked, latency_s=latency_s, link_s=0.01))
    exceeded, kept, again = [entry for entry in log if "max-delay" in entry["event"]]
    assert "80 ms" in exceeded["problem"]
    assert "server 6" in exceeded["problem"]
    assert "--rate" in exceeded["remedy"]
    assert kept["frame_ms"] == 50
    assert again["event"] == exceeded["event"]


@pytest.mark.parametrize(("latency_s", "link_s"), [(0.08, 0.06), (0.06, 0.01)])
def test_a_link_that_exceeds_the_delay_is_not_called_a_processor(
    metrics: AgentMetrics, acked: FrameResult, latency_s: float, link_s: float
) -> None:
    observer = DriveObserver(metrics, ADDRESSES, max_delay_ms=70)
    with capture_logs() as log:
        for _ in range(40):
            observer.ended(replace(acked, latency_s=latency_s, link_s=link_s))
    assert not [entry for entry in log if "max-delay" in entry["event"]]


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
    assert line["server_digest"] == line["reconstruction_digest"] == b"digest".hex()
    assert line["latency_ms"] == pytest.approx(80)
    own = {"read": 5, "render": 10, "encode": 20, "link": 40}
    server = {"queue": 1, "ahead": 0, "render": 0, "splice": 0, "decode": 4, "total": 6}
    expected = own | {f"server_{stage}": ms for stage, ms in server.items()}
    assert line["stage_ms"] == pytest.approx(expected)


def test_what_a_dropped_picture_did_not_get_to_is_null(
    make_capture: Callable[..., Capture], acked: FrameResult
) -> None:
    line = log_line(FrameResult(make_capture(0), Outcome.DROPPED, EndReason.SUPERSEDED))
    assert set(line) == set(log_line(acked)), "every line has every key"
    assert (line["result"], line["reason"], line["stage_ms"]) == ("dropped", "superseded", {})
    filled = "name index camera capture_time_ns result reason problem stage_ms"
    assert {key for key, value in line.items() if value is not None} == set(filled.split())


def test_the_file_is_whole_up_to_the_last_picture_that_ended(
    tmp_path: Path, metrics: AgentMetrics, acked: FrameResult
) -> None:
    file = tmp_path / "frames.jsonl"
    with file.open("w", buffering=1) as frame_log:
        observer = DriveObserver(metrics, ADDRESSES, frame_log)
        for count in (1, 2, 3):
            observer.ended(acked)
            lines = file.read_text().splitlines()
            assert [json.loads(line) for line in lines] == [log_line(acked)] * count


# --- log lines


def test_a_picture_dropped_before_it_was_coded_is_counted_and_not_logged(
    observer: DriveObserver, value: Value, make_capture: Callable[..., Capture]
) -> None:
    with capture_logs() as lines:
        observer.ended(FrameResult(make_capture(0), Outcome.DROPPED, EndReason.TOO_LATE))
    assert lines == []
    assert value("frames_total", result="dropped", reason="too_late") == 1
    assert value("sent_bytes_total") == 0


@pytest.mark.parametrize(("budget", "logged"), [(None, 1), (ByteBudget(500.0, 750), 0)])
def test_a_slice_coded_again_is_logged_unless_rate_control_asked_for_it(
    observer: DriveObserver,
    value: Value,
    acked: FrameResult,
    budget: ByteBudget | None,
    logged: int,
) -> None:
    assert acked.encoded is not None
    encoded = replace(acked.encoded, tries=3)
    with capture_logs() as lines:
        observer.ended(replace(acked, encoded=encoded, budget=budget))
    events = [line["event"] for line in lines]
    assert events == ["slice above the limit coded again"] * logged
    assert value("recoded_frames_total") == 1


def test_the_pose_feeds_time_offset_is_a_metric_and_logged_when_it_changed(
    observer: DriveObserver, value: Value, acked: FrameResult
) -> None:
    assert acked.encoded is not None
    with capture_logs() as lines:
        for offset_s in (None, 0.21, 0.23, 0.4):
            fix = PoseEstimate(LocalisationState.TRACKING, 0, feed_offset_s=offset_s)
            observer.ended(replace(acked, encoded=replace(acked.encoded, fix=fix)))
    told = [line["seconds"] for line in lines if line["event"] == "pose feed's time offset"]
    assert told == [0.21, 0.4]
    assert value("pose_feed_offset_seconds") == 0.4


def test_a_handover_is_counted_by_its_cause_and_names_server_and_tile(
    observer: DriveObserver, value: Value
) -> None:
    with capture_logs() as lines:
        observer.handed_over(ServedTile(1, Tile("east", "ab" * 32)), HandoverCause.SERVER_LOST)
    (line,) = lines
    assert (line["server"], line["tile"]) == ("127.0.0.1:50052", "east")
    assert value("handovers_total", cause="server_lost") == 1


def test_a_vehicle_under_a_deadline_shows_its_rung_its_steps_and_what_was_late(
    observer: DriveObserver, value: Value
) -> None:
    good = MeasuredRung(Rung(), 80.0, 30.0, 0.0)
    quick = MeasuredRung(Rung(references=0), 20.0, 12.0, 60.0)
    controller = DeadlineController((good, quick), 33.0)
    controller.late = True
    with capture_logs() as lines:
        observer.coded_under_deadline(controller, Step(good, quick, 2.251))
        controller.late = False
        observer.coded_under_deadline(controller, None)
        observer.coded_under_deadline(controller, Step(quick, good, 1.0))
    assert [line["event"] for line in lines] == ["stepped down", "stepped up"]
    assert (lines[0]["before"], lines[0]["rung"]) == (good.rung.name, quick.rung.name)
    assert lines[0]["slowness"] == 2.25
    assert value("rung") == controller.position == 1
    assert value("rung_steps_total", direction="down") == 1
    assert value("rung_steps_total", direction="up") == 1
    assert value("deadline_missed_frames_total") == 1


# --- metrics


def test_an_acknowledged_picture_is_counted_with_its_bytes_and_times(
    observer: DriveObserver, value: Value, acked: FrameResult
) -> None:
    observer.ended(acked)
    assert value("frames_total", result="acked", reason="") == 1
    assert value("payload_bytes_total", references="render") == 100
    assert value("sent_bytes_total") == 340
    for stage, spent_s in (("render", 0.01), ("encode", 0.02), ("link", 0.04)):
        assert value("stage_seconds_sum", stage=stage) == spent_s
    assert value("capture_to_ack_seconds_sum") == 0.08


def test_a_lost_connection_is_counted_and_shown(observer: DriveObserver, value: Value) -> None:
    observer.connected(True)
    assert value("connected") == 1
    observer.connected(False)
    assert value("connected") == 0
    assert value("connections_lost_total") == 1


def test_a_vehicle_is_named_only_when_asked(metrics: AgentMetrics, value: Value) -> None:
    named = {"vehicle": "cav-7", "camera": "front"}
    assert value("info", **named) is None
    metrics.identify("cav-7", "front")
    assert value("info", **named) == 1
