"""What is read from vehicles' reports, and the cases once, with few small vehicles."""

from pathlib import Path
from typing import Any

import pytest

from rfcore.errors import InvalidInput
from rfedge.loadtest.envoy import EnvoySetup
from rfedge.loadtest.scale import ScaleJob, ScaleRow, failures, keyframes, p99, resumed_s

S = 10**9


def line(at_s: float, epoch: int, result: str = "acked", **more: Any) -> dict[str, Any]:
    """A picture taken so many seconds after the beginning of time, answered 100 ms later."""
    told = {"capture_time_ns": round(at_s * S), "epoch": epoch, "result": result}
    return {**told, "latency_ms": 100.0, "references": ["warp", "render"], **more}


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


def test_a_percentile_of_few_values_is_the_largest_and_of_none_an_error() -> None:
    assert p99([0.1, 0.7, 0.3]) == 0.7
    assert p99(range(1, 201)) == 198
    with pytest.raises(InvalidInput, match="nothing"):
        p99([])


def test_a_row_is_held_up_to_its_bound() -> None:
    assert ScaleRow.at_most("a", 1.5, 1.5).held
    assert not ScaleRow.at_most("a", 1.5, 1.51).held


def job(**changes: Any) -> ScaleJob:
    here = Path()
    given: dict[str, Any] = {
        "vehicles": 4, "servers": 2, "rounds": 1, "hz": 2.0, "size_px": None, "pairs": 0,
        "seconds": 1.0, "field": here, "drive": here, "config": here, "work": here, "out": here,
    }  # fmt: skip
    return ScaleJob(**(given | changes))


@pytest.mark.parametrize(
    "changes", [{"vehicles": 1}, {"servers": 1}, {"rounds": 0}, {"pairs": -1}, {"seconds": 0.0}]
)
def test_a_job_that_cannot_be_run_is_refused(changes: dict[str, Any]) -> None:
    (name,) = changes
    with pytest.raises(InvalidInput, match=name):
        job(**changes)


def test_a_configuration_without_the_ports_to_take_is_refused(tmp_path: Path) -> None:
    config = tmp_path / "other.yaml"
    config.write_text("port_value: 9901\n")
    with pytest.raises(InvalidInput, match="must say `port_value: 50050` once"):
        EnvoySetup(tmp_path / "envoy", config, tmp_path).write()
