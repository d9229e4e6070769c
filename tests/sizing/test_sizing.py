"""Laws of the interpolation, of the link and of the estimates, and what the command says."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.link.shaper import ConstantRate
from rfedge.cli import parse
from rfedge.cli.size import COLUMNS
from rfedge.sizing.estimate import (
    INSTANTS,
    Assumptions,
    Demand,
    estimate,
    needed_bps,
    share_in_time,
)
from rfedge.sizing.tables import (
    CODECS,
    MAX_BEYOND_DB,
    SHIPPED,
    CameraDemand,
    SizingCell,
    SizingTables,
    check_reach,
    log_at,
    read_tables,
    shipped_tables,
)

SIZES = ((320, 180), (640, 360), (1920, 1080))
RATES = (2.0, 10.0, 30.0)
GRID_DB = tuple(np.arange(30.0, 38.5, 0.5).tolist())


def power_law_bytes(pixels: int, hz: float, psnr_db: float) -> float:
    """An answer by algebra: a straight line in every logarithm and in decibels."""
    return 5e-4 * pixels**0.8 * hz**-0.3 * math.exp(0.2 * psnr_db)


def cell(codec: str, size_px: tuple[int, int], hz: float) -> SizingCell:
    pixels = size_px[0] * size_px[1]
    curve = [power_law_bytes(pixels, hz, db) for db in GRID_DB]
    low, high = ([share * value for value in curve] for share in (0.9, 1.1))
    ms = pixels / 1e5
    return SizingCell(codec, *size_px, hz, 8, GRID_DB, curve, low, high, (1.0,), ms, ms / 2)


WHOLE = tuple(cell("rfedge", size_px, hz) for size_px in SIZES for hz in RATES)
PARTLY = tuple(c for c in WHOLE if c.width_px == 640 or c.hz == 10.0)
"""All rates at one size alone."""
TABLES = SizingTables(
    (*PARTLY, *(replace(c, codec="x264") for c in PARTLY)), "a power law", "a machine"
)


@given(
    cells=st.sampled_from((WHOLE, PARTLY)),
    width_px=st.integers(240, 2400),
    hz=st.floats(1.0, 60.0),
    psnr_db=st.floats(29.0, 39.0),
)
def test_a_power_law_is_told_everywhere(
    cells: tuple[SizingCell, ...], width_px: int, hz: float, psnr_db: float
) -> None:
    wanted = CameraDemand(width_px, width_px * 9 // 16, hz, psnr_db)
    told = log_at(cells, wanted, lambda c: c.log_bytes(psnr_db))
    assert told == pytest.approx(math.log(power_law_bytes(wanted.pixels, hz, psnr_db)), abs=1e-6)


def test_where_it_was_measured_nothing_is_said() -> None:
    assert check_reach(WHOLE, CameraDemand(640, 360, 10.0, 34.2)) == ()


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (CameraDemand(1280, 720, 10.0, 34.0), "interpolated between 640x360 and 1920x1080"),
        (CameraDemand(640, 360, 15.0, 34.0), "15 Hz is interpolated between 10 Hz and 30 Hz"),
        (CameraDemand(2560, 1440, 10.0, 34.0), "1.78 times outside"),
        (CameraDemand(640, 360, 60.0, 34.0), "2.00 times outside"),
        (CameraDemand(640, 360, 10.0, 38.5), "38.5 dB is 0.5 dB outside 30..38 dB"),
        (CameraDemand(1920, 1080, 30.0, 34.0), "1920x1080 was measured at 10 Hz alone"),
        (CameraDemand(1280, 720, 30.0, 34.0), "1920x1080 was measured at 10 Hz alone"),
    ],
)
def test_what_lies_beyond_is_said(wanted: CameraDemand, said: str) -> None:
    assert said in " ".join(check_reach(PARTLY, wanted))


@pytest.mark.parametrize(
    ("wanted", "named"),
    [
        (CameraDemand(3840, 2160, 10.0, 34.0), "size: 3840x2160"),
        (CameraDemand(160, 90, 10.0, 34.0), "size: 160x90"),
        (CameraDemand(640, 360, 61.0, 34.0), "hz: 61 Hz"),
        (CameraDemand(640, 360, 10.0, 38.1 + MAX_BEYOND_DB), "db: 39.1 dB"),
    ],
)
def test_what_lies_too_far_beyond_is_refused(wanted: CameraDemand, named: str) -> None:
    with pytest.raises(InvalidInput, match=named):
        check_reach(PARTLY, wanted)


def test_a_drive_of_ones_own_tells_its_own_size_and_rate_alone() -> None:
    own = (cell("rfedge", (640, 360), 10.0),)
    assert check_reach(own, CameraDemand(640, 360, 10.0, 34.0)) == ()
    for other in (CameraDemand(320, 180, 10.0, 34.0), CameraDemand(640, 360, 11.0, 34.0)):
        with pytest.raises(InvalidInput, match="estimates go no further"):
            check_reach(own, other)


@given(
    sizes=st.lists(st.floats(100, 50_000), min_size=1, max_size=12),
    cameras=st.integers(1, 5),
    rate_bps=st.floats(1e5, 1e8),
)
def test_shares_are_those_of_the_link_shaper(
    sizes: list[float], cameras: int, rate_bps: float
) -> None:
    hz, within_s = 10.0, 0.08
    sizes = [float(int(size)) for size in sizes]
    link = ConstantRate(rate_bps)
    in_time = 0
    for instant in range(INSTANTS):
        for _ in range(cameras):
            size_bytes = int(sizes[instant % len(sizes)])
            _, end_s = link.schedule(size_bytes, instant / hz)
            in_time += end_s - instant / hz <= within_s + 1e-9
    share = share_in_time(sizes, cameras, hz, rate_bps, within_s + 1e-9)
    assert share == pytest.approx(in_time / (INSTANTS * cameras), abs=2 / (INSTANTS * cameras))


@pytest.mark.parametrize("cameras", [1, 4])
def test_frames_of_one_size_need_the_rate_that_algebra_says(cameras: int) -> None:
    needed = needed_bps([10_000.0], cameras, 10.0, 0.05, 0.99)
    assert needed == pytest.approx(cameras * 80_000 / 0.05, rel=0.01)


def test_a_link_carries_the_mean_rate_however_much_time_there_is() -> None:
    assert needed_bps([10_000.0], 2, 10.0, 60.0, 0.5) == pytest.approx(2 * 80_000 * 10)


def test_one_large_frame_in_a_hundred_may_be_late() -> None:
    sizes = [1000.0] * 199 + [20_000.0]
    often = needed_bps(sizes, 1, 10.0, 0.05, 0.99)
    always = needed_bps(sizes, 1, 10.0, 0.05, 0.9999)
    assert often < 0.4 * always


def test_cameras_multiply_rate_and_cores_and_divide_vehicles() -> None:
    one, four = (
        estimate(Demand(n, 640, 360, 10.0, 34.0), TABLES, Assumptions(overhead_percent=0.0))
        for n in (1, 4)
    )
    a, b = one.estimates[0], four.estimates[0]
    want_mbps = 8e-6 * 10 * power_law_bytes(640 * 360, 10.0, 34.0)
    assert a.mbps == pytest.approx(want_mbps, rel=1e-6)
    assert (a.low_mbps, a.high_mbps) == pytest.approx((0.9 * want_mbps, 1.1 * want_mbps))
    assert b.mbps == pytest.approx(4 * a.mbps)
    assert b.vehicle_cores == pytest.approx(4 * a.vehicle_cores)
    assert a.vehicle_cores == pytest.approx(10 * 2.304e-3)
    assert b.vehicles_per_cell == int(four.assumptions.planned_cell_mbps / b.mbps)


@pytest.mark.parametrize(
    ("width_px", "hz", "is_told"), [(640, 10.0, True), (800, 10.0, False), (640, 15.0, False)]
)
def test_an_interval_is_told_only_where_it_was_measured(width_px, hz, is_told):
    """Between cells nobody knows how far the interpolation is off."""
    sizing = estimate(Demand(1, width_px, width_px * 9 // 16, hz, 34.0, vehicles=3), TABLES)
    for row in (*sizing.estimates, *sizing.fleet):
        assert (row.low_mbps is not None) == (row.high_mbps is not None) == is_told


def test_a_cell_is_what_the_assumptions_say() -> None:
    dense = Assumptions()
    assert dense.planned_cell_mbps == pytest.approx(100 * 0.23 * 5.4 * 0.7)
    assert Assumptions(cell_mbps=50.0).planned_cell_mbps == pytest.approx(50 * 0.7)
    with pytest.raises(InvalidInput, match="cell-mbps: 0 is outside"):
        Assumptions(cell_mbps=0.0)
    assert dense.cells_per_km2 == pytest.approx(3 / (math.sqrt(3) / 2 * 0.04))


def test_a_delay_that_computing_takes_alone_is_refused() -> None:
    with pytest.raises(InvalidInput, match="no link keeps 20 ms: coding, decoding and propagation"):
        estimate(Demand(1, 640, 360, 10.0, 34.0, delay_ms=20.0), TABLES)


def test_who_is_late_on_any_link_is_named_and_no_cell_holds_it() -> None:
    quick = tuple(replace(c, codec="x264", sender_ms=1.0, receiver_ms=1.0) for c in PARTLY)
    mixed = SizingTables((*PARTLY, *quick), "a power law", "a machine")
    sizing = estimate(Demand(1, 1920, 1080, 10.0, 34.0, delay_ms=50.0), mixed)
    ours, theirs = sizing.estimates
    assert (ours.link_mbps, ours.vehicles_per_cell) == (None, 0)
    assert theirs.link_mbps is not None
    assert any(note.startswith("rfedge: no link keeps 50 ms") for note in sizing.beyond)


def test_less_delay_needs_more_link() -> None:
    slow, fast = (
        estimate(Demand(4, 640, 360, 10.0, 34.0, delay_ms=ms), TABLES).estimates[0].link_mbps
        for ms in (150.0, 50.0)
    )
    assert slow is not None
    assert fast is not None
    assert fast > 2 * slow


def test_a_note_never_says_of_a_size_what_was_not_measured() -> None:
    measured = {(f"{c.width_px}x{c.height_px}", c.hz) for c in shipped_tables().cells}
    for size_px in ((1280, 720), (800, 450), (480, 270), (1920, 1080), (2560, 1440)):
        for note in check_reach(shipped_tables().of("rfedge"), CameraDemand(*size_px, 15.0, 34.0)):
            for size, rates in re.findall(r"(\d+x\d+) was measured at ([\d., and]+) Hz", note):
                told = {float(hz) for hz in re.findall(r"[\d.]+", rates)}
                assert told == {hz for at, hz in measured if at == size}


@pytest.mark.parametrize(("vehicles", "delay_ms"), [(1, None), (12, 150.0), (237, 100.0)])
def test_a_fleet_needs_so_many_times_a_vehicle(vehicles, delay_ms):
    demand = Demand(4, 1280, 720, 10.0, 34.0, delay_ms, vehicles=vehicles)
    sizing = estimate(demand, shipped_tables())
    for one, fleet in zip(sizing.estimates, sizing.fleet, strict=True):
        assert fleet.codec == one.codec
        for name in ("mbps", "low_mbps", "high_mbps", "server_cores", "link_mbps"):
            each, total = getattr(one, name), getattr(fleet, name)
            assert total == (None if each is None else pytest.approx(vehicles * each))
        if one.vehicles_per_cell:
            assert (fleet.cells - 1) * one.vehicles_per_cell < vehicles
            assert vehicles <= fleet.cells * one.vehicles_per_cell
        else:
            assert fleet.cells is None


def slower(ms: float) -> SizingTables:
    """Ours with half of the bits of x264 and ``ms`` of work at the sender; x264 with none."""
    theirs = tuple(replace(c, codec="x264", sender_ms=0.1, receiver_ms=0.1) for c in PARTLY)
    halved = [
        replace(
            c,
            bytes_per_frame=[n / 2 for n in c.bytes_per_frame],
            sender_ms=ms,
            receiver_ms=0.1,
        )
        for c in PARTLY
    ]
    return SizingTables((*halved, *theirs), "a power law", "a machine")


@pytest.mark.parametrize(("ms", "is_reversed"), [(1.0, False), (39.0, False), (41.0, True)])
def test_a_delay_that_reverses_the_saving_is_warned_of_and_no_other(ms, is_reversed):
    """80 ms are left to x264; with half of the bits, ours needs more of a link below 40 ms."""
    demand = Demand(1, 640, 360, 10.0, 34.0, delay_ms=100.2)
    sizing = estimate(demand, slower(ms), Assumptions(utilisation=1.0))
    ours, theirs = sizing.estimates
    assert (ours.link_mbps > theirs.link_mbps) == is_reversed
    assert any("reverse the saving" in warning for warning in sizing.warnings) == is_reversed
    without_delay = estimate(replace(demand, delay_ms=None), slower(ms))
    assert without_delay.warnings == []


def test_a_codec_that_is_late_on_any_link_has_lost_its_saving():
    sizing = estimate(Demand(1, 640, 360, 10.0, 34.0, delay_ms=100.0), slower(90.0))
    assert any("no link will do" in warning for warning in sizing.warnings)


@pytest.mark.parametrize(("delay_ms", "is_long"), [(1000.0, True), (60.0, False)])
@pytest.mark.parametrize("share", [0.7, 0.9])
def test_a_planned_link_is_used_to_a_share_and_carries_the_delay(delay_ms, is_long, share):
    """Frames are all of one size: with much time, the least link is the mean rate."""
    demand, assumed = Demand(1, 640, 360, 10.0, 34.0, delay_ms), Assumptions(utilisation=share)
    sizing = estimate(demand, slower(1.0), assumed)
    for one in sizing.estimates:
        assert (one.least_link_mbps == pytest.approx(one.mbps, rel=0.01)) == is_long
        assert one.link_mbps == pytest.approx(max(one.least_link_mbps, one.mbps / share))
        assert one.vehicles_per_cell == math.floor(assumed.planned_cell_mbps / one.least_link_mbps)


@pytest.mark.parametrize(
    ("suffix", "magic"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")]
)
def test_a_plot_for_a_report_names_its_conditions(tmp_path, suffix, magic, capsys):
    plot = tmp_path / "new" / f"uplink.{suffix}"
    asked = "--vehicles 12 --cameras 4 --size 640x360 --hz 10 --delay-ms 150"
    parse(["size", *asked.split(), "--plot", str(plot), "--json", str(tmp_path / "a.json")]).run()
    assert plot.read_bytes().startswith(magic)
    if suffix == "svg":
        conditions = ("12 vehicles", "4 cameras of 640x360 px at 10 Hz", "150 ms", "Mbit/s")
        drawn = plot.read_text()
        assert all(name in drawn for name in (*CODECS, *conditions))
        assert max(map(len, re.findall(r">([^<]+)</text>", drawn))) <= COLUMNS
    assert "All 12 vehicles" in capsys.readouterr().out, "a file does not silence the table"


def test_a_plot_says_where_no_link_will_do_and_all_that_is_noted(tmp_path, capsys):
    """Of a fleet, every figure in it is the fleet's: none is a single vehicle's."""
    plot = tmp_path / "uplink.svg"
    asked = "--vehicles 12 --cameras 4 --size 1280x720 --hz 15 --delay-ms 100"
    parse(["size", *asked.split(), "--plot", str(plot)]).run()
    drawn = re.findall(r">([^<]+)</text>", plot.read_text())
    assert [text.strip() for text in drawn].count("no link keeps 100 ms") == 1
    assert "uplink of all 12 vehicles, Mbit/s with transport" in drawn
    small_print = " ".join(drawn)
    for note in ("between 640x360 and 1920x1080", "synthetic street", "effect of 15 Hz", "reverse"):
        assert note in small_print
    assert small_print.count("Mbit/s") == 1
    row = re.search(r"rfedge .*", capsys.readouterr().out)
    assert "none" in row[0]


def test_a_plot_of_another_kind_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match=r"plot: .*uplink\.jpg does not end in"):
        parse(["size", "--plot", str(tmp_path / "uplink.jpg")]).run()


def test_every_codec_is_in_every_cell_of_the_tables_that_ship() -> None:
    tables = shipped_tables()
    assert tables.codecs == CODECS
    places = {(c.width_px, c.height_px, c.hz) for c in tables.of("rfedge")}
    assert {(320, 180), (640, 360), (1920, 1080)} <= {place[:2] for place in places}
    for codec in CODECS:
        cells = tables.of(codec)
        assert {(c.width_px, c.height_px, c.hz) for c in cells} == places
        for one in cells:
            columns = (one.bytes_per_frame, one.low_bytes, one.high_bytes)
            assert all(len(column) == len(one.psnr_db) for column in columns)
            assert np.all(np.diff(one.bytes_per_frame) > 0)
            assert np.mean(one.frame_ratios) == pytest.approx(1, abs=2e-3)
            assert min(one.psnr_db) <= 33.0
            assert max(one.psnr_db) >= 35.0


def test_a_question_is_answered_for_every_codec(capsys: pytest.CaptureFixture[str]) -> None:
    asked = "--cameras 4 --size 1920x1080 --hz 30 --db 34 --delay-ms 100 --share 0.99"
    parse(["size", *asked.split()]).run()
    said = capsys.readouterr().out
    for name in (*CODECS, "Mbit/s", "vehicle", "cells a km2"):
        assert name in said


def test_the_answer_as_json_reads_back(tmp_path: Path) -> None:
    parse(["size", "--size", "640x360", "--json", str(tmp_path / "size.json")]).run()
    sizing = json.loads((tmp_path / "size.json").read_text())["sizing"]
    assert [row["codec"] for row in sizing["estimates"]] == list(CODECS)
    assert sizing["demand"]["psnr_db"] == 34.0
    host = json.loads(SHIPPED.read_text())["host"]
    assert sizing["measured_machine"] == f"{host['cpu']}, {host['cores']} cores, {host['isa']}"


def test_half_of_an_own_drive_is_refused() -> None:
    with pytest.raises(InvalidInput, match="--drive and --field together"):
        parse(["size", "--drive", "somewhere"]).run()


def test_another_result_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text('{"kind": "compare"}')
    with pytest.raises(InvalidInput, match="kind 'compare'"):
        read_tables(tmp_path / "x.json")


@pytest.mark.sample
@pytest.mark.slow
def test_an_own_drive_is_measured_and_a_stopped_run_codes_nothing_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ("--drive", "samples/street/transforms_drive_vehicles.json", "--field", "street")
    size = ("size", "--size", "160x90", "--hz", "5", "--frames", "5", "--db", "33")
    arguments = [*size, *own, "--cells", str(tmp_path)]
    parse(arguments).run()
    first = capsys.readouterr().out
    cells = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    parse(arguments).run()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == cells
    assert first.splitlines()[:4] == capsys.readouterr().out.splitlines()[:4]
    with pytest.raises(InvalidInput, match="hz: 3 is not 10 Hz"):
        parse([*size[:3], "--hz", "3", *own]).run()
