"""Fields on the vehicle: prepared once, shared by the tiles of one field, and tried again."""

import asyncio
import json
import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client import CollectorRegistry
from structlog.testing import capture_logs

from cav_agent.cameras import instant_numbers, recorded_cameras
from cav_agent.config import AgentConfig
from cav_agent.field_cache import MAX_PREPARED, FieldCache
from cav_agent.frame_log import DriveObserver
from cav_agent.handover import ServedTile
from cav_agent.metrics import AgentMetrics
from cav_agent.server_connection import ServerConnection, server_connections
from mec_server.fields.service import CHUNK_BYTES, read_chunk
from rfcore.camera import Camera, TileOrigin
from rfcore.codec.h264.config import CoderSettings
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import FieldMetadata, FieldStore, SplatField, save_field
from rfcore.field.quality import FULL
from rfcore.image import I420
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.tile_manifest import Ground, VersionLabel, publish
from rfcore.wire.tiles import Tile


@pytest.fixture
def config(street: Any) -> AgentConfig:
    """Nobody listens at the server's address: what is not in the store cannot be fetched."""
    config = AgentConfig(
        "127.0.0.1:1", street.drive, street.store, coding=CoderSettings(effort="fast")
    )
    return replace(config, limits=replace(config.limits, give_up_s=0.05))


def cache_and_connections(config: AgentConfig) -> tuple[FieldCache, Sequence[ServerConnection]]:
    servers = server_connections(config)
    addresses = [server.address for server in servers]
    observer = DriveObserver(AgentMetrics(CollectorRegistry()), addresses)
    return FieldCache(config, servers, observer), servers


def cache_of(config: AgentConfig) -> FieldCache:
    return cache_and_connections(config)[0]


def served(field_id: str, name: str = "street") -> ServedTile:
    return ServedTile(0, Tile(name, field_id))


def camera_at(config: AgentConfig, origin: TileOrigin, index: int) -> Camera:
    """Return the camera of a picture of the drive, as it is coded."""
    (capture,) = recorded_cameras(config, origin, instant_numbers(config)).take(index)
    return capture.picture.camera


async def test_tiles_of_one_field_share_what_is_prepared(street: Any, config: AgentConfig) -> None:
    cache = cache_of(config)
    west, east = await asyncio.gather(
        cache.prepared(served(street.field_id, "west")),
        cache.prepared(served(street.field_id, "east")),
    )
    assert west is east
    assert west.field.field_id == street.field_id
    assert west.cameras[0].codec.size_px == (76, 52)
    assert len(west.pictures) == 6


@pytest.mark.parametrize(("east_m", "is_warned_of"), [(0.0, False), (3.0, True), (500.0, True)])
async def test_a_field_of_another_place_is_warned_of_once_it_is_there(
    street: Any, config: AgentConfig, tmp_path: Path, east_m: float, is_warned_of: bool
) -> None:
    splats = street.field.gaussians
    moved = SplatField(replace(splats, means=splats.means + np.float32([east_m, 0.0, 0.0])))
    field_id = save_field(moved, tmp_path / "moved.rff")
    cache = cache_of(replace(config, fields=tmp_path))
    with capture_logs() as logs:
        await cache.prepared(served(field_id))
        while cache._background:
            await asyncio.sleep(0.001)
    problems = [line["problem"] for line in logs if line["event"] == "field of another place"]
    assert len(problems) == is_warned_of
    assert all(f"rfedge field check {tmp_path / field_id}.rff --drive" in p for p in problems)


async def test_a_failure_is_not_kept(street: Any, config: AgentConfig, tmp_path: Path) -> None:
    config = replace(config, fields=tmp_path)
    cache, servers = cache_and_connections(config)
    async with servers[0]:
        with pytest.raises(RfedgeError, match=r"no server at 127\.0\.0\.1:1 within 0\.05 s"):
            await cache.prepared(served(street.field_id))
        FieldStore(tmp_path).add(street.store / "street.rff", street.field_id)
        prepared = await cache.prepared(served(street.field_id))
    assert prepared.field.field_id == street.field_id


async def test_the_last_fields_are_kept_and_older_ones_are_let_go(
    street: Any, config: AgentConfig, tmp_path: Path
) -> None:
    ids = []
    for number in range(MAX_PREPARED + 1):
        field = SplatField(street.field.gaussians, FieldMetadata(f"version {number}"))
        ids.append(save_field(field, tmp_path / f"{number}.rff"))
    cache = cache_of(replace(config, fields=tmp_path))
    first, *others = [await cache.prepared(served(field_id)) for field_id in ids]
    assert [await cache.prepared(served(field_id)) for field_id in ids[1:]] == others
    again = await cache.prepared(served(ids[0]))
    assert again is not first
    assert again.field.field_id == first.field.field_id


async def test_what_is_being_prepared_is_stopped_when_the_cache_is_closed(
    street: Any, config: AgentConfig
) -> None:
    cache = cache_of(config)
    waiting = asyncio.create_task(cache.prepared(served(street.field_id)))
    await asyncio.sleep(0)
    await cache.close()
    with pytest.raises(asyncio.CancelledError):
        await waiting


def test_pictures_are_posed_in_their_tile_and_rounded_as_on_the_wire(config: AgentConfig) -> None:
    origin = TileOrigin(2.0, -1.0, 0.5)
    for index in range(6):
        here, there = (camera_at(config, at, index) for at in (TileOrigin(), origin))
        a_m, b_m = here.world_from_cam.translation_m, there.world_from_cam.translation_m
        moved = [a - b for a, b in zip(a_m, b_m, strict=True)]
        assert moved == pytest.approx([2.0, -1.0, 0.5], abs=1e-6)
        assert there == there.rounded()


def test_a_drive_of_two_cameras_is_refused_with_the_picture_named(
    street: Any, config: AgentConfig, tmp_path: Path
) -> None:
    drive = shutil.copytree(street.drive, tmp_path / "drive")
    description = json.loads((drive / "transforms.json").read_text())
    description["frames"][3]["fl_x"] = 61.0
    (drive / "transforms.json").write_text(json.dumps(description))
    with pytest.raises(InvalidInput, match=r"003\.png has other intrinsics than .*000\.png"):
        camera_at(replace(config, drive=drive), TileOrigin(), 0)


class BreakingRelay:
    """Hands bytes on between a vehicle and a server; breaks connections when told to."""

    def __init__(self) -> None:
        self._writers: list[asyncio.StreamWriter] = []

    @asynccontextmanager
    async def to(self, port: int) -> AsyncIterator[int]:
        """Listen on a free port, which is returned, for connections to the server at ``port``."""

        async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            there_reader, there_writer = await asyncio.open_connection("127.0.0.1", port)
            self._writers += [writer, there_writer]
            await asyncio.gather(_pumped(reader, there_writer), _pumped(there_reader, writer))

        listening = await asyncio.start_server(connected, "127.0.0.1", 0)
        async with listening:
            yield int(listening.sockets[0].getsockname()[1])
            self.break_connections()

    def break_connections(self) -> None:
        """Close every connection there is at once; others may be made."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()


async def _pumped(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass  # the other end is gone
    finally:
        writer.transport.abort()


def dark_field(field: SplatField) -> SplatField:
    """The splats of a field many times over, in another light: an archive of several chunks."""
    arrays = {
        name: np.repeat(getattr(field.gaussians, name), 10, axis=0)
        for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    }
    rng = np.random.default_rng(5)
    arrays["means"] = arrays["means"] + rng.normal(0, 0.1, arrays["means"].shape)
    arrays["sh"] = arrays["sh"] * 0.3 - 0.5
    return SplatField(Gaussians(**{n: a.astype(np.float32) for n, a in arrays.items()}))


async def test_a_light_goes_on_where_its_transfer_broke(
    street: Any, serve: Any, config: AgentConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, mine, now = tmp_path / "fields", tmp_path / "mine", datetime(2026, 1, 1, tzinfo=UTC)
    folder.mkdir()
    dusk_id = save_field(dark_field(street.field), tmp_path / "dusk.rff")
    publish(folder, "west", street.store / "street.rff", Ground(), now)
    tile = publish(folder, "west", tmp_path / "dusk.rff", Ground(), now, VersionLabel("dusk"))
    relay, loop = BreakingRelay(), asyncio.get_running_loop()
    offsets: list[int] = []

    async def break_once_some_arrived() -> None:
        partial = mine / f".{dusk_id}.part"
        while not partial.exists() or partial.stat().st_size < CHUNK_BYTES:
            await asyncio.sleep(0.001)
        relay.break_connections()

    def noted_chunk(path: Path, offset_bytes: int) -> bytes:
        if path.stem == dusk_id:
            offsets.append(offset_bytes)
            if offsets == [0, CHUNK_BYTES, 2 * CHUNK_BYTES]:
                asyncio.run_coroutine_threadsafe(break_once_some_arrived(), loop).result(20)
        return read_chunk(path, offset_bytes)

    monkeypatch.setattr("mec_server.fields.service.read_chunk", noted_chunk)
    async with (
        serve(fields=folder) as server,
        relay.to(server.address.port) as port,
        asyncio.timeout(30),
    ):
        config = replace(config, server=f"127.0.0.1:{port}", fields=mine)
        config = replace(config, limits=replace(config.limits, give_up_s=10.0))
        cache, (connection,) = cache_and_connections(config)
        async with connection:
            lights = (await cache.prepared(ServedTile(0, tile))).lights
            black = I420(np.full((52, 76), 16, np.uint8), *[np.full((26, 38), 128, np.uint8)] * 2)
            lights.view(black, camera_at(config, TileOrigin(), 0), FULL)
            while dusk_id not in lights.held_ids():
                await asyncio.sleep(0.001)
            await cache.close()
    resumed = offsets[3]
    assert 0 < resumed <= 2 * CHUNK_BYTES
    assert offsets[3:5] == [resumed, resumed + CHUNK_BYTES]
    assert FieldStore(mine).path(dusk_id).read_bytes() == (tmp_path / "dusk.rff").read_bytes()
