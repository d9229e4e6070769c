"""A vehicle that takes its poses from a feed: real files, a real gpsd's words, a real server."""

import asyncio
import json
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from cav_agent.config import PaceKind
from cav_agent.pose_feed.sources import PoseFeedSettings
from lab.localisation.pose_errors import PoseErrorModel
from lab.localisation.pose_feed import FeedPlan, feed_lines, times_of
from recorded import recorded
from rfcore.dataset import read_dataset
from rfcore.field.store import anchored_file
from rfcore.geodesy import Anchor


def write_feed(street: Any, out: Path, errors: PoseErrorModel) -> list[Any]:
    """Write the drive's poses as a recorded feed; return the pictures."""
    pictures = read_dataset(street.drive).pictures
    poses = [picture.camera.world_from_cam for picture in pictures]
    plan = FeedPlan("xyz", errors, 0.0)
    out.write_text("".join(text for _, text in feed_lines(poses, times_of(pictures, 10.0), plan)))
    return list(pictures)


def sent_m(saved: Path) -> list[tuple[float, float, float]]:
    """Return the positions that the server got."""
    poses = [picture.world_from_cam for picture in recorded(saved)]
    return [pose.translation_m for pose in poses if pose is not None]


async def test_a_recorded_feed_replaces_the_poses_of_the_drive(
    street: Any, serve: Any, travel: Any, tmp_path: Path
) -> None:
    feed = tmp_path / "feed.jsonl"
    pictures = write_feed(street, feed, PoseErrorModel(offset_m=0.3))
    settings = PoseFeedSettings(pose_feed=f"file:{feed}")
    async with serve(record=tmp_path / "saved") as server:
        record = await travel(server.address, feed=settings)
    assert record.counts == {"acked": 6}
    for position_m, picture in zip(sent_m(tmp_path / "saved"), pictures, strict=True):
        off_m = math.dist(position_m, picture.camera.world_from_cam.translation_m)
        assert off_m == pytest.approx(0.3, abs=1e-3)  # four decimals of metres, float32


@asynccontextmanager
async def gpsd(*places: tuple[float, float]) -> AsyncIterator[int]:
    """A gpsd on a port of its own that reports the places in turn, and then the last for ever."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.add(asyncio.current_task())
        await reader.readline()
        number = 0
        try:
            while True:
                latitude, longitude = places[min(number, len(places) - 1)]
                now = datetime.now(UTC).isoformat(timespec="milliseconds")
                tpv = {"class": "TPV", "mode": 3, "time": now, "lat": latitude, "lon": longitude}
                att = {"class": "ATT", "time": now, "heading": 90.0}
                for report in (att, {**tpv, "altHAE": 519.0}):
                    writer.write(json.dumps(report).encode() + b"\n")
                await writer.drain()
                number += 1
                await asyncio.sleep(0.05)
        except (ConnectionError, asyncio.CancelledError):
            pass
        finally:
            writer.close()

    serving: set[Any] = set()
    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for task in serving:
            task.cancel()
        await asyncio.gather(*serving, return_exceptions=True)


@pytest.fixture
def anchored(street: Any, tmp_path: Path) -> tuple[Path, str]:
    """A store with the street's field on the Earth, and its id."""
    store = tmp_path / "anchored"
    anchor = Anchor(48.137, 11.575, 519.0)
    return store, anchored_file(street.store / "street.rff", anchor, store / "street.rff")


async def test_a_live_feed_of_gpsd_gives_the_poses_in_the_anchored_field(
    serve: Any, vehicle: Any, anchored: tuple[Path, str], tmp_path: Path
) -> None:
    store, field_id = anchored
    saved = tmp_path / "saved"
    async with gpsd((48.137, 11.575)) as port, serve(fields=store, record=saved) as server:
        live: dict[str, Any] = {
            "feed": PoseFeedSettings(pose_feed=f"gpsd:127.0.0.1:{port}", camera_at=(1.0, 0.0, 2.0)),
            "pace": PaceKind.REALTIME,
            "rate": 20.0,
            "loop": True,
            "field": field_id,
            "fields": store,
        }
        async with vehicle(server.address, **live) as driving:
            await driving.until(lambda: driving.acked() >= 5)
    for position_m in sent_m(saved)[:5]:
        # the antenna at the origin, heading east: the camera is 1 m ahead of it and 2 m above
        assert position_m == pytest.approx([1.0, 0.0, 2.0], abs=1e-3)


async def test_a_live_feed_for_a_field_without_an_anchor_is_told_and_nothing_is_coded(
    serve: Any, vehicle: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    async with gpsd((48.137, 11.575)) as port, serve() as server:
        settings = PoseFeedSettings(pose_feed=f"gpsd:127.0.0.1:{port}")
        live: dict[str, Any] = {"feed": settings, "pace": PaceKind.REALTIME, "loop": True}
        async with vehicle(server.address, **live) as driving:
            await driving.until(lambda: len(driving.lines()) >= 3)
    assert {line["reason"] for line in driving.lines()} <= {"not_coded", "superseded", "stopping"}
    assert "rfedge field anchor" in capsys.readouterr().out
