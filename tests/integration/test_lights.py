"""A vehicle drives in another light than the tile's: it fetches the light and codes against it."""

import asyncio
import itertools
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cav_agent.field_fetch import fetch_field
from mec_server.config import LearnSettings
from mec_server.learner import UnrecordedTrials
from mec_server.twin.state import ReceivedPicture
from rfcore.errors import RfedgeError
from rfcore.field import FieldStore, SplatField, load_field, save_field
from rfcore.field.delta import delta_of
from rfcore.field.layer import VOXELS_M, ColourLayer, layer_archive, layered_field, voxels_of
from rfcore.wire.tile_manifest import Ground, VersionLabel, publish
from rfcore.wire.tiles import PREVIEW
from rfedge.fields.slim import slimmed

NOW = datetime(2026, 1, 1, tzinfo=UTC)
DUSK = VersionLabel("dusk", passes=2, time_of_day_h=18.5)


def darker(field: SplatField) -> SplatField:
    """The street at night: colours of a fifth."""
    sh = field.gaussians.sh * np.float32(0.2)
    sh[:, 0] -= np.float32(0.4 / 0.28209479)
    return SplatField(replace(field.gaussians, sh=sh))


@pytest.fixture
def folder(street: Any, tmp_path: Path) -> Path:
    """A tile whose own field is of the night, while the drive is by day."""
    path = tmp_path / "published"
    path.mkdir()
    night = tmp_path / "night.rff"
    day = load_field(street.store / "street.rff")
    assert isinstance(day, SplatField)
    save_field(darker(day), night)
    publish(path, "street", night, Ground(), NOW)
    return path


async def test_the_light_is_fetched_while_driving_and_used_without_a_new_stream(
    street: Any, folder: Path, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    tile = publish(folder, "street", street.store / "street.rff", Ground(), NOW, DUSK)
    async with (
        serve(fields=folder) as server,
        vehicle(server.address, fields=tmp_path / "mine", loop=True) as driving,
    ):
        await driving.until(lambda: driving.lines()[-1:] != [] and lit(driving) == street.field_id)
        seen = driving.acked()
        await driving.until(lambda: driving.acked() >= seen + 6)
    lines = driving.lines()
    assert {line["result"] for line in lines} == {"acked"}
    assert lines[0]["light_field"] is None
    assert {line["epoch"] for line in lines} == {0}
    assert driving.fields() >= {f"{field_id}.rff" for field_id in tile.renderable_ids}
    first, last = lines[0]["payload_bytes"], lines[-1]["payload_bytes"]
    assert last < first


def a_layer(day: SplatField) -> SplatField:
    """The day in another light, as a colour layer."""
    voxels = [np.zeros((voxels_of(day.gaussians.means, m)[1], 6), np.int32) for m in VOXELS_M]
    voxels[-1][:, 0] = 1
    layer = ColourLayer(tuple(voxels), np.zeros((day.primitives, 3), np.int32))
    return layered_field(layer_archive(layer, day, day.metadata), day, day.metadata)


def a_delta(day: SplatField) -> SplatField:
    """The day with one splat moved."""
    means = day.gaussians.means.copy()
    means[7] += 1
    return delta_of(day, SplatField(replace(day.gaussians, means=means)))


@pytest.mark.parametrize("made_of", [a_layer, a_delta])
async def test_a_layer_or_a_delta_is_fetched_with_its_base(
    street: Any, folder: Path, serve: Any, vehicle: Any, tmp_path: Path, made_of: Any
) -> None:
    day = street.field.compressed()
    made = made_of(day)
    save_field(day, tmp_path / "day.rff")
    save_field(made, tmp_path / "layer.rff")
    FieldStore(folder).add(tmp_path / "day.rff")
    publish(folder, "street", tmp_path / "layer.rff", Ground(), NOW, DUSK)
    mine = {"fields": tmp_path / "mine", "loop": True}
    async with serve(fields=folder) as server, vehicle(server.address, **mine) as driving:
        await driving.until(lambda: lit(driving) == made.field_id)
        seen = driving.acked()
        await driving.until(lambda: driving.acked() >= seen + 3)
    assert {line["result"] for line in driving.lines()} == {"acked"}
    assert {f"{day.field_id}.rff", f"{made.field_id}.rff"} <= driving.fields()
    sizes = [path.stat().st_size for path in (tmp_path / "mine").glob("*.rff")]
    assert driving.value("rfedge_agent_field_bytes_total") == sum(sizes)


@pytest.fixture
def own_may_come(street: Any, monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """Hold the transfer of the tile's own field back until it is set; the first try fails."""
    may_come, tries = asyncio.Event(), itertools.count()

    async def held(channel: Any, store: Any, field_id: str, *more: Any) -> None:
        if field_id == street.field_id:
            if next(tries) == 0:
                raise RfedgeError("the transfer broke")
            await may_come.wait()
        await fetch_field(channel, store, field_id, *more)

    monkeypatch.setattr("cav_agent.field_cache.fetch_field", held)
    monkeypatch.setattr("cav_agent.field_cache.OWN_AGAIN_S", 0.01)
    return may_come


async def test_a_vehicle_begins_with_the_preview_and_goes_on_with_the_tiles_own_field(
    street: Any, own_may_come: asyncio.Event, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    """One stream, one epoch, and no frame refused: each is named by the field it was drawn from."""
    folder, mine = tmp_path / "published", tmp_path / "mine"
    folder.mkdir()
    own = load_field(street.store / "street.rff")
    assert isinstance(own, SplatField)
    preview_id = save_field(slimmed(own, own.primitives // 2), tmp_path / "preview.rff")
    publish(folder, "street", street.store / "street.rff", Ground(), NOW)
    publish(folder, "street", tmp_path / "preview.rff", Ground(), NOW, VersionLabel(PREVIEW))
    async with (
        serve(fields=folder) as server,
        vehicle(server.address, fields=mine, loop=True) as driving,
    ):
        await driving.until(lambda: driving.acked() >= 3)
        assert driving.fields() == {f"{preview_id}.rff"}
        own_may_come.set()
        await driving.until(lambda: lit(driving) is None)
        seen = driving.acked()
        await driving.until(lambda: driving.acked() >= seen + 3)
    lines = driving.lines()
    assert {line["result"] for line in lines} == {"acked"}
    assert {line["epoch"] for line in lines} == {0}
    named = [line["light_field"] for line in lines]
    began = named.count(preview_id)
    assert named == [preview_id] * began + [None] * (len(lines) - began)
    assert driving.fields() == {f"{preview_id}.rff", f"{street.field_id}.rff"}


async def test_a_vehicle_that_holds_the_field_fetches_no_preview(
    street: Any, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    folder, mine = tmp_path / "published", tmp_path / "mine"
    folder.mkdir()
    preview_id = save_field(slimmed(street.field, 9), tmp_path / "preview.rff")
    publish(folder, "street", street.store / "street.rff", Ground(), NOW)
    publish(folder, "street", tmp_path / "preview.rff", Ground(), NOW, VersionLabel(PREVIEW))
    FieldStore(mine).add(street.store / "street.rff")
    async with (
        serve(fields=folder) as server,
        vehicle(server.address, fields=mine, loop=True) as driving,
    ):
        await driving.until(lambda: driving.acked() >= 2)
    assert f"{preview_id}.rff" not in driving.fields()
    assert {line["light_field"] for line in driving.lines()} == {None}


def lit(driving: Any) -> str | None:
    """Return the field of another light that the last picture was coded against."""
    lines = driving.lines()
    return lines[-1]["light_field"] if lines else None


async def test_learnt_fields_are_tried_on_vehicles_that_are_not_recorded(
    coded: Any, serve: Any, raw_vehicle: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[ReceivedPicture] = []
    left: list[str] = []
    monkeypatch.setattr(UnrecordedTrials, "saw", lambda _, view: seen.append(view))
    monkeypatch.setattr(UnrecordedTrials, "left", lambda _, name: left.append(name))
    async with serve(record=tmp_path, learn=LearnSettings(on=True)) as server:
        for name, consents in (("recorded", True), ("private", False)):
            hello = replace(coded.hello, vehicle_id=name, allow_recording=consents)
            async with raw_vehicle(server.address) as vehicle:
                await vehicle.greet(hello)
                assert await vehicle.told(coded.frames[0]) == ("ack", 0)
    assert [view.vehicle_id for view in seen] == ["private"]
    assert seen[0].digest.startswith(coded.frames[0].packet.reconstruction_digest)
    assert left == ["recorded", "private"]
    assert not list(tmp_path.rglob("private"))
