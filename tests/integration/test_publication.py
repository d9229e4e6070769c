"""A running server takes up what is published; its vehicles go over without losing a picture."""

import asyncio
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from rfcore.field import FieldStore
from rfcore.wire.tile_manifest import MANIFEST, Ground, publish, roll_back

NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture
def archives(street: Any) -> list[Path]:
    """The street's field, and another of the same street."""
    return [street.store / "street.rff", street.other_store / "other.rff"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "published"
    path.mkdir()
    return path


async def test_a_published_version_is_used_without_a_restart(
    archives: list[Path], folder: Path, serve: Any, travel: Any, tmp_path: Path
) -> None:
    old = publish(folder, "street", archives[0], Ground(), NOW)
    mine = {"fields": tmp_path / "mine", "field": None}
    async with serve(fields=folder) as server:
        await travel(server.address, **mine)
        new = publish(folder, "street", archives[1], Ground(), NOW)
        await server.take_up_fields()
        record = await travel(server.address, **mine)
        assert record.counts == {"acked": 6}
        assert FieldStore(tmp_path / "mine").ids() == tuple(sorted((old.field_id, new.field_id)))
        roll_back(folder, "street")
        await server.take_up_fields()
        assert (await travel(server.address, **mine)).counts == {"acked": 6}


async def test_a_vehicle_under_way_goes_over_to_a_published_version(
    archives: list[Path], folder: Path, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    publish(folder, "street", archives[0], Ground(), NOW)
    async with (
        serve(fields=folder) as server,
        vehicle(server.address, fields=tmp_path / "mine", field=None, loop=True) as driving,
    ):
        await driving.until(lambda: driving.acked() >= 3)
        new = publish(folder, "street", archives[1], Ground(), NOW)
        await server.take_up_fields()
        await driving.until(lambda: f"{new.field_id}.rff" in driving.fields())
        await driving.until(lambda: driving.handovers("tile") == 1)
        seen = driving.acked()
        await driving.until(lambda: driving.acked() >= seen + 6)
    assert {line["result"] for line in driving.lines()} == {"acked"}
    for line in driving.lines():
        assert line["server_digest"] == line["reconstruction_digest"]


async def test_a_version_that_cannot_be_opened_leaves_the_last_good_one(
    archives: list[Path], folder: Path, serve: Any, travel: Any, tmp_path: Path
) -> None:
    old = publish(folder, "street", archives[0], Ground(), NOW)
    async with serve(fields=folder) as server:
        new = publish(folder, "street", archives[1], Ground(), NOW)
        (folder / f"{new.field_id}.rff").write_bytes(b"not a field")
        await server.take_up_fields()
        record = await travel(server.address, fields=tmp_path / "mine", field=None)
        assert record.counts == {"acked": 6}
        (folder / MANIFEST).write_text("not a manifest")
        await server.take_up_fields()
        record = await travel(server.address, fields=tmp_path / "mine", field=None)
        assert record.counts == {"acked": 6}
    assert FieldStore(tmp_path / "mine").ids() == (old.field_id,)


async def test_the_server_looks_by_itself(
    archives: list[Path], folder: Path, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mec_server.server.PUBLICATIONS_EVERY_S", 0.01)
    save = folder / "street.rff"
    save.write_bytes(archives[0].read_bytes())
    async with serve(fields=folder) as server, asyncio.timeout(30):
        looked = asyncio.Event()
        refresh = server._published.refresh

        def refreshed() -> bool:
            done = bool(refresh())
            looked.set() if done else None
            return done

        monkeypatch.setattr(server._published, "refresh", refreshed)
        publish(folder, "street", archives[1], Ground(), NOW)
        await looked.wait()
