"""What a run on Ray told: its workers, its jobs' own times, and what was added to them."""

from pathlib import Path

import pytest

from rfcore.errors import InvalidInput, RfedgeError
from rfedge.loadtest.ray import TileRun, overhead_percent, ray_case

RUN = TileRun(
    lines=(
        "Ray at local: 2 cores, 3.0 GiB on 1 machines",
        "tile-0-0, process 11: 5%: 75 iterations",
        "tile-1-0, process 12: 5%: 75 iterations",
        "tile-0-0, process 13: going on after iteration 60, 1 s",
        "tile-0-0, process 13: 100%: 1,500 iterations",
        "tile-1-0, process 12: ended after 4.50 s",
        "tile-1-0: done",
        "tile-0-0, process 13: ended after 5.25 s",
        "tile-0-0: done",
    ),
    times_s=(10.0, 11.0, 11.0, 12.0, 15.0, 15.5, 15.5, 16.0, 16.5),
    killed=1,
)


def test_a_runs_lines_say_how_long_and_where_it_worked() -> None:
    assert RUN.cores == 2
    assert RUN.work_s == (4.5, 5.25)
    assert RUN.seconds == 6.0
    assert RUN.workers_of("tile-0-0") == {11, 13}
    assert RUN.workers_of("tile-1-0") == {12}


def test_a_run_without_ray_has_no_cores() -> None:
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
    seconds: float, work_s: tuple[float, ...], workers: int, percent: float
) -> None:
    assert overhead_percent(seconds, work_s, workers) == pytest.approx(percent)


def test_no_work_has_no_overhead() -> None:
    with pytest.raises(InvalidInput, match="0 jobs on 2 workers"):
        overhead_percent(1.0, (), 2)
    with pytest.raises(InvalidInput, match="1 jobs on 0 workers"):
        overhead_percent(1.0, (1.0,), 0)


def test_a_folder_without_tiles_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"ray_tiles: .* has no tiles\.json"):
        ray_case(tmp_path, 100)
