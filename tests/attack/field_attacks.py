"""Attacks by files: what somebody may leave in the folder that fields are served from."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import json
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from attack.target import Target, all_of, for_ever, hello
from rfcore.field import load_field
from rfcore.field.archive import Archive, decode_archive, encode_archive
from rfcore.field.store import encode_field
from rfcore.wire.conventions import STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.tile_manifest import Publication, TileVersion, TileVersions, write_publication

SHIPPED = Path(__file__).parents[2] / "samples/fields/street.rff"


async def strange_entries(target: Target) -> None:
    """A pipe, a link to nowhere, a folder and a sparse file of 3 GiB among the fields."""
    folder = Path(target.fields)
    for number in itertools.count():
        names = (f"{kind}-{os.getpid()}-{number}" for kind in ("pipe", "link", "folder", "large"))
        paths = [folder / f"{name}.rff" for name in names]
        pipe, link, inner, large = paths
        os.mkfifo(pipe)
        link.symlink_to("/nowhere")
        inner.mkdir()
        with large.open("wb") as file:
            file.write(b"RFFIELD\0")
            file.truncate(3 << 30)
        await asyncio.sleep(3.0)
        for path in paths:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


async def malformed_archives(target: Target) -> None:
    """Archives with right digests and a shape of [0, 2^62], asked for as soon as they are there."""
    await asked_for(target, malformed_archive)


def malformed_archive(number: int) -> bytes:
    array = {"name": "means", "dtype": "<f4", "shape": [0, 1 << 62], "offset": 0}
    digest = {"sha256": hashlib.sha256(b"").hexdigest()}
    header = {"kind": "splats", "metadata": {"n": number}, "arrays": [array | digest]}
    raw = json.dumps(header | {"data_bytes": 0}).encode()
    prefix = struct.pack("<8sII32s16x", b"RFFIELD\0", 1, len(raw), hashlib.sha256(raw).digest())
    return (prefix + raw).ljust(-(-(len(prefix) + len(raw)) // 64) * 64, b"\0")


async def malformed_publications(target: Target) -> None:
    """A manifest that names one such archive after the other as the current field of a tile."""
    folder = Path(target.fields)
    for number in itertools.count():
        data = malformed_archive(number)
        field_id = hashlib.sha256(data).hexdigest()
        (folder / f"{field_id}.rff").write_bytes(data)
        versions = TileVersions((TileVersion(field_id, "2026-11-01T12:00:00+00:00"),), 1)
        write_publication(folder, Publication({"west": versions}))
        await asyncio.sleep(0.5)


async def field_bombs(target: Target) -> None:
    """Fields whose few bytes claim to hold 1, 2, ... 40 million splats, asked for one by one."""
    shipped = decode_archive(encode_field(load_field(SHIPPED).compressed()))

    def archive(number: int) -> bytes:
        encoding = {**shipped.metadata["encoding"], "count": (number % 40 + 1) * 1_000_000}
        metadata = {**shipped.metadata, "encoding": encoding}
        return encode_archive(Archive(shipped.kind, metadata, shipped.arrays))

    await asked_for(target, archive)


async def asked_for(target: Target, archive: Callable[[int], bytes]) -> None:
    """Put one archive after the other there, and send Hellos that ask for them."""
    named: list[str] = []

    async def put() -> None:
        for number in itertools.count():
            data = archive(number)
            named[:] = [hashlib.sha256(data).hexdigest()]
            path = Path(target.fields) / f"{named[0]}.rff"
            path.write_bytes(data)
            await asyncio.sleep(2.5)  # it is listed after a second or two
            path.unlink()

    async def ask() -> None:
        async with target.channel() as channel:
            call = channel.stream_stream(STREAM_METHOD)()
            asked = replace(hello(target, 320, 180), field_ids=tuple(named))
            await call.write(hello_to_bytes(asked))
            await asyncio.sleep(0.1)

    await all_of(put(), for_ever(ask))
