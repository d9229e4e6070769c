"""A small street on disk, a server on a free port, and vehicles that drive past it."""

import asyncio
import json
import zlib
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.vehicle import Vehicle
from mec_server.config import ServerConfig
from mec_server.fields import FieldShelf
from mec_server.server import EdgeServer
from rfcore.camera import Pose
from rfcore.field import FieldStore, SplatField
from rfcore.image import write_png
from rfcore.raster.gaussians import Gaussians

WIDTH_PX, HEIGHT_PX = 76, 52
FRAMES = 6


def random_field(seed: int) -> SplatField:
    """A cloud of 400 Gaussians in front of the origin."""
    rng = np.random.default_rng(seed)
    n = 400
    means = rng.uniform((-3, -2, 2), (3, 2, 8), (n, 3))
    arrays = {
        "means": means,
        "quaternions": rng.normal(size=(n, 4)),
        "log_scales": rng.uniform(-2.5, -1.0, (n, 3)),
        "opacity_logits": rng.uniform(0, 4, n),
        "sh": rng.normal(scale=0.8, size=(n, 4, 3)),
    }
    return SplatField(Gaussians(**{name: a.astype(np.float32) for name, a in arrays.items()}))


def drive_poses() -> list[Pose]:
    turns = [0.02 * i for i in range(FRAMES)]
    return [
        Pose((0.1 * i, 0.0, -0.3 * i), (float(np.cos(a)), 0.0, float(np.sin(a)), 0.0))
        for i, a in enumerate(turns)
    ]


def write_drive(folder: Path, field: SplatField) -> Path:
    """Write pictures that look like the field, with a box and noise it has never seen."""
    from rfcore.camera import Camera, Intrinsics

    k = Intrinsics(WIDTH_PX, HEIGHT_PX, 50.0, 50.0, WIDTH_PX / 2, HEIGHT_PX / 2)
    rng = np.random.default_rng(7)
    frames = []
    for i, pose in enumerate(drive_poses()):
        colour = field.render(Camera(k, pose)).colour
        rgb = np.clip(colour * 255 + rng.normal(scale=4, size=colour.shape), 0, 255)
        rgb[20:35, 10 + 5 * i : 25 + 5 * i] = (200, 40, 30)
        write_png(folder / f"{i:03}.png", rgb.astype(np.uint8))
        flip = [[row[0], -row[1], -row[2], t] for row, t in
                zip(pose.rotation_matrix(), pose.translation_m, strict=True)]  # fmt: skip
        frames.append({"file_path": f"{i:03}.png", "transform_matrix": [*flip, [0, 0, 0, 1]]})
    intrinsics = {"w": WIDTH_PX, "h": HEIGHT_PX, "fl_x": 50.0, "fl_y": 50.0}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    return folder


@dataclass(frozen=True)
class Street:
    """A field with its id, the archive in a store of its own, and a drive."""

    field: SplatField
    field_id: str
    store: Path
    drive: Path


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    root = tmp_path_factory.mktemp("street")
    field = random_field(1)
    (root / "drive").mkdir()
    drive = write_drive(root / "drive", field)
    from rfcore.field import save_field

    (root / "store").mkdir()
    field_id = save_field(field, root / "store" / "street.rff")
    return Street(field, field_id, root / "store", drive)


@pytest.fixture(scope="session")
def other_store(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A store with another field, and its id."""
    store = FieldStore(tmp_path_factory.mktemp("other"))
    from rfcore.field.splats import encode_field

    field_id = store.add(encode_field(random_field(2)))
    return store.path(field_id).parent, field_id


Serve = Callable[..., Any]


@pytest.fixture
def serve(street: Street) -> Serve:
    """Return a context manager that runs a server in this process."""

    @asynccontextmanager
    async def run(**changes: Any) -> AsyncIterator[EdgeServer]:
        config = replace(ServerConfig(street.store, "127.0.0.1:0"), **changes)
        store = FieldStore(config.fields)

        def load(field_id: str) -> SplatField:
            return store.load(field_id, threads=config.threads, isa=config.isa)

        server = EdgeServer(config, store, FieldShelf(store, load))
        await server.start()
        try:
            yield server
        finally:
            await server.stop()

    return run


@dataclass(frozen=True)
class Trip:
    """What a vehicle brought home."""

    counts: Counter[str]
    lines: list[dict[str, Any]]


Travel = Callable[..., Awaitable[Trip]]


@pytest.fixture
def travel(street: Street, tmp_path: Path) -> Travel:
    """Return a coroutine that drives the street past a server."""

    async def run(server: EdgeServer, **changes: Any) -> Trip:
        report = tmp_path / "report.jsonl"
        config = AgentConfig(
            str(server.address),
            street.drive,
            street.store,
            pace=PaceKind.LOCKSTEP,
            field=street.field_id,
            preset="ultrafast",
            report=report,
        )
        counts = await Vehicle(replace(config, **changes)).run()
        return Trip(counts, [json.loads(line) for line in report.read_text().splitlines()])

    return run


@pytest.fixture
def crc32() -> Callable[[bytes], int]:
    return zlib.crc32


@pytest.fixture(autouse=True)
async def _no_task_is_left_behind() -> AsyncIterator[None]:
    yield
    left = [t for t in asyncio.all_tasks() if t is not asyncio.current_task()]
    assert not [t for t in left if "cav_agent" in repr(t) or "mec_server" in repr(t)]
