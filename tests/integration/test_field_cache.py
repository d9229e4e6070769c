"""Fields on the vehicle: prepared once, shared by the tiles of one field, and tried again."""

import asyncio
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry

from cav_agent.config import AgentConfig
from cav_agent.field_cache import MAX_PREPARED, FieldCache, read_drive
from cav_agent.frame_log import DriveObserver
from cav_agent.handover import ServedTile
from cav_agent.metrics import AgentMetrics
from cav_agent.server_connection import server_connections
from rfcore.camera import TileOrigin
from rfcore.codec.h264.config import CoderSettings
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import FieldMetadata, FieldStore, SplatField, save_field
from rfcore.wire.tiles import Tile


@pytest.fixture
def config(street: Any) -> AgentConfig:
    """Nobody listens at the server's address: what is not in the store cannot be fetched."""
    config = AgentConfig(
        "127.0.0.1:1", street.drive, street.store, coding=CoderSettings(effort="fast")
    )
    return replace(config, limits=replace(config.limits, give_up_s=0.05))


def cache_of(config: AgentConfig) -> FieldCache:
    servers = server_connections(config)
    addresses = [server.address for server in servers]
    observer = DriveObserver(AgentMetrics(CollectorRegistry()), addresses)
    return FieldCache(config, servers, observer)


def served(field_id: str, name: str = "street") -> ServedTile:
    return ServedTile(0, Tile(name, field_id))


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


async def test_a_field_that_is_here_needs_no_server(street: Any, config: AgentConfig) -> None:
    prepared = await cache_of(config).prepared(served(street.field_id))
    assert prepared.rungs.current.effort == "fast"


async def test_a_failure_is_not_kept(street: Any, config: AgentConfig, tmp_path: Path) -> None:
    config = replace(config, fields=tmp_path)
    servers = server_connections(config)
    observer = DriveObserver(AgentMetrics(CollectorRegistry()), [s.address for s in servers])
    cache = FieldCache(config, servers, observer)
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
    here, there = read_drive(config, TileOrigin()), read_drive(config, origin)
    for a, b in zip(here, there, strict=True):
        at_a, at_b = (p.camera.world_from_cam.translation_m for p in (a, b))
        moved = [x - y for x, y in zip(at_a, at_b, strict=True)]
        assert moved == pytest.approx([2.0, -1.0, 0.5], abs=1e-6)
        assert b.camera.world_from_cam == b.camera.world_from_cam.rounded()


def test_a_drive_of_two_cameras_is_refused_with_the_picture_named(
    street: Any, config: AgentConfig, tmp_path: Path
) -> None:
    drive = shutil.copytree(street.drive, tmp_path / "drive")
    description = json.loads((drive / "transforms.json").read_text())
    description["frames"][3]["fl_x"] = 61.0
    (drive / "transforms.json").write_text(json.dumps(description))
    with pytest.raises(InvalidInput, match=r"003\.png has other intrinsics than .*000\.png"):
        read_drive(replace(config, drive=drive), TileOrigin())
