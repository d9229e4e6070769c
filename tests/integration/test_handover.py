"""A vehicle passes from one roadside server to the next: two server processes, one vehicle.

The two hold the same street as two archives whose tiles have different origins, so the poses on
the wire are not the same numbers. Late is a picture that was dropped or lost, or sent in vain.
"""

import asyncio
import itertools
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cav_agent.config import AgentLimits, PaceKind
from mec_server.fields.service import read_chunk
from recorded import recorded
from rfcore.camera import TileOrigin
from rfcore.dataset.recorded_session import RecordedPicture
from rfcore.field import FieldMetadata, SplatField, save_field
from rfcore.wire.tile_manifest import Ground, publish
from rfcore.wire.tiles import Area
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
)
from rfcore.wire.twin_client import AsyncTwinClient
from rfedge.processes import command_of, service

BORDER_M = 0.25
"""The drive is at 0.0, 0.1 ... 0.5 m east: pictures 0 to 2 belong to the west."""

WEST = Ground(Area((-5.0, -5.0), (BORDER_M, 5.0)), 0.1)
EAST = Ground(Area((BORDER_M, -5.0), (5.0, 5.0)), 0.1)
EVERYWHERE = Ground(Area((-5.0, -5.0), (5.0, 5.0)), 0.0)


@dataclass
class Roadside:
    """A server process, where it listens and where its pictures go."""

    process: subprocess.Popen[bytes]
    address: str
    saved: Path

    def pictures(self) -> list[RecordedPicture]:
        """Return what was reconstructed, in order."""
        return recorded(self.saved)


def moved(field: SplatField, origin: TileOrigin) -> SplatField:
    """Return the field as the tile with this origin holds it."""
    offset_m = np.array([origin.east_m, origin.north_m, origin.up_m])
    means = (field.gaussians.means - offset_m).astype(np.float32)
    metadata = FieldMetadata("tile", tile_origin=origin)
    return SplatField(replace(field.gaussians, means=means), metadata)


@pytest.fixture
def roadside(street: Any, tmp_path: Path) -> Iterator[Callable[..., Roadside]]:
    """Return what starts a server for one tile, as a process."""
    with ExitStack() as stack:

        def start(name: str, ground: Ground, *origin_m: float) -> Roadside:
            folder, archive, saved = (tmp_path / f"{name}{end}" for end in ("", ".rff", "-saved"))
            folder.mkdir()
            save_field(moved(street.field, TileOrigin(*origin_m)), archive)
            publish(folder, name, archive, ground, datetime(2026, 1, 1, tzinfo=UTC))
            command = [*command_of("mec-server"), "--fields", str(folder), "--record", str(saved)]
            running = service(name, [*command, "--listen", "127.0.0.1:0"], tmp_path)
            server = stack.enter_context(running)
            return Roadside(server.process, server.address, saved)

        yield start


async def seen_at(address: str, seen: list[TwinPicture | Departure]) -> None:
    """Collect what a consumer of one server's twin sees."""
    async with AsyncTwinClient(address) as client:
        async for message in client.watch(Subscription(encoding=PictureEncoding.NONE)):
            seen.append(message)  # noqa: PERF401 - it is read while it grows


def stays_ns(seen: list[TwinPicture | Departure]) -> list[tuple[int, int]]:
    """Return the capture times of the first and the last picture that each stream brought."""
    streams: dict[str, list[int]] = {}
    for entry in seen:
        if isinstance(entry, TwinPicture):
            streams.setdefault(entry.session_id, []).append(entry.capture_time_ns)
    return [(min(times), max(times)) for times in streams.values()]


async def test_a_vehicle_crosses_without_a_late_picture_or_a_keyframe(
    roadside: Any, vehicle: Any, tmp_path: Path
) -> None:
    """A server that is slow because its machine is busy must not count as one that stalls."""
    a = roadside("west", WEST, 0.0)
    b = roadside("east", EAST, 2.0, -1.0, 0.5)
    at_a: list[TwinPicture | Departure] = []
    at_b: list[TwinPicture | Departure] = []
    watching = [
        asyncio.create_task(seen_at(a.address, at_a)),
        asyncio.create_task(seen_at(b.address, at_b)),
    ]
    async with vehicle(
        a.address, neighbours=(b.address,), fields=tmp_path / "mine", loop=True,
        limits=AgentLimits(answer_s=60.0, stall_s=60.0),
    ) as driving:  # fmt: skip
        await driving.until(lambda: driving.handovers("tile") >= 5)
        lines = driving.lines()  # a picture may wait when the drive is stopped, and is dropped
    late = [line for line in lines if line["result"] != "acked"]
    assert late == [], "dropped, lost or sent in vain"
    for line in lines:
        assert line["server_digest"] == line["reconstruction_digest"], "the same bytes at both ends"
        assert "render" in line["references"], "never a keyframe"
    indices = [line["index"] for line in lines]
    assert indices == [i % 6 for i in range(len(lines))], "none missing, none twice"
    async with asyncio.timeout(30):
        while len(a.pictures()) + len(b.pictures()) < len(lines):
            await asyncio.sleep(0.05)
        while not all(seen and isinstance(seen[-1], Departure) for seen in (at_a, at_b)):
            await asyncio.sleep(0.05)
    for task in watching:
        task.cancel()
    stays = sorted([*stays_ns(at_a), *stays_ns(at_b)])
    assert len(stays) >= 2, "a consumer may miss pictures, not servers"
    for (_, left_ns), (came_ns, _) in itertools.pairwise(stays):
        assert left_ns < came_ns, "one vehicle: it is brought by one stream at a time"


async def test_a_vehicle_goes_to_the_neighbour_when_its_server_is_killed(
    roadside: Any, vehicle: Any, tmp_path: Path
) -> None:
    a = roadside("west", EVERYWHERE, 0.0)
    b = roadside("east", replace(EAST, margin_m=5.0), 2.0)
    async with vehicle(
        a.address, neighbours=(b.address,), fields=tmp_path / "mine",
        pace=PaceKind.REALTIME, rate=10.0, loop=True,
    ) as driving:  # fmt: skip
        await driving.until(lambda: len(a.pictures()) >= 3)
        a.process.kill()
        await driving.until(lambda: len(b.pictures()) >= 12)
        assert driving.handovers("server_lost") == 1
    for line in driving.lines():
        if line["result"] == "acked":
            assert line["server_digest"] == line["reconstruction_digest"]


async def test_two_tiles_of_one_field_fetch_it_once(
    street: Any, serve: Any, vehicle: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began: list[Path] = []

    def counted_chunk(path: Path, offset_bytes: int) -> bytes:
        began.extend([path] * (offset_bytes == 0))
        return read_chunk(path, offset_bytes)

    monkeypatch.setattr("mec_server.fields.service.read_chunk", counted_chunk)
    archive = street.store / "street.rff"
    for name, ground in (("west", WEST), ("east", EAST)):
        (tmp_path / name).mkdir()
        publish(tmp_path / name, name, archive, ground, datetime(2026, 1, 1, tzinfo=UTC))
    async with (
        serve(fields=tmp_path / "west") as a,
        serve(fields=tmp_path / "east") as b,
        vehicle(
            a.address, neighbours=(str(b.address),), fields=tmp_path / "mine", loop=True
        ) as driving,
    ):
        await driving.until(lambda: driving.handovers("tile") >= 2)
    assert driving.acked() >= 2, "on both sides of the border"
    assert len(began) == 1, "the other server's transfer would be the same bytes"
    assert driving.fields() == {f"{street.field_id}.rff"}
