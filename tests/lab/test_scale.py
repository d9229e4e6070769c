"""What is read from vehicles' reports, and the cases once, with few small vehicles."""

from pathlib import Path
from typing import Any

import pytest

from lab.servers.envoy import EnvoySetup
from lab.servers.nats import undisturbed
from lab.servers.scale import (
    Shown,
    failures,
    keyframes,
    resumed_s,
)
from rfcore.errors import InvalidInput

S = 10**9


def line(at_s: float, epoch: int, result: str = "acked", **more: Any) -> dict[str, Any]:
    """A picture taken so many seconds after the beginning of time, answered 100 ms later."""
    told = {"capture_time_ns": round(at_s * S), "epoch": epoch, "result": result}
    return {**told, "latency_ms": 100.0, "references": ["warp", "render"], **more}


def sent(at_s: float, way_ms: float, result: str = "acked") -> dict[str, Any]:
    """A picture that took so long from sending to Ack, a quarter of it at the server."""
    stage_ms = {"link": 0.75 * way_ms, "server_total": 0.25 * way_ms, "encode": 500.0}
    return line(at_s, 1, result, stage_ms=stage_ms)


@pytest.mark.parametrize(("way_ms", "held"), [(58.0, True), (58.5, False)])
def test_frames_may_take_little_longer_while_nats_is_away(way_ms: float, held: bool) -> None:
    told = [
        [sent(9.0, 900.0), sent(10.0, 40.0), sent(12.0, way_ms), sent(15.0, 900.0)],
        [sent(11.0, 30.0), sent(11.5, 900.0, "lost"), sent(13.0, 20.0)],
    ]
    row = undisturbed(told, 10 * S, 12 * S, 15 * S)
    assert row.bound == pytest.approx(1.2 * 40.0 + 10.0)
    assert (row.measured, row.held) == (pytest.approx(way_ms), held)


def test_without_frames_before_nothing_is_compared() -> None:
    with pytest.raises(InvalidInput, match="nothing"):
        undisturbed([[sent(12.0, 40.0)]], 10 * S, 12 * S, 15 * S)


def test_a_vehicle_is_back_with_the_first_ack_on_another_stream() -> None:
    lines = [
        *(line(9.0, 1), line(9.9, 1)),
        line(10.1, 1, "lost"),
        line(10.2, 2, "dropped"),
        *(line(10.4, 2), line(10.6, 2)),
    ]
    assert resumed_s(lines, 10 * S) == pytest.approx(0.5)


def test_a_vehicle_that_kept_its_stream_is_not_back() -> None:
    assert resumed_s([line(9.0, 1), line(10.1, 1), line(10.3, 1)], 10 * S) is None
    assert resumed_s([line(9.0, 1), line(10.1, 2, "lost")], 10 * S) is None


def test_pictures_that_nobody_sent_are_no_failures() -> None:
    results = ("acked", "lost", "nacked", "dropped", "lost", "lost")
    lines = [line(at_s, 1, result) for at_s, result in enumerate(results)]
    assert failures(lines, 1 * S, 5 * S) == 3


def test_a_keyframe_is_an_acknowledged_picture_without_the_render() -> None:
    alone = {"references": ["previous"]}
    lines = [line(0, 1), line(1, 1, **alone), line(2, 1, "lost", **alone)]
    assert keyframes(lines) == 1


def shown(text: str, vehicle: str = "cav", camera: str = "front") -> list[Shown]:
    """Return pictures in the order they were shown: ``1a 2a`` are the first two, at server a."""
    return [Shown(vehicle, camera, int(each[:-1]), each[-1]) for each in text.split()]


def test_a_configuration_without_the_ports_to_take_is_refused(tmp_path: Path) -> None:
    config = tmp_path / "other.yaml"
    config.write_text("port_value: 9901\n")
    with pytest.raises(InvalidInput, match="must say `port_value: 50050` once"):
        EnvoySetup(tmp_path / "envoy", config, tmp_path).write()
