"""What experiments report: every row of a result in its section, figure and printed table."""

import csv
import io
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.console import Console

from lab.latency.report import (
    NeededRow,
    PlayedRow,
    ShownRow,
    latency_section,
    print_needed,
    write_latency_figures,
)
from lab.paper.report import PaperRow
from lab.robust.report import (
    DisturbanceRow,
    LossRow,
    print_robust,
    robust_section,
    write_robust_figure,
)
from rfcore.errors import InvalidInput
from rfedge.evaluate.compare.figures import write_compare_figures
from rfedge.evaluate.compare.report import (
    BitShareRow,
    BreakEvenRow,
    CompareRow,
    CurveRow,
    ForegroundRow,
    SsimRow,
    compare_section,
    harder_sentence,
    headline,
    print_compared,
)
from rfedge.evaluate.ladder.page import (
    LadderRow,
    ladder_page,
    middle_rows,
    print_front,
    write_ladder_figure,
)
from rfedge.evaluate.never_worse.measure import (
    NeverWorseRow,
    never_worse_section,
    print_never_worse,
)
from rfedge.results import Provenance, as_json, make_result

HOST = {"cpu": "C", "cores": 2, "isa": "avx2"}
MADE = Provenance("rfedge eval x", "abc123", False, HOST, {})


def result_of(**content: Any) -> dict[str, Any]:
    return make_result("test", MADE, content)


def printed(show: Callable[[Console], None]) -> str:
    console = Console(file=io.StringIO(), width=80)
    show(console)
    text = str(console.file.getvalue())  # type: ignore[attr-defined]
    assert max(map(len, text.splitlines())) <= 80
    return text


def lines_of(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


def shown_in(path: Path) -> str:
    nodes = ElementTree.fromstring(path.read_text()).iter("{http://www.w3.org/2000/svg}text")
    return " ".join("".join(node.itertext()).strip() for node in nodes)


# --- compare

COMPARED = CompareRow(
    scene="yardstick-empty",
    hz=10.0,
    method="rfedge-veryfast-0123",
    rival="x264-lowdelay",
    rival_setting="x264-lowdelay-veryfast",
    window_db=(32.0, 35.0),
    bd_rate_percent=-57.31,
    ci95=(-60.04, -54.0),
    points=9,
    saving_percent_at_db={"31": 80.2, "33": 55.1, "35": 40.0},
    first_frame_bytes=12_340,
    rival_first_frame_bytes=40_000,
    ssim=0.91,
    rival_ssim=0.902,
    psnr_deviation_db=0.123,
    rival_psnr_deviation_db=0.2,
    cpu_ms=90.4,
    rival_cpu_ms=19.6,
    both_ends_ms=(151.2, 140.1, 170.0),
    rival_both_ends_ms=(24.4, 24.0, 25.6),
    field_psnr_db=28.123,
)
PAID = BreakEvenRow(
    scene="yardstick-empty",
    hz=10.0,
    method="rfedge-veryfast-0123",
    rival="x264-lowdelay-veryfast",
    at_db=33.0,
    frames_per_pass=24,
    field_bytes=5_040_000,
    saved_bytes_per_pass=123_456.0,
    passes_to_break_even=41,
    saving_percent_after={"1": -2000.4, "10": -150.0, "100": 33.3},
)
CURVE = CurveRow(
    scene="yardstick-empty",
    hz=10.0,
    family="x264-lowdelay",
    setting="x264-lowdelay-veryfast",
    cpu_ms=19.6,
    both_ends_ms=24.4,
    point=[41.0, 17.0],
    psnr_db=[30.0, 37.0],
    bytes_per_frame=[1000.0, 9000.0],
    ssim=[0.8, 0.95],
)
OURS = replace(
    CURVE,
    family="",
    setting="rfedge-veryfast-0123",
    both_ends_ms=151.2,
    bytes_per_frame=[500.0, 8000.0],
)
FOREGROUND = ForegroundRow(
    scene="s",
    hz=10.0,
    mask="m",
    foreground_percent=12.4,
    window_db=(31.0, 34.0),
    bd_rate_percent=18.6,
    whole_picture_ceiling_db=29.04,
    ours={"foreground_psnr_db": [30.0], "bytes_per_frame": [900.0]},
    rfdvc_style={"foreground_psnr_db": [30.0], "bytes_per_frame": [800.0]},
)


def test_a_comparison_names_field_quality_and_interval_beside_its_figure() -> None:
    section = compare_section(Path("compare.json"), result_of(rows=[COMPARED]))
    assert "`rfedge-veryfast` over 32..35 dB, against" in section
    assert "| drive | x264-lowdelay |" in section
    assert "| yardstick-empty, 10 Hz | -57.3 |" in section
    assert (
        "| yardstick-empty, 10 Hz | 80 / 55 / 40 | 0.910 / 0.902 | 0.12 / 0.20 | 12.3 / 40.0 "
        "| 90 / 20 | 151 (140..170) | 24 (24..26) | 28.12 |"
    ) in section
    assert "| drive | 32..35 |" in section
    assert section.count("| yardstick-empty, 10 Hz | -57.3 (-60.0..-54.0) |") == 2


def test_a_comparison_has_a_line_a_drive_and_a_column_for_each_rival_window_and_method() -> None:
    fair = replace(COMPARED, rival="x264-our-tools-medium", bd_rate_percent=-51.0)
    best = replace(COMPARED, rival="best-of-any-cpu", rival_setting="av1", bd_rate_percent=-41.2)
    higher = replace(fair, window_db=(35.0, 38.0), bd_rate_percent=-30.0)
    bare = replace(fair, method="rfedge-without-field-veryfast-0123", bd_rate_percent=9.0)
    other = replace(fair, scene="other", bd_rate_percent=-60.0)
    rows = [COMPARED, fair, best, higher, bare, other]
    section = compare_section(Path("compare.json"), result_of(rows=rows))
    assert "| drive | x264-lowdelay | x264-our-tools-medium | best-of-any-cpu |" in section
    assert "| yardstick-empty, 10 Hz | -57.3 | -51.0 | -41.2 (av1) |" in section
    assert "| other, 10 Hz | - | -60.0 | - |" in section
    assert "| drive | 32..35 | 35..38 |" in section
    assert "| other, 10 Hz | -60.0 (-60.0..-54.0) | - |" in section
    assert "| drive | rfedge-veryfast | rfedge-without-field-veryfast |" in section
    assert "-51.0 (-60.0..-54.0) | +9.0 (-60.0..-54.0) |" in section


def test_a_drive_with_several_fields_has_a_line_for_each() -> None:
    rows = [COMPARED, replace(COMPARED, method="rfedge-veryfast-4567", bd_rate_percent=-20.0)]
    section = compare_section(Path("compare.json"), result_of(rows=rows))
    assert "| yardstick-empty, 10 Hz, field 0123 | -57.3 |" in section
    assert "| yardstick-empty, 10 Hz, field 4567 | -20.0 |" in section


def test_curves_that_share_no_window_are_said_to() -> None:
    section = compare_section(Path("compare.json"), result_of(rows=[]))
    assert section.rstrip().endswith("No curves share a window.")


def test_a_quality_that_was_not_reached_and_an_unknown_field_are_dashes() -> None:
    row = replace(COMPARED, saving_percent_at_db={"33": 55.1}, field_psnr_db=None)
    section = compare_section(Path("compare.json"), result_of(rows=[row]))
    assert "| - / 55 / - |" in section
    assert "| 24 (24..26) | - |" in section


def test_what_was_not_measured_of_a_comparison_is_left_out() -> None:
    section = compare_section(Path("compare.json"), result_of(rows=[COMPARED]))
    assert "own bytes" not in section
    assert "Where the bits go" not in section
    assert "Foreground" not in section


def test_break_even_bits_and_foreground_stand_below_the_comparison() -> None:
    share = BitShareRow("yardstick-empty", 10.0, "m", 27.0, "static", 80.4, 20.0, 312.6)
    moving = replace(share, shows="moving", area_percent=19.6, bytes_per_frame=1250.0)
    never = replace(PAID, scene="other", passes_to_break_even=None)
    content = {"rows": [COMPARED], "break_even": [PAID, never], "bits": [share, moving]}
    unshared = replace(FOREGROUND, window_db=None, bd_rate_percent=None)
    content["foreground"] = [FOREGROUND, unshared]
    section = compare_section(Path("compare.json"), result_of(**content))
    assert "| 123.5 | 5.04 | 41 | -2000 / -150 / 33 |" in section
    assert "| other, 10 Hz | 123.5 | 5.04 | never |" in section
    assert "| drive | static | moving |" in section
    assert "| yardstick-empty, 10 Hz | 313 (80 %) | 1250 (20 %) |" in section
    assert "has a BD-rate of +19 % at equal quality of the foreground (31.0..34.0 dB)" in section
    assert "they share no window of a decibel" in section


def test_a_comparison_by_ssim_names_the_rivals_setting_and_the_window() -> None:
    row = SsimRow("s", 10.0, "rfedge-fast-01", "x264-ssim", "x264-x", (0.88, 0.92), -50.04)
    section = compare_section(Path("compare.json"), result_of(rows=[COMPARED], ssim=[row]))
    assert "| drive | x264-x |" in section
    assert "| s, 10 Hz | -50.0 (0.88..0.92) |" in section


def test_the_headline_has_the_fair_anchor_the_best_rival_and_ours_without_the_field() -> None:
    fair = replace(COMPARED, rival="x264-our-tools-medium")
    best = replace(
        COMPARED, rival="best-of-any-cpu", rival_setting="svtav1-lowdelay-p4", bd_rate_percent=-41.2
    )
    bare = replace(fair, method="rfedge-without-field-veryfast-0123", bd_rate_percent=1.24)
    wider = replace(fair, window_db=(30.0, 33.0), bd_rate_percent=-99.0)
    rows = [fair, best, bare, wider]
    sentence, *_, line = headline(result_of(rows=rows, break_even=[PAID])).splitlines()
    assert (
        "**57 %** (95 %: 54 to 60 %) on drives through synthetic streets; for 151 ms of" in sentence
    )
    assert line == (
        "| yardstick-empty, 10 Hz | -57.3 % (-60.0..-54.0) | -41.2 % (svtav1-lowdelay-p4) "
        "| +1.2 % | 151 / 24 | 5.0 MB, 41 of 2.4 s, 185 MB |"
    )
    never = replace(PAID, passes_to_break_even=None)
    assert headline(result_of(rows=rows, break_even=[never])).endswith("| 5.0 MB, never, 185 MB |")
    with pytest.raises(InvalidInput, match="yardstick-empty@10 lacks rfedge-without-field"):
        headline(result_of(rows=[fair, best], break_even=[PAID]))
    with pytest.raises(InvalidInput, match="break_even: yardstick-empty@10 lacks rfedge"):
        headline(result_of(rows=rows))


def test_the_headline_tells_real_second_passes_apart_and_leaves_out_what_is_an_upper_bound() -> (
    None
):
    def drive(scene: str, percent: float) -> list[CompareRow]:
        interval = (percent - 3, percent + 2)
        fair = replace(
            COMPARED,
            scene=scene,
            rival="x264-our-tools-medium",
            bd_rate_percent=percent,
            ci95=interval,
        )
        bare = replace(fair, method="rfedge-without-field-veryfast-0123")
        return [fair, replace(fair, rival="best-of-any-cpu"), bare]

    drives = {"kitti-city": -90.0, "a": -50.0, "b": -70.0, "kitti-loop": -68.0}
    rows = [row for scene, percent in drives.items() for row in drive(scene, percent)]
    paid = [replace(PAID, scene=scene) for scene in drives]
    sentence = headline(result_of(rows=rows, break_even=paid)).splitlines()[0]
    assert "**50 to 70 %** (95 %: 48 to 73 %) on drives through synthetic streets, " in sentence
    assert "**68 %** (95 %: 66 to 71 %) on a real street's second pass; for" in sentence
    with pytest.raises(InvalidInput, match="no drive but upper bounds: kitti-city"):
        headline(result_of(rows=rows[:3], break_even=paid))


def test_harder_drives_are_told_from_the_most_that_is_saved_to_the_least() -> None:
    fair = replace(COMPARED, rival="x264-our-tools-medium")
    rain = replace(fair, scene="rain", bd_rate_percent=22.9)
    other = replace(rain, rival="x265-medium", bd_rate_percent=70.0)
    wider = replace(fair, window_db=(30.0, 33.0), bd_rate_percent=-99.0)
    told = harder_sentence(result_of(rows=[rain, other, fair, wider]))
    assert told.endswith(": yardstick-empty at 10 Hz -57 %, rain at 10 Hz +23 %.")
    with pytest.raises(InvalidInput, match="rain@10 lacks rfedge against x264-our-tools-medium"):
        harder_sentence(result_of(rows=[other]))


def test_every_point_of_every_curve_is_beside_its_figure(tmp_path: Path) -> None:
    result = result_of(rows=[COMPARED], curves=[CURVE, OURS])
    written = write_compare_figures(result, tmp_path)
    assert [path.name for path in written] == [
        *("bd_rates.svg", "bd_rates.csv"),
        *("rd_yardstick-empty_10.svg", "rd_yardstick-empty_10.csv"),
        *("cpu_yardstick-empty_10.svg", "cpu_yardstick-empty_10.csv"),
    ]
    assert lines_of(written[3])[1:] == [
        ["x264-lowdelay-veryfast", "41", "30.000", "1000.0", "0.8000"],
        ["x264-lowdelay-veryfast", "17", "37.000", "9000.0", "0.9500"],
        ["rfedge-veryfast-0123", "41", "30.000", "500.0", "0.8000"],
        ["rfedge-veryfast-0123", "17", "37.000", "8000.0", "0.9500"],
    ]
    assert lines_of(written[5])[1:] == [
        ["x264-lowdelay-veryfast", "24.40", "100.00"],
        ["rfedge-veryfast-0123", "151.20", lines_of(written[5])[2][2]],
    ]
    assert 50 < float(lines_of(written[5])[2][2]) < 100 * 8 / 9
    assert lines_of(written[1])[1][-3:] == ["-57.31", "-60.04", "-54.00"]
    assert "yardstick-empty, 10 Hz" in shown_in(written[0])
    assert "rfedge-veryfast" in shown_in(written[2])
    assert {"rfedge", "x264", "veryfast"} <= set(shown_in(written[4]).split())


def test_the_figure_of_all_drives_is_of_the_headline_window_alone(tmp_path: Path) -> None:
    wider = replace(COMPARED, window_db=(30.0, 35.0), bd_rate_percent=-1.0)
    result = result_of(rows=[COMPARED, wider], curves=[CURVE, OURS])
    numbers = write_compare_figures(result, tmp_path)[1]
    assert [line[5] for line in lines_of(numbers)[1:]] == ["-57.31"]


def test_at_80_columns_each_rival_is_told_apart() -> None:
    settings = ("x264-lowdelay-veryslow", "x264-lowdelay-psnr-veryfast", "svtav1-lowdelay-p10")
    rows = [replace(COMPARED, rival_setting=setting) for setting in settings]
    text = printed(lambda console: print_compared(console, rows))
    for setting in settings:
        assert any(setting in line for line in text.splitlines())
    assert "In every row: scene yardstick-empty, Hz 10, method rfedge-veryfast" in text


# --- never worse

WORSE = NeverWorseRow(
    scene="yardstick-empty",
    hz=30.0,
    frames=24,
    control="black",
    preset="veryfast",
    at_db=33.0,
    bytes=1100.4,
    header_bytes=75.0,
    rival_bytes=1000.0,
    excess_percent=2.54,
    excess_percent_psnr_tuned=9.0,
    holds=False,
    first_frame_bytes=9000,
    rival_first_frame_bytes=8000,
    references="previous",
    cpu_ms=40.0,
    rival_cpu_ms=5.0,
)


def test_a_field_that_made_it_worse_stands_out() -> None:
    section = never_worse_section(Path("never-worse.json"), result_of(rows=[WORSE]))
    assert (
        "| yardstick-empty | 30 | black | 33 | 1100 | 75 | 1000 | +2.5 | +9.0 | **no** "
        "| previous | 40 | 5 |"
    ) in section
    good = never_worse_section(Path("n.json"), result_of(rows=[replace(WORSE, holds=True)]))
    assert "| yes |" in good
    assert "**no**" not in good


def test_at_80_columns_each_control_has_its_verdict() -> None:
    rows = [replace(WORSE, control=c, holds=c == "right") for c in ("right", "black")]
    text = printed(lambda console: print_never_worse(console, rows))
    assert re.search(r"right +│ yes", text)
    assert re.search(r"black +│ NO", text)


# --- latency

NEEDED = NeededRow(
    scene="empty",
    hz=10.0,
    method="rfedge-veryfast",
    crf=32.0,
    psnr_db=33.086,
    kbit_per_frame=8.14,
    largest_kbit=11.26,
    first_frame_kbit=11.37,
    uplink_bps_p99_within={"5": 2_259_456.0, "10": 1_127_836.0},
    stage_ms={"sender render": 21.2, "receiver decode": 1.1},
)
PLAYED = PlayedRow(
    scene="empty",
    hz=10.0,
    method="rfedge-veryfast",
    crf=32.0,
    psnr_db=33.086,
    link="4 Mbit/s",
    rate_bps=4e6,
    frames=3000,
    dropped=30,
    tau_ms={"mean": 2.034, "p50": 2.0, "p99": 2.8},
    network_ms={"mean": 2.1, "p50": 2.05, "p99": 2.9},
    network_p99_ms=None,
    share_within={"5": 0.96, "10": 0.9987},
    network_quantiles_ms=[1.0, 2.0, None],
)
SHOWN = ShownRow(
    scene="empty",
    hz=10.0,
    method="rfedge-default",
    crf=32.0,
    psnr_db=33.086,
    width_px=640,
    height_px=360,
    link="4 Mbit/s",
    rate_bps=4e6,
    frames=3000,
    dropped=30,
    sent_ms={"mean": 90.0, "p50": 88.2, "p99": 131.0},
    shown_p50_ms=88.3,
    shown_p99_ms=None,
    share_within={"50": 0.0, "100": 0.9, "200": 0.9987},
    sender_busy_percent=52.4,
    receiver_busy_percent=41.0,
)
ANCHOR = {"method": "x264-lowdelay-veryfast"}


def latency_result() -> dict[str, Any]:
    return result_of(
        played_frames=3000,
        requirement={"share": 0.99999, "frames_needed": 299_572},
        needed=[NEEDED, replace(NEEDED, **ANCHOR, stage_ms={"sender encode": 17.0})],
        rows=[PLAYED, replace(PLAYED, **ANCHOR), replace(PLAYED, link="trace", rate_bps=3e6)],
        shown=[SHOWN],
    )


def test_a_sender_has_what_it_needs_and_what_each_link_makes_of_it() -> None:
    section = latency_section(Path("latency.json"), latency_result())
    needed = "| empty | 10 | rfedge-veryfast | 33.09 | 8.1 | 11.3 | 11.4 | 2.26 | 1.13 |"
    assert needed in section
    assert "| sender | 4 Mbit/s |" in section
    assert "| empty 10 Hz, rfedge | 2.05 / never (1 %) |" in section
    assert "| empty 10 Hz, rfedge | 88 / 131, 90 % |" in section
    assert "299,572 different frames" in section


def test_frames_that_never_came_are_no_point_of_the_distribution(tmp_path: Path) -> None:
    paths = {path.name: path for path in write_latency_figures(latency_result(), tmp_path)}
    assert lines_of(paths["latency_cdf.csv"])[1:] == [
        *(
            ["empty 10 Hz, rfedge", share, ms]
            for share, ms in (("0.00", "1.000"), ("0.50", "2.000"))
        ),
        *(["empty 10 Hz, x264", share, ms] for share, ms in (("0.00", "1.000"), ("0.50", "2.000"))),
    ]
    assert lines_of(paths["tau_vs_throughput.csv"])[1:] == [
        ["empty 10 Hz, rfedge", "4", "2.034"],
        ["empty 10 Hz, x264", "4", "2.034"],
    ]
    assert lines_of(paths["stage_stack.csv"]) == [
        ["sender", "sender render", "receiver decode", "network", "sender encode"],
        ["empty 10 Hz, rfedge", "21.20", "1.10", "2.05", "0.00"],
        ["empty 10 Hz, x264", "0.00", "0.00", "2.05", "17.00"],
    ]
    assert "receiver decode" in shown_in(paths["stage_stack.svg"])


def test_at_80_columns_each_sender_has_its_uplink() -> None:
    rows = [NEEDED, replace(NEEDED, **ANCHOR), replace(NEEDED, scene="vehicles")]
    text = printed(lambda console: print_needed(console, rows))
    assert re.search(r"vehicles +│ rfedge-veryfast", text)
    assert "p99 <= 10 ms, Mbit/s 1.13" in " ".join(text.split())


# --- paper


def test_identical_pictures_have_no_psnr_in_a_result() -> None:
    """JSON has no infinity; a grey control is coded without any loss."""
    numbers = dict.fromkeys(
        (
            *("width", "height", "crf", "i_bytes", "p_bytes", "header_bytes", "savings_percent"),
            *("psnr_db", "ssim", "camera_i_bytes", "camera_i_psnr_db", "rf_psnr_db", "rf_ssim"),
        ),
        30,
    )
    names = dict.fromkeys(("field", "scene", "render", "preset", "frame", "second_type"), "x")
    row = PaperRow.of({**numbers, **names, "i_psnr_db": math.inf, "rf_residual_bands": [0.5]})
    assert row.i_psnr_db is None
    assert row.psnr_db == 30
    assert as_json(row)["i_psnr_db"] is None
    assert "rf_flip" not in as_json(row)


# --- robust

LOSSES = [
    LossRow(method, rtt_ms, loss, 0.95 - loss / 100 - rtt_ms / 1e4, 0.9 - loss / 100)
    for method in ("last-acked", "x264-idr-on-nack")
    for rtt_ms in (20.0, 100.0)
    for loss in (5.0, 0.0)
]
DISTURBED = [
    DisturbanceRow("pose noise", "1 cm", None, 27.93, 1.25, 68.3, -59.11),
    DisturbanceRow("refined pose noise", "1 cm", None, 27.61, 0.12, 68.3, -59.58, 35),
    DisturbanceRow("light", "n/a", "no drive in another light was given"),
]


def robust_result() -> dict[str, Any]:
    frames = {"count": 36, "drive": "vehicles@10=drive.json"}
    content = {"frames": frames, "equal_rate_kbps": 512.4, "quality_db": 33.0}
    return result_of(**content, rows=LOSSES, disturbances=DISTURBED)


def test_loss_is_sorted_and_a_condition_that_was_not_measured_says_why() -> None:
    section = robust_section(Path("robust.json"), robust_result())
    losses = [float(x) for x in re.findall(r"\| last-acked \| (\d+) \|", section)]
    assert losses == [0, 0, 5, 5]
    assert "| last-acked | 0 | 20 | 1 | 0.9480 | - | 0.9000 |" in section
    several = LossRow("render-only", 50.0, 5.0, 0.91234, 0.8, 100, (0.9101, 0.9144))
    section = robust_section(Path("robust.json"), {**robust_result(), "rows": as_json([several])})
    assert "| render-only | 5 | 50 | 100 | 0.9123 | 0.9101..0.9144 | 0.8000 |" in section
    assert "| pose noise | 1 cm | - | 27.9 | +1.2 | 68.3 | -59.1 |" in section
    assert "| refined pose noise | 1 cm | 35 | 27.6 | +0.1 | 68.3 | -59.6 |" in section
    no_drive = "| light | n/a: no drive in another light was given | n/a | n/a | n/a | n/a | n/a |"
    assert no_drive in section


def test_a_disturbance_without_figures_writes_none(tmp_path: Path) -> None:
    assert list(robust_result()["disturbances"][2]) == ["condition", "level", "reason"]
    drawing, numbers = write_robust_figure(robust_result(), tmp_path)
    assert len(lines_of(numbers)) == 1 + len(LOSSES)
    assert ["last-acked", "20", "5", *["0.89800"] * 3, "0.85000"] in lines_of(numbers)
    assert "round trip 100 ms" in shown_in(drawing)
    assert "SSIM at 512 kbit/s" in shown_in(drawing)


def test_the_figure_of_several_seeds_has_their_intervals(tmp_path: Path) -> None:
    several = LossRow("render-only", 50.0, 5.0, 0.91234, 0.8, 100, (0.9101, 0.9144))
    result = {**robust_result(), "rows": as_json([several])}
    drawing, numbers = write_robust_figure(result, tmp_path, "long")
    assert (drawing.name, numbers.name) == ("long.svg", "long.csv")
    expected = ["render-only", "50", "5", "0.91234", "0.91010", "0.91440", "0.80000"]
    assert expected in lines_of(numbers)
    assert drawing.read_text().count('id="LineCollection') == 2, "the interval, and in the legend"


def test_at_80_columns_both_tables_of_robustness_are_whole() -> None:
    text = printed(lambda console: print_robust(console, robust_result()))
    assert "SSIM over a lossy link, all at 512 kbit/s" in text
    for row in LOSSES:
        assert any(row.method in x and f" {row.ssim:.4f} " in x for x in text.splitlines())
    assert "Bits at 33 dB" in text
    assert "-59.1" in text


# --- ladder


def rung(name: str, crf: float, **changes: Any) -> LadderRow:
    row = LadderRow(
        rung=f"splats {name} crf{crf:g}",
        settings={"kind": "splats", "preset": name, "crf": crf},
        sender_ms=100.0,
        receiver_ms=49.26,
        sender_wall_ms=101.0,
        receiver_wall_ms=50.0,
        sender_stage_ms=dict.fromkeys(
            ("convert", "render", "references", "encode", "closed_loop"), 20.0
        ),
        receiver_stage_ms={"render": 36.8},
        bits_per_frame=77_614.5,
        psnr_db=35.32,
        ssim=0.925,
        references_used={"render": 11},
        rate_percent=0.0,
        on_front=False,
    )
    return replace(row, **changes)


RUNGS = [
    rung(name, crf, sender_ms=ms, rate_percent=rate, on_front=name != "slow")
    for name, ms, rate in (("medium", 100.0, 0.0), ("fast", 40.0, 12.5), ("slow", 120.0, 1.0))
    for crf in (23.0, 28.0, 33.0)
]


def ladder_result() -> dict[str, Any]:
    field = {"kind": "splats", "primitives": 250_000, "held_out_psnr_db": 28.67}
    frames = {"count": 12, "drive": "drive.json"}
    return result_of(rows=RUNGS, fields=[field], frames=frames, size_px=[640, 360])


def test_the_page_shows_the_middle_crf_its_front_and_the_first_rung_at_each() -> None:
    page = ladder_page(ladder_result(), {"street": {"curve": [[1.0, 20.0], [60.0, 28.5]]}})
    front, rest = page.split("## Every rung")
    assert "## The front at CRF 28" in front
    names = re.findall(r"\| splats (\w+) crf28 \| yes", front)
    assert names == ["fast", "medium"], "the quickest first, without the beaten one"
    every, crfs = rest.split("## CRF")
    assert len(re.findall(r"\| splats \w+ crf28 ", every)) == 3
    assert re.findall(r"\| splats medium (crf\d+)", crfs) == ["crf23", "crf28", "crf33"]
    assert "splats of 250,000 primitives, 28.67 dB held out" in page
    assert "| street | 60 | 28.50 |" in page
    assert page == ladder_page(ladder_result(), {"street": {"curve": [[1.0, 20.0], [60.0, 28.5]]}})


def test_without_training_runs_the_page_says_so() -> None:
    assert "No training run is recorded." in ladder_page(ladder_result(), {})


def test_the_figure_has_every_rung_at_the_middle_crf(tmp_path: Path) -> None:
    drawing, numbers = write_ladder_figure(ladder_result(), tmp_path)
    assert [line[0] for line in lines_of(numbers)[1:]] == [
        f"splats {name} crf28" for name in ("fast", "medium", "slow")
    ]
    assert lines_of(numbers)[1][1:] == ["40.00", "49.26", "12.50", "77.61", "35.320", "1"]
    assert "front" in shown_in(drawing)


def test_at_80_columns_the_front_names_its_rungs_whole() -> None:
    text = printed(lambda console: print_front(console, ladder_result()))
    for name in ("fast", "medium"):
        assert any(f"splats {name} crf28" in line for line in text.splitlines())
    assert "slow" not in text


# --- nothing to show


@pytest.mark.parametrize(
    "draw",
    [
        lambda folder: write_compare_figures({"rows": [], "curves": []}, folder),
        lambda folder: write_latency_figures({"rows": [], "needed": []}, folder),
        lambda folder: write_robust_figure({"rows": []}, folder),
        lambda folder: write_ladder_figure({"rows": []}, folder),
        lambda _folder: middle_rows([]),
    ],
)
def test_a_result_without_rows_is_not_drawn(tmp_path: Path, draw: Callable[[Path], object]) -> None:
    with pytest.raises(InvalidInput, match="no row"):
        draw(tmp_path)
    assert list(tmp_path.iterdir()) == []
