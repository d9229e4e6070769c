"""Reports of vehicles are read, and each case is run once with few small vehicles."""

from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from lab.city.planned_load import PlannedRow
from lab.servers import EvalScale, scale
from lab.servers.cases import Measured, RayTiles, ScaleRecord, ScaleRow, ScaleRun
from lab.servers.envoy import EnvoySetup
from lab.servers.fleet import ShownPicture, failures, keyframes, p99, resumed_s, shown_twice
from lab.servers.nats import undisturbed
from lab.servers.scale import added_by_envoy, cases_of
from rfcore.errors import InvalidInput, RfedgeError
from rfedge.datasets.convert import convert_dataset
from rfedge.results import Provenance, provenance
from rfedge.samples import sample_path

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
def test_frames_may_take_little_longer_while_nats_is_away(way_ms, held):
    told = [
        [sent(9.0, 900.0), sent(10.0, 40.0), sent(12.0, way_ms), sent(15.0, 900.0)],
        [sent(11.0, 30.0), sent(11.5, 900.0, "lost"), sent(13.0, 20.0)],
    ]
    row = undisturbed(told, 10 * S, 12 * S, 15 * S)
    assert row.bound == pytest.approx(1.2 * 40.0 + 10.0)
    assert (row.measured, row.held) == (pytest.approx(way_ms), held)


def test_without_frames_before_nothing_is_compared():
    with pytest.raises(InvalidInput, match="nothing"):
        undisturbed([[sent(12.0, 40.0)]], 10 * S, 12 * S, 15 * S)


def test_a_vehicle_is_back_with_the_first_ack_on_another_stream():
    lines = [
        *(line(9.0, 1), line(9.9, 1)),
        line(10.1, 1, "lost"),
        line(10.2, 2, "dropped"),
        *(line(10.4, 2), line(10.6, 2)),
    ]
    assert resumed_s(lines, 10 * S) == pytest.approx(0.5)


def test_a_vehicle_that_kept_its_stream_is_not_back():
    assert resumed_s([line(9.0, 1), line(10.1, 1), line(10.3, 1)], 10 * S) is None
    assert resumed_s([line(9.0, 1), line(10.1, 2, "lost")], 10 * S) is None


def test_pictures_that_nobody_sent_are_no_failures():
    results = ("acked", "lost", "nacked", "dropped", "lost", "lost")
    lines = [line(at_s, 1, result) for at_s, result in enumerate(results)]
    assert failures(lines, 1 * S, 5 * S) == 3


def test_a_keyframe_is_an_acknowledged_picture_without_the_render():
    alone = {"references": ["previous"]}
    lines = [line(0, 1), line(1, 1, **alone), line(2, 1, "lost", **alone)]
    assert keyframes(lines) == 1


def shown(text: str, vehicle: str = "cav", camera: str = "front") -> list[ShownPicture]:
    """Return pictures in the order they were shown: ``1a 2a`` are the first two, at server a."""
    return [ShownPicture(vehicle, camera, int(each[:-1]), each[-1]) for each in text.split()]


@pytest.mark.parametrize(
    ("text", "twice"),
    [
        ("1a 2a 3a", 0),
        ("1a 2a 4b 3a 5b", 0),
        ("1a 3a 3a 2a 4b", 0),
        ("1a 2a 2b 3b", 1),
        ("1a 2b 3a", 1),
        ("1a 2b 3c 4b", 1),
    ],
    ids=["stays", "old frames end late", "told again", "one at both", "back and forth", "old goes"],
)
def test_a_vehicle_that_moves_is_shown_once_by_the_time_its_pictures_were_taken(text, twice):
    assert shown_twice(shown(text)) == twice


def test_vehicles_that_are_shown_twice_are_counted_once_and_cameras_are_apart():
    good = shown("1a 2a", "x", "left") + shown("1b 2b", "x", "right")
    assert shown_twice(good) == 0
    bad = shown("1a 1b", "y", "left") + shown("1a 1b", "y", "right") + shown("1a 1b", "z")
    assert shown_twice(good + bad) == 2


def test_a_percentile_of_few_values_is_the_largest_and_of_none_an_error():
    assert p99([0.1, 0.7, 0.3]) == 0.7
    assert p99(range(1, 201)) == 198
    with pytest.raises(InvalidInput, match="nothing"):
        p99([])


def test_a_row_is_held_up_to_its_bound():
    assert ScaleRow.at_most("a", 1.5, 1.5).held
    assert not ScaleRow.at_most("a", 1.5, 1.51).held


@pytest.mark.parametrize(
    "changes", [{"vehicles": 1}, {"servers": 1}, {"rounds": 0}, {"pairs": -1}, {"seconds": 0.0}]
)
def test_what_cannot_be_run_is_refused(changes):
    (name,) = changes
    with pytest.raises(InvalidInput, match=name):
        EvalScale(**changes)


def test_behind_envoy_there_is_something_to_measure():
    with pytest.raises(InvalidInput, match="nothing is to be measured"):
        cases_of(EvalScale(no_moves=True, pairs=0))
    assert cases_of(EvalScale(no_moves=True, pairs=2)) == [added_by_envoy]


# --- one result of several runs


def made(command: str = "rfedge-lab scale", **changes: Any) -> Provenance:
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    return Provenance(command, changes.get("at", "abc"), False, changes.get("host", host), {})


def rows(**measured: float) -> list[ScaleRow]:
    return [ScaleRow.at_most(case, 2.0, value) for case, value in measured.items()]


def test_a_case_measured_again_replaces_its_row_and_leaves_its_earlier_run(tmp_path):
    out = tmp_path / "scale.json"
    plan = PlannedRow(12, "cores", 1.0, 2.0, -50.0)
    tiles = RayTiles(3, "ab", 600)
    first = ScaleRecord().plus(made("a"), Measured(rows(x=1.0, y=3.0), [plan], [0.5, 1.5], [tiles]))
    first.write(out, made("a"))
    again = ScaleRecord.read(out, made("b")).plus(made("b", at="def"), Measured(rows(y=1.0, z=2.5)))
    again.write(out, made("b"))
    read = ScaleRecord.read(out, made())
    assert read.rows == rows(x=1.0, y=1.0, z=2.5)
    assert [row.held for row in read.rows] == [True, True, False]
    assert read.runs == [ScaleRun("a", "abc", ["x"]), ScaleRun("b", "def", ["y", "z"])]
    assert (read.planning, read.envoy_added_ms, read.ray) == ([plan], [0.5, 1.5], [tiles])


def test_groups_of_one_run_are_one_run():
    record = ScaleRecord()
    for case in ("x", "y"):
        record = record.plus(made(), Measured(rows(**{case: 1.0})))
    assert record.runs == [ScaleRun("rfedge-lab scale", "abc", ["x", "y"])]


def test_a_run_without_rows_left_is_forgotten():
    record = ScaleRecord().plus(made("a"), Measured(rows(x=1.0)))
    assert [run.command for run in record.plus(made("b"), Measured(rows(x=1.0))).runs] == ["b"]


def test_rows_of_another_host_or_input_are_not_added_to(tmp_path):
    out = tmp_path / "scale.json"
    ScaleRecord().plus(made(), Measured(rows(x=1.0))).write(out, made())
    with pytest.raises(InvalidInput, match=r"measured on .*'cores': 2.* not .*'cores': 4"):
        ScaleRecord.read(out, made(host={"cpu": "C", "cores": 4, "isa": "avx2"}))
    with pytest.raises(InvalidInput, match="other inputs"):
        ScaleRecord.read(out, replace(made(), inputs={"street.rff": "00"}))


def test_a_run_that_breaks_off_keeps_what_it_measured(tmp_path, monkeypatch):
    """The case of each group is written before the next one begins."""

    def broken(job: EvalScale) -> Measured:
        assert [row.case for row in ScaleRecord.read(job.out, made_here).rows] == ["x", "y"]
        raise RfedgeError("no more")

    drive = tmp_path / "small"
    convert_dataset(
        sample_path("street/transforms_drive_vehicles.json"), drive, (160, 90), slice(None, 2)
    )
    field = sample_path("fields/street.rff")
    made_here = provenance([field])
    out = tmp_path / "scale.json"
    job = EvalScale(drive=drive, field=field, size=None, work=tmp_path / "work", out=out)
    monkeypatch.setattr(scale, "cases_of", lambda _: [lambda _: Measured(rows(x=1.0))])
    scale.run_scale(job, Console(quiet=True))
    cases = [lambda _: Measured(rows(y=1.0)), broken]
    monkeypatch.setattr(scale, "cases_of", lambda _: cases)
    with pytest.raises(RfedgeError, match="no more"):
        scale.run_scale(replace(job, add=True), Console(quiet=True))
    assert [row.case for row in ScaleRecord.read(out, made_here).rows] == ["x", "y"]


def test_a_configuration_without_the_ports_to_take_is_refused(tmp_path):
    config = tmp_path / "other.yaml"
    config.write_text("port_value: 9901\n")
    with pytest.raises(InvalidInput, match="must say `port_value: 50050` once"):
        EnvoySetup(tmp_path / "envoy", config, tmp_path).write()
