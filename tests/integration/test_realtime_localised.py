"""Frames at 10 Hz in real time while the pose is searched: real processes, times reported.

``pytest -s`` prints what frames took before and while a search ran beside them. How long that may
be depends on the machine, so only what does not is asserted: no frame waits for a search.
"""

import asyncio
import json
import shutil
import signal
import sys
from pathlib import Path
from statistics import quantiles
from typing import Any

import pytest

from lab.localisation.pose_feed import MakeFeed

pytestmark = [pytest.mark.sample, pytest.mark.slow]
SAMPLES = Path(__file__).parents[2] / "samples"
DRIVE = SAMPLES / "street/transforms_drive_empty.json"
FIXES_MISSING = 6
"""The feed begins so many frames late: those are coded without the field and without a search."""
SENDER_STAGES = ("convert", "track", "references", "encode", "closed_loop")
ENOUGH_FRAMES = 20
"""While a search runs: on a busy machine it may take any time to end."""
WAIT_S = 120.0


def lines_of(report: Path) -> list[dict[str, Any]]:
    """Return the whole lines that are there by now."""
    text = report.read_text() if report.exists() else ""
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


def coded(lines: list[dict[str, Any]], state: str) -> list[dict[str, Any]]:
    """Return the frames that were coded and answered in a state of the pose."""
    return [
        line
        for line in lines
        if line["result"] == "acked" and line["pose"] and line["pose"]["state"] == state
    ]


def is_enough(lines: list[dict[str, Any]]) -> bool:
    """Tell whether a search has begun, and has led to a pose or taken long."""
    searching = len(coded(lines, "localising"))
    return searching >= ENOUGH_FRAMES or bool(searching and coded(lines, "tracking"))


def in_words(name: str, lines: list[dict[str, Any]]) -> str:
    """Return p50 and p99 of the encoder's time and of the delay to the Ack."""
    if len(lines) < 2:
        return f"{name}: {len(lines)} frames"
    coding_ms = [sum(line["stage_ms"][stage] for stage in SENDER_STAGES) for line in lines]
    parts = [
        quantiles(each, n=100, method="inclusive")
        for each in (coding_ms, [line["latency_ms"] for line in lines])
    ]
    coding, delay = (f"p50 {part[49]:.0f} p99 {part[98]:.0f} ms" for part in parts)
    return f"{name}: {len(lines)} frames, coding {coding}, to the Ack {delay}"


async def test_while_the_pose_is_searched_frames_go_on_without_the_field(
    serve: Any, tmp_path: Path
) -> None:
    store, feed, report = (tmp_path / name for name in ("store", "feed.txt", "report.jsonl"))
    store.mkdir()
    shutil.copyfile(SAMPLES / "fields/street.rff", store / "street.rff")
    MakeFeed(DRIVE, str(feed), store / "street.rff", form="xyz", errors="white-large").run()
    feed.write_text("".join(feed.read_text().splitlines(keepends=True)[FIXES_MISSING:]))
    given = {"drive": DRIVE, "fields": store, "pose-feed": f"file:{feed}"}
    given |= {"rate": 10, "report": report}
    arguments = [part for name, value in given.items() for part in (f"--{name}", str(value))]
    async with serve(fields=store) as server:
        agent = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "cav_agent", "--server", str(server.address)),
            *("--localise", "--loop", *arguments),
        )
        async with asyncio.timeout(WAIT_S):
            while not is_enough(lines_of(report)):
                assert agent.returncode is None, "it ended before"
                await asyncio.sleep(0.02)
        agent.send_signal(signal.SIGTERM)
        assert await asyncio.wait_for(agent.wait(), WAIT_S) == 0
    lines = lines_of(report)
    lost, searching = coded(lines, "lost"), coded(lines, "localising")
    print("\n" + in_words("before", lost), in_words("searching", searching), sep="\n")
    assert lost, "before the first fix frames are coded"
    assert searching, "the frame a search begins with does not wait for it"
    for line in lost + searching:
        assert "render" not in line["references"]
