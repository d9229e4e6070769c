"""Lists of jobs: what is done is skipped, what fails is named, and does not stop the rest."""

import os
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.files import write_whole
from rfedge import jobs
from rfedge.jobs import RETRIES, Job, Tell, console_of, run_jobs


def write_text(out: Path, text: str, tell: Tell) -> None:
    tell(f"writing\n{len(text)} letters")
    write_whole(out, text)


def refuse(tell: Tell) -> None:
    tell("looking at 3 pictures")
    raise InvalidInput("pictures", "3 are too few")


def break_down(tell: Tell) -> None:
    tell("about to")
    raise ZeroDivisionError("by hand")


def die(deaths: Path, tell: Tell) -> None:  # noqa: ARG001
    with deaths.open("a") as file:
        file.write(f"{os.getpid()}\n")
    os.kill(os.getpid(), signal.SIGKILL)


def forget(tell: Tell) -> None:
    tell("nothing is written")


def job(folder: Path, name: str, text: str = "text") -> Job:
    out = folder / f"{name}.txt"
    return Job(name, partial(write_text, out, text), (out,), f"the text {text!r}", 1, 1 << 20)


def failing(folder: Path, name: str, work: object) -> Job:
    assert callable(work)
    return Job(name, work, (folder / f"{name}.txt",), name, 1, 1 << 20)


def test_what_is_done_is_skipped_and_what_was_made_from_something_else_is_made_again(tmp_path):
    told: list[str] = []
    jobs = [job(tmp_path, "a"), job(tmp_path, "b")]
    assert run_jobs(jobs, told.append) == 0
    written_ns = (tmp_path / "a.txt").stat().st_mtime_ns
    again = [job(tmp_path, "a"), job(tmp_path, "b", "another text")]
    assert run_jobs(again, told.append) == 1
    assert (tmp_path / "a.txt").stat().st_mtime_ns == written_ns
    assert (tmp_path / "b.txt").read_text() == "another text"
    assert "a: done before" in told
    assert run_jobs(again, told.append) == 2


def test_a_file_that_was_removed_is_made_again(tmp_path):
    run_jobs([job(tmp_path, "a")], lambda _: None)
    (tmp_path / "a.txt").unlink()
    assert run_jobs([job(tmp_path, "a")], lambda _: None) == 0
    assert (tmp_path / "a.txt").read_text() == "text"


def test_failures_are_listed_at_the_end_and_stop_nobody(tmp_path):
    told: list[str] = []
    jobs = [
        failing(tmp_path, "bad", refuse),
        failing(tmp_path, "worse", break_down),
        failing(tmp_path, "lazy", forget),
        job(tmp_path, "good"),
    ]
    with pytest.raises(RfedgeError) as raised:
        run_jobs(jobs, told.append)
    lines = str(raised.value).splitlines()
    assert lines[0].startswith("3 of 4 jobs failed")
    assert lines[1] == "  bad: pictures: 3 are too few"
    assert lines[2] == "  worse: ZeroDivisionError: by hand"
    assert lines[3] == f"  lazy: did not write {tmp_path / 'lazy.txt'}"
    assert (tmp_path / "good.txt").read_text() == "text"
    assert told[-1] == "good: done"
    assert any("break_down" in line for line in told), "where an unexpected error came from"
    with pytest.raises(RfedgeError, match=r"^3 of 4 jobs failed"):
        run_jobs(jobs, told.append)
    assert "good: done before" in told


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_on_ray_jobs_that_fail_or_whose_workers_die_are_listed_and_stop_nobody(tmp_path):
    told: list[str] = []
    jobs = [
        failing(tmp_path, "bad", refuse),
        failing(tmp_path, "worse", break_down),
        failing(tmp_path, "dying", partial(die, tmp_path / "deaths")),
        replace(job(tmp_path, "huge"), memory_bytes=1 << 60),
        job(tmp_path, "good"),
    ]
    with pytest.raises(RfedgeError) as raised:
        run_jobs(jobs, told.append, "local")
    first, *failed = str(raised.value).splitlines()
    assert first.startswith("4 of 5 jobs failed")
    said = {name: text for name, _, text in (line.strip().partition(": ") for line in failed)}
    assert said["bad"] == "pictures: 3 are too few"
    assert said["worse"] == "ZeroDivisionError: by hand"
    assert said["dying"].startswith("begun 4 times at most, then given up")
    assert said["huge"].startswith("needs 1 cores and 1073741824.0 GiB on one machine")
    assert (tmp_path / "good.txt").read_text() == "text"
    assert "good: done" in told
    deaths = (tmp_path / "deaths").read_text().split()
    assert len(set(deaths)) == RETRIES + 1, "each time in another process"


def test_a_job_that_ray_kills_again_and_again_is_given_up(tmp_path, monkeypatch):
    """Ray 2.60 begins what its memory monitor killed without end, whatever ``max_retries`` says."""
    lines = jobs._Lines()
    remote = {name: SimpleNamespace(remote=getattr(lines, name)) for name in ("begin", "add")}
    remote["have_arrived"] = SimpleNamespace(remote=lines.have_arrived)
    monkeypatch.setattr(jobs, "_ray", lambda: SimpleNamespace(get=lambda value: value))
    found = [
        jobs._run_on_worker(job(tmp_path, "greedy"), SimpleNamespace(**remote))
        for _ in range(RETRIES + 2)
    ]
    assert found[:-1] == [None] * (RETRIES + 1)
    assert found[-1].startswith("begun 4 times, each time killed")


def test_a_ray_that_nobody_runs_is_an_error_at_once(tmp_path, free_port):
    address = f"127.0.0.1:{free_port}"
    with pytest.raises(RfedgeError, match=f"^no Ray at {address}: Connection refused; give the"):
        run_jobs([job(tmp_path, "a")], print, address)
    with pytest.raises(InvalidInput, match=r"^ray: .*must be HOST:PORT"):
        run_jobs([job(tmp_path, "a")], print, "ray://:")


def test_a_job_that_fails_is_no_longer_taken_for_done(tmp_path):
    good = job(tmp_path, "a")
    run_jobs([good], lambda _: None)
    bad = Job("a", refuse, good.outputs, "another text", 1, 1 << 20)
    with pytest.raises(RfedgeError):
        run_jobs([bad], lambda _: None)
    assert not good.is_done


def test_two_jobs_of_one_name_no_output_and_no_core_are_refused(tmp_path):
    with pytest.raises(InvalidInput, match="more than one is named a"):
        run_jobs([job(tmp_path, "a"), job(tmp_path, "a")], lambda _: None)
    with pytest.raises(InvalidInput, match="job a makes no file"):
        Job("a", refuse, (), "", 1, 0)
    with pytest.raises(InvalidInput, match="0 of job a must be at least 1"):
        Job("a", refuse, (tmp_path / "a",), "", 0, 0)


def test_a_consoles_lines_are_told_whole_and_without_colours():
    told: list[str] = []
    console = console_of(told.append)
    console.print("[bold]Training[/] a tile", end="")
    assert told == []
    console.print(", 3 pictures\nnext")
    assert told == ["Training a tile, 3 pictures", "next"]
