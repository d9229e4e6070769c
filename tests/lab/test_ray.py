"""Report of a run on Ray: its workers, the times of its jobs, and the overhead."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lab.servers.cases import RayTiles
from lab.servers.ray import TileRun, overhead_percent, ray_case, require_resumed
from rfcore.errors import InvalidInput, RfedgeError

RUN = TileRun(
    lines=(
        "Ray at local: 2 cores, 3.0 GiB on 1 machines",
        "tile-0-0, process 11: 5%: 75 iterations",
        "tile-1-0, process 12: 5%: 75 iterations",
        "tile-0-0, process 13: going on after iteration 1,050, 1 s",
        "tile-0-0, process 13: 100%: 1,500 iterations",
        "tile-1-0, process 12: ended after 4.50 s",
        "tile-1-0: done",
        "tile-0-0, process 13: ended after 5.25 s",
        "tile-0-0: done",
    ),
    times_s=(10.0, 11.0, 11.0, 12.0, 15.0, 15.5, 15.5, 16.0, 16.5),
    killed=1,
)


def test_a_runs_lines_say_how_long_and_where_it_worked():
    assert RUN.cores == 2
    assert RUN.work_s == (4.5, 5.25)
    assert RUN.seconds == 6.0
    assert RUN.workers_of("tile-0-0") == {11, 13}
    assert RUN.workers_of("tile-1-0") == {12}
    assert RUN.resumed_after("tile-0-0") == (1050,)
    assert RUN.resumed_after("tile-1-0") == ()


@pytest.mark.parametrize(
    "run",
    [
        replace(RUN, killed=0),
        replace(RUN, lines=(*RUN.lines[:3], *RUN.lines[4:])),
        replace(RUN, lines=tuple(line.replace("1,050", "0") for line in RUN.lines)),
        replace(RUN, lines=tuple(line.replace("process 11", "process 13") for line in RUN.lines)),
    ],
    ids=["not killed", "begun anew", "from the beginning", "one worker"],
)
def test_a_tile_that_did_not_go_on_in_another_worker_is_an_error(run):
    require_resumed(RUN, "tile-0-0")
    with pytest.raises(RfedgeError, match="workers of tile-0-0 were killed at 50 %"):
        require_resumed(run, "tile-0-0")


def test_a_run_without_ray_has_no_cores():
    with pytest.raises(RfedgeError, match="of no Ray"):
        TileRun(RUN.lines[1:], RUN.times_s[1:], 0).cores  # noqa: B018


@pytest.mark.parametrize(
    ("seconds", "work_s", "workers", "percent"),
    [
        (10.0, (10.0,), 1, 0),
        (10.5, (10.0,), 4, 5),
        (20.0, (10.0, 10.0, 10.0), 2, 0),
        (33.0, (10.0, 10.0, 10.0), 1, 10),
        (12.0, (10.0, 4.0, 6.0), 2, 20),
    ],
)
def test_overhead_is_what_comes_on_top_of_workers_that_are_never_idle(
    seconds, work_s, workers, percent
):
    assert overhead_percent(seconds, work_s, workers) == pytest.approx(percent)


def test_no_work_has_no_overhead():
    with pytest.raises(InvalidInput, match="0 jobs on 2 workers"):
        overhead_percent(1.0, (), 2)
    with pytest.raises(InvalidInput, match="1 jobs on 0 workers"):
        overhead_percent(1.0, (1.0,), 0)


def test_a_folder_without_tiles_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(InvalidInput, match=r"ray_tiles: .* has no tiles\.json"):
        ray_case(tmp_path, 100)


def write_list(folder: Path, tiles: int) -> None:
    listed = [
        {"id": f"tile-{i}-0", "area_m": [i, 0, i + 1, 1], "margin_m": 0.1, "neighbours": [],
         "tile_origin_m": [0, 0, 0], "pictures": [i]}
        for i in range(tiles)
    ]  # fmt: skip
    (folder / "tiles.json").write_text(json.dumps({"tiles": listed}))


def test_fewer_than_three_tiles_or_ten_iterations_are_refused(tmp_path):
    write_list(tmp_path, 2)
    with pytest.raises(InvalidInput, match="has 2 tiles, the case takes 3"):
        ray_case(tmp_path, 100)
    write_list(tmp_path, 3)
    with pytest.raises(InvalidInput, match="ray_iterations: 9 must be at least 10"):
        ray_case(tmp_path, 9)


def test_the_rows_say_which_tiles_they_are_of(tmp_path, monkeypatch):
    """Training is replaced by files and the lines of a run."""
    write_list(tmp_path, 3)
    asked = []

    def train(tiles: Path, out: Path, options: Any, ray: str | None, kill_at: Any = None) -> Any:
        asked.append((tiles, out.name, options[-1], ray, kill_at))
        out.mkdir(parents=True)
        (out / "tile-0-0.rff").write_bytes(b"other" if out.name == "on-ray" else b"same")
        return RUN

    monkeypatch.setattr("lab.servers.ray.train_tiles", train)
    measured = ray_case(tmp_path, 600)(SimpleNamespace(work=tmp_path / "work"))
    assert asked == [
        (tmp_path, "alone", "60", None, None),
        (tmp_path, "on-ray", "60", "local", None),
        (tmp_path, "killed", "60", "local", "tile-0-0"),
    ]
    assert [(row.measured, row.held) for row in measured.rows[:2]] == [(1, False), (0, True)]
    digest = hashlib.sha256((tmp_path / "tiles.json").read_bytes()).hexdigest()
    assert measured.ray == (RayTiles(3, digest, 600),)
