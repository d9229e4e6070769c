"""An agent that is killed on the way and started again finds itself in the field at once."""

import asyncio
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from lab.localisation.pose_feed import MakeFeed

pytestmark = [pytest.mark.sample, pytest.mark.slow]
SAMPLES = Path(__file__).parents[2] / "samples"
STREET = SAMPLES / "street/transforms_drive_empty.json"
RATE_HZ = 10
FRAMES, KILLED_AT, RESUMED_AT = 20, 4, 9
WITHIN_FRAMES = 3
WAIT_S = 120.0


def drive_from(first: int, folder: Path) -> Path:
    """Write the sample's drive from picture ``first`` on, at the times of the whole one."""
    drive = json.loads(STREET.read_text())
    chosen = list(enumerate(drive["frames"]))[first:FRAMES]
    drive["frames"] = [{**frame, "time": 1000 + n / RATE_HZ} for n, frame in chosen]
    for _, frame in chosen:
        picture = folder / frame["file_path"]
        picture.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(STREET.parent / frame["file_path"], picture)
    (folder / "transforms.json").write_text(json.dumps(drive))
    return folder


def lines_of(report: Path) -> list[dict[str, Any]]:
    """Return the whole lines that are there by now."""
    text = report.read_text() if report.exists() else ""
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


async def start(server: str, store: Path, drive: Path, feed: Path, report: Path, *more: str) -> Any:
    given = {"server": server, "drive": drive, "fields": store, "pose-feed": f"file:{feed}"}
    given |= {"pace": "lockstep", "effort": "fast", "report": report}
    arguments = [part for name, value in given.items() for part in (f"--{name}", str(value))]
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "cav_agent", "--localise", *arguments, *more
    )


async def reported(agent: Any, report: Path, count: int) -> None:
    """Wait until an agent has reported so many frames."""
    async with asyncio.timeout(WAIT_S):
        while len(lines_of(report)) < count:
            assert agent.returncode is None, "it ended before"
            await asyncio.sleep(0.01)


async def test_killed_and_started_again_it_uses_the_field_within_three_frames(
    serve: Any, tmp_path: Path
) -> None:
    """Nothing of the first life is left but the feed, which is metres off: nothing tells the
    second one where it is but a search from there."""
    store, feed = tmp_path / "store", tmp_path / "feed.txt"
    store.mkdir()
    shutil.copyfile(SAMPLES / "fields/street.rff", store / "street.rff")
    whole = drive_from(0, tmp_path / "whole")
    rest = drive_from(RESUMED_AT, tmp_path / "rest")
    MakeFeed(whole, str(feed), store / "street.rff", form="xyz", errors="gnss").run()
    reports = [tmp_path / "first.jsonl", tmp_path / "second.jsonl"]
    async with serve(fields=store) as server:
        first = await start(str(server.address), store, whole, feed, reports[0], "--loop")
        await reported(first, reports[0], KILLED_AT)
        first.kill()
        assert await first.wait() == -9
        second = await start(str(server.address), store, rest, feed, reports[1])
        assert await asyncio.wait_for(second.wait(), WAIT_S) == 0
    assert "tracking" in {line["pose"]["state"] for line in lines_of(reports[0])}
    lines = lines_of(reports[1])
    assert len(lines) == FRAMES - RESUMED_AT
    assert {line["result"] for line in lines} == {"acked"}
    assert all(line["server_digest"] == line["reconstruction_digest"] for line in lines)
    for line in lines[WITHIN_FRAMES - 1 :]:
        assert line["pose"]["state"] == "tracking"
        assert "render" in line["references"]
