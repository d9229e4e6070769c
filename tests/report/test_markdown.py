"""The committed figures page is what the committed result files say."""

import json
from pathlib import Path

import pytest

from rfcore.errors import InvalidInput
from rfedge.experiments.ladder.page import ladder_page
from rfedge.pages.results import results_page

ROOT = Path(__file__).parents[2]


def test_the_page_is_generated_from_the_result_files() -> None:
    assert (ROOT / "docs" / "results.md").read_text() == results_page(ROOT / "results")


def test_the_ladders_page_is_generated_from_the_result_files() -> None:
    result = json.loads((ROOT / "results" / "ladder.json").read_text())
    runs = {p.stem: json.loads(p.read_text()) for p in sorted(ROOT.glob("results/train/*.json"))}
    assert (ROOT / "docs" / "ladder.md").read_text() == ladder_page(result, runs)


def test_a_bench_result_becomes_a_table_with_its_provenance(tmp_path: Path) -> None:
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    rows = [{"width": 64, "sender_ms": {"render": 1.25, "total": 3.0}, "reference_ms": None}]
    result = {"case": "codec", "host": host, "revision": "abc123", "rows": rows}
    (tmp_path / "codec.json").write_text(json.dumps(result))
    page = results_page(tmp_path)
    assert "| width | sender_ms.render | sender_ms.total | reference_ms |" in page
    assert "| 64 | 1.25 | 3.00 | not run |" in page
    assert "`rfedge bench codec` at `abc123`; C, 2 cores, avx2." in page


def test_training_runs_share_a_table_and_name_their_commands(tmp_path: Path) -> None:
    run = {
        "views": 120,
        "width": 640,
        "height": 360,
        "held_out": {"psnr_db": 28.517, "ssim": None},
        "seconds": 299.6,
        "iterations": 5000,
        "primitives": 250_000,
        "bytes": 5_040_000,
        "command": "rfedge train street --minutes 5",
        "revision": "abc123",
    }
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "street.json").write_text(json.dumps(run))
    page = results_page(tmp_path)
    assert "| street | 120 | 640x360 | 28.52 | - | 300 | 5000 | 250000 | 5.0 |" in page
    assert "* street: `rfedge train street --minutes 5` at `abc123`" in page


def test_a_comparison_names_field_quality_and_interval_beside_its_figure(tmp_path: Path) -> None:
    row = {
        "scene": "yardstick-empty",
        "hz": 10.0,
        "method": "rfedge-veryfast-0123",
        "rival": "x264-lowdelay",
        "rival_setting": "x264-lowdelay-veryfast",
        "window_db": [32.0, 35.0],
        "bd_rate_percent": -57.31,
        "ci95": [-60.04, -54.0],
        "saving_percent_at_db": {"31": 80.2, "33": 55.1, "35": 40.0},
        "ssim": 0.91,
        "rival_ssim": 0.902,
        "psnr_deviation_db": 0.123,
        "rival_psnr_deviation_db": 0.2,
        "first_frame_bytes": 12_340,
        "rival_first_frame_bytes": 40_000,
        "cpu_ms": 90.4,
        "rival_cpu_ms": 19.6,
        "field_psnr_db": 28.123,
    }
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    result = {"case": "compare", "command": "rfedge eval compare", "revision": "abc123"}
    (tmp_path / "compare.json").write_text(json.dumps({**result, "host": host, "rows": [row]}))
    assert (
        "| yardstick-empty | 10 | rfedge-veryfast | x264-lowdelay (x264-lowdelay-veryfast) "
        "| 32..35 | -57.3 | -60.0..-54.0 | 80 / 55 / 40 | 0.910 | 0.902 | 0.12 | 0.20 "
        "| 12.3 | 40.0 | 90 | 20 | 28.12 |"
    ) in results_page(tmp_path)


def test_a_field_that_made_it_worse_stands_out(tmp_path: Path) -> None:
    row = {
        "scene": "yardstick-empty",
        "hz": 30.0,
        "control": "black",
        "at_db": 33.0,
        "bytes": 1100.4,
        "header_bytes": 75.0,
        "rival_bytes": 1000.0,
        "excess_percent": 2.54,
        "excess_percent_psnr_tuned": 9.0,
        "holds": False,
        "references": "previous",
        "cpu_ms": 40.0,
        "rival_cpu_ms": 5.0,
    }
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    result = {"case": "never-worse", "command": "rfedge eval never-worse", "revision": "abc123"}
    (tmp_path / "never-worse.json").write_text(json.dumps({**result, "host": host, "rows": [row]}))
    assert (
        "| yardstick-empty | 30 | black | 33 | 1100 | 75 | 1000 | +2.5 | +9.0 | **no** "
        "| previous | 40 | 5 |"
    ) in results_page(tmp_path)


def test_a_foreign_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"notes\.json is neither"):
        results_page(tmp_path)


def test_a_load_test_names_what_was_not_kept_and_its_command(tmp_path: Path) -> None:
    row = {
        "mode": "receiver",
        "vehicles": 8,
        "hz": 10.0,
        "width": 640,
        "height": 360,
        "held": False,
        "p50_ms": 20.5,
        "p99_ms": None,
        "on_time_percent": 97.25,
        "on_time_at_least_percent": 96.1,
        "fairness": 0.9,
        "limited_by": "server's workers",
        "broken": ["97.25 % on time, below 99 %"],
        "kind": "canned",
        "cameras": 1,
        "payload_bytes": 4123.4,
        "link": None,
        "server_cores": 1.5,
        "server_loop_cores": 0.25,
        "vehicles_cores": 0.1,
        "others_cores": 0.0,
        "command": "rfedge loadtest --mode receiver",
        "revision": "abc123",
    }
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    result = {"case": "loadtest", "command": "rfedge loadtest", "revision": "abc123"}
    (tmp_path / "loadtest.json").write_text(json.dumps({**result, "host": host, "rows": [row]}))
    page = results_page(tmp_path)
    assert "| receiver | 8 | 1 | 10.00 | loopback | no | 20.50 | not run | 97.25 |" in page
    assert "* `rfedge loadtest --mode receiver` at `abc123` (canned vehicles, 640x360" in page
    assert "Not kept: 97.25 % on time, below 99 %." in page
