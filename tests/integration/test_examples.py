"""The examples run; ``tests/lab/test_benchmark.py`` runs those of the benchmark."""

import asyncio
import json
import runpy
import socket
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from cav_agent.pose_feed.json_lines import JsonParser
from cav_agent.pose_feed.sources import PoseFeedSettings
from recorded import recorded
from rfcore.camera import Pose
from rfcore.dataset import read_dataset
from rfedge.cli import parse
from rfedge.samples import sample_path

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
NOW = datetime(2026, 1, 1, tzinfo=UTC)
CAM_FROM_BODY = ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / name))


def write_trajectory(drive: Path, out: Path) -> list[Pose]:
    """Write the drive's vehicle in TUM's form, 10 Hz; return where its camera is."""
    poses = [picture.camera.world_from_cam for picture in read_dataset(drive).pictures]
    lines = []
    for number, pose in enumerate(poses):
        body = pose.compose(Pose.from_matrix(CAM_FROM_BODY))
        w, *xyz = body.rotation
        numbers = (number / 10, *body.translation_m, *xyz, w)
        lines.append(" ".join(f"{value:.9f}" for value in numbers))
    out.write_text("# time x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    return poses


def test_every_example_is_listed() -> None:
    page = (EXAMPLES / "README.md").read_text()
    names = {path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb")}
    assert all(f"`{name}`" in page for name in names)


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    names: dict[str, Any] = {}
    for cell in json.loads((EXAMPLES / "first_hour.ipynb").read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["rate"] == sorted(names["rate"], reverse=True)
    assert names["quality"] == sorted(names["quality"], reverse=True)
    assert names["quality"][0] > 30


async def test_the_twin_consumer_sees_a_drive(serve: Any, vehicle: Any) -> None:
    async with serve() as server:
        consumer = await asyncio.create_subprocess_exec(
            sys.executable, str(EXAMPLES / "twin_consumer.py"), str(server.address),
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert consumer.stdout is not None
        try:
            async with asyncio.timeout(100), vehicle(server.address, loop=True):
                first = await consumer.stdout.readline()
            async with asyncio.timeout(30):
                last = first
                while not last.endswith(b"left\n"):
                    last = await consumer.stdout.readline()
                    assert last, "the consumer ended"
        finally:
            consumer.kill()
            await consumer.communicate()
    assert first.startswith(b"cav-1/front ")
    assert b": at (" in first
    assert last == b"cav-1/front left\n"


async def test_the_pose_feed_drives_a_vehicle(
    street: Any, serve: Any, travel: Any, tmp_path: Path
) -> None:
    poses = write_trajectory(street.drive, tmp_path / "trajectory.txt")
    example("pose_feed.py")["main"](tmp_path / "trajectory.txt", str(tmp_path / "feed.jsonl"))
    feed = PoseFeedSettings(pose_feed=f"file:{tmp_path / 'feed.jsonl'}")
    async with serve(record=tmp_path / "recorded") as server:
        record = await travel(server.address, feed=feed)
    assert record.counts == {"acked": 6}
    for picture, pose in zip(recorded(tmp_path / "recorded"), poses, strict=True):
        assert picture.world_from_cam is not None
        place_m = picture.world_from_cam.translation_m
        assert place_m == pytest.approx(pose.translation_m, abs=0.26e-3), "half a step"
        assert picture.world_from_cam.rotation == pytest.approx(pose.rotation, abs=2**-14)


def test_the_pose_feed_sends_datagrams_at_its_own_pace(street: Any, tmp_path: Path) -> None:
    write_trajectory(street.drive, tmp_path / "trajectory.txt")
    names, pauses = example("pose_feed.py"), []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        lines = names["feed_lines"](tmp_path / "trajectory.txt")
        names["send"](lines, *receiver.getsockname(), sleep=pauses.append)
        said = [receiver.recv(65536).decode() for _ in range(6)]
    assert pauses == pytest.approx([0.0, *[0.1] * 5])
    assert all(JsonParser().receive(line) is not None for line in said)
    assert "time_s" in json.loads(said[0])


def test_an_uplink_is_sized_from_python(capsys: pytest.CaptureFixture[str]) -> None:
    example("size_an_uplink.py")["main"]()
    said = capsys.readouterr().out
    assert said.count("Mbit/s") == 6
    assert "33 dB, rfedge: " in said


@pytest.mark.slow
@pytest.mark.sample
def test_a_codec_of_ones_own_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    drive = f"empty@10={sample_path('street/transforms_drive_empty.json')}"
    out, cells = str(tmp_path / "compare.json"), str(tmp_path / "cells")
    method = "examples.own_codec:MotionJpeg"
    arguments = ("--method", method, "--quick", "--out", out, "--cells", cells)
    parse(["eval", "compare", str(sample_path("fields/street.rff")), drive, *arguments]).run()
    result = json.loads(Path(out).read_text())
    assert "motion-jpeg" in Path(out).read_text()
    assert result["kind"] == "compare"
