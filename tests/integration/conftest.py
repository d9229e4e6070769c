"""A small street on disk, a server on a free port, and vehicles that drive past it."""

import asyncio
import itertools
import json
import math
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.pipeline import Pipeline
from cav_agent.vehicle import Vehicle
from frames import message_of
from mec_server.config import RecordSettings, ServerConfig
from mec_server.reconstruction import OpenCameras, open_cameras
from mec_server.server import EdgeServer
from rfcore.camera import Camera, Intrinsics, Pose, camera_on_rig
from rfcore.codec.h264.config import CodecConfig, CoderSettings
from rfcore.dataset import read_dataset
from rfcore.dataset.rig import RIG_FILE, Rig, RigCamera, write_rig
from rfcore.field import SplatField, save_field
from rfcore.image import Rgb, write_png
from rfcore.perception import contacts
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.conventions import CHANNEL_OPTIONS, RENDERER_CONTRACT, STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.convert_answers import AnswerReader
from rfcore.wire.messages import (
    Ack,
    CameraDescription,
    Credit,
    Frame,
    Hello,
    Nack,
    RendererContract,
    ServerMessage,
    Welcome,
)
from rfcore.wire.settings import TransportSettings

INTRINSICS = Intrinsics(76, 52, 50.0, 50.0, 38.0, 26.0)
FRAMES = 6


def random_field(seed: int, n: int = 400) -> SplatField:
    """A cloud of ``n`` Gaussians in front of the origin."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.uniform((-3, -2, 2), (3, 2, 8), (n, 3)),
        "quaternions": rng.normal(size=(n, 4)),
        "log_scales": rng.uniform(-2.5, -1.0, (n, 3)),
        "opacity_logits": rng.uniform(0, 4, n),
        "sh": rng.normal(scale=0.8, size=(n, 4, 3)),
    }
    return SplatField(Gaussians(**{name: a.astype(np.float32) for name, a in arrays.items()}))


def seen_picture(field: SplatField, pose: Pose, rng: np.random.Generator) -> Rgb:
    """Return what a noisy camera sees where the world is as the field says."""
    colour = field.render(Camera(INTRINSICS, pose)).colour
    return np.clip(colour * 255 + rng.normal(scale=4, size=colour.shape), 0, 255).astype(np.uint8)


def write_pictures(folder: Path, pictures: list[tuple[Pose, Rgb]]) -> None:
    """Write a dataset of pictures and their poses."""
    frames = []
    for i, (pose, rgb) in enumerate(pictures):
        write_png(folder / f"{i:03}.png", rgb)
        rows = zip(pose.rotation_matrix(), pose.translation_m, strict=True)
        opengl = [[r[0], -r[1], -r[2], t] for r, t in rows]
        frames.append({"file_path": f"{i:03}.png", "transform_matrix": [*opengl, [0, 0, 0, 1]]})
    top = {"w": 76, "h": 52, "fl_x": 50.0, "fl_y": 50.0, "cx": 38.0, "cy": 26.0}
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": frames}))


def write_drive(folder: Path, field: SplatField) -> None:
    """Write pictures that look like the field, with noise and a box it has never seen."""
    rng = np.random.default_rng(7)
    pictures = []
    for i in range(FRAMES):
        angle = 0.02 * i
        pose = Pose((0.1 * i, 0.0, -0.3 * i), (math.cos(angle), 0.0, math.sin(angle), 0.0))
        rgb = seen_picture(field, pose, rng)
        rgb[20:35, 10 + 5 * i : 25 + 5 * i] = (200, 40, 30)
        pictures.append((pose, rgb))
    write_pictures(folder, pictures)


def on_rig(yaw_rad: float, x_m: float = 0.0) -> Pose:
    """Return camera_from_rig of a camera turned to the right and moved along x."""
    turn = Pose((0.0, 0.0, 0.0), (math.cos(yaw_rad / 2), 0.0, math.sin(yaw_rad / 2), 0.0))
    return Pose((x_m, 0.1, 0.0), turn.rotation).inverse()


def write_rig_drives(folder: Path, field: SplatField, cameras: int) -> Path:
    """Write a rig of ``cameras`` that look at the field side by side; return its file."""
    rng = np.random.default_rng(11)
    rig = Rig(
        tuple(
            RigCamera(f"cam{i}", on_rig(0.05 * (i - cameras // 2), 0.02 * i), folder / f"cam{i}")
            for i in range(cameras)
        )
    )
    for camera in rig.cameras:
        assert camera.drive is not None
        camera.drive.mkdir(parents=True)
        pictures = []
        for i in range(FRAMES):
            world_from_rig = Pose((0.05 * i, 0.0, -0.2 * i), (1.0, 0.0, 0.0, 0.0))
            pose = camera_on_rig(world_from_rig, camera.camera_from_rig)
            pictures.append((pose, seen_picture(field, pose, rng)))
        write_pictures(camera.drive, pictures)
    write_rig(folder / RIG_FILE, rig)
    return folder / RIG_FILE


@dataclass(frozen=True)
class Street:
    """A field with its id, a store that holds it, a drive, and a store with another field."""

    field: SplatField
    field_id: str
    store: Path
    drive: Path
    other_id: str
    other_store: Path


def small_street(root: Path) -> Street:
    """Build a street of 400 Gaussians under ``root``, with pictures of 76x52."""
    field = random_field(1)
    for name in ("drive", "store", "other"):
        (root / name).mkdir()
    write_drive(root / "drive", field)
    return Street(
        field,
        save_field(field, root / "store" / "street.rff"),
        root / "store",
        root / "drive",
        save_field(random_field(2), root / "other" / "other.rff"),
        root / "other",
    )


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    return small_street(tmp_path_factory.mktemp("street"))


@dataclass(frozen=True)
class CodedStreet:
    """Messages of a vehicle on the drive."""

    hello: Hello
    frames: list[Frame]


@pytest.fixture(scope="session")
def coded(street: Street) -> CodedStreet:
    return coded_small_street(street)


def coded_small_street(street: Street) -> CodedStreet:
    pictures = read_dataset(street.drive).pictures
    pipeline = Pipeline(street.field, CodecConfig(76, 52, "fast"), time.perf_counter_ns)
    camera = CameraDescription("front", INTRINSICS, pipeline.header)
    contract = RendererContract(RENDERER_CONTRACT, exact=True)
    hello = Hello("cav-raw", (camera,), (street.field_id,), contract, allow_recording=True)
    frames = []
    for i, taken in enumerate(pictures):
        picture = replace(taken, camera=taken.camera.rounded())
        packet = pipeline.encode_picture(picture)
        frames.append(Frame("front", 1000 * i, picture.camera.world_from_cam, "", packet))
    return CodedStreet(hello, frames)


def secured(changes: dict[str, Any]) -> dict[str, Any]:
    """Return the changes with ``tls`` files as the transport that services are told of."""
    tls = changes.pop("tls", None)
    if tls is None:
        return changes
    return changes | {"transport": TransportSettings(tls.certificate, tls.key, tls.authority)}


@pytest.fixture
def serve(street: Street) -> Callable[..., Any]:
    """Return a context manager that runs a server in this process."""

    @asynccontextmanager
    async def run(
        opened: OpenCameras = open_cameras,
        classify: Callable[[Any], str] | None = None,
        **changes: Any,
    ) -> AsyncIterator[EdgeServer]:
        if "record" in changes:
            changes["record"] = RecordSettings(changes["record"])
        config = replace(ServerConfig(street.store, "127.0.0.1:0"), **secured(changes))
        server = EdgeServer(config, opened, classify)
        await server.start()
        try:
            yield server
        finally:
            await server.stop()

    return run


@dataclass(frozen=True)
class DriveRecord:
    """The fates of a drive's pictures: counted, and the lines of the frame log."""

    counts: Counter[str]
    lines: list[dict[str, Any]]


@pytest.fixture
def travel(street: Street, tmp_path: Path) -> Callable[..., Awaitable[DriveRecord]]:
    """Return a coroutine that drives the street past a server, in lockstep."""
    numbers = itertools.count()

    async def run(address: object, **changes: Any) -> DriveRecord:
        report = tmp_path / f"report{next(numbers)}.jsonl"
        config = AgentConfig(
            str(address),
            street.drive,
            street.store,
            pace=PaceKind.LOCKSTEP,
            field=street.field_id,
            coding=CoderSettings(effort="fast", check_decode=True),
            allow_recording=True,
            report=report,
        )
        counts = await Vehicle(replace(config, **secured(changes))).run()
        return DriveRecord(counts, [json.loads(line) for line in report.read_text().splitlines()])

    return run


class RawVehicle:
    """A vehicle that says exactly what the test wants."""

    def __init__(self, stream: grpc.aio.StreamStreamCall[bytes, bytes]) -> None:
        self.stream = stream
        self.server: EdgeServer | None = None
        self._hello: Hello | None = None
        self._answers = AnswerReader()

    async def say(self, message: Hello | Frame | bytes) -> None:
        """Send a message, or bytes that only claim to be one."""
        if isinstance(message, Hello):
            self._answers = AnswerReader(camera.camera_id for camera in message.cameras)
            self._hello, message = message, hello_to_bytes(message)
        elif isinstance(message, Frame):
            assert self._hello is not None
            message = message_of(self._hello, message)
        await self.stream.write(message)

    async def hear(self) -> ServerMessage:
        """Return the next message that is not a Credit."""
        while True:
            data = await self.stream.read()
            assert data is not grpc.aio.EOF, "the server closed the stream"
            for message in self._answers.messages(data):
                if not isinstance(message, Credit):
                    return message

    async def ask(self, message: Hello | Frame | bytes) -> ServerMessage:
        """Send a message and return the answer; a Welcome with a new rate is none to a frame."""
        await self.say(message)
        answer = await self.hear()
        while isinstance(message, Frame) and isinstance(answer, Welcome):
            answer = await self.hear()
        return answer

    async def greet(self, hello: Hello) -> None:
        """Say hello and expect to be welcome."""
        assert isinstance(await self.ask(hello), Welcome)

    async def told(self, message: Frame | bytes) -> tuple[str, int]:
        """Send a frame and return ("ack" or the reason, sequence)."""
        answer = await self.ask(message)
        if isinstance(answer, Ack):
            return ("ack", answer.address.sequence)
        assert isinstance(answer, Nack)
        return (str(answer.reason), answer.address.sequence)

    async def end(self) -> grpc.StatusCode:
        """Read what is left and return the status of the stream."""
        with suppress(grpc.aio.AioRpcError):
            while await self.stream.read() is not grpc.aio.EOF:
                pass
        return await self.stream.code()

    async def farewell(self) -> grpc.StatusCode:
        """Say that nothing more comes, and return the status of the stream."""
        await self.stream.done_writing()
        return await self.end()


@pytest.fixture
def raw_vehicle() -> Callable[..., Any]:
    """Return a context manager that opens a raw stream to an address."""

    @asynccontextmanager
    async def run(
        address: object, metadata: tuple[tuple[str, str], ...] = ()
    ) -> AsyncIterator[RawVehicle]:
        async with grpc.aio.insecure_channel(str(address), options=CHANNEL_OPTIONS) as channel:
            yield RawVehicle(channel.stream_stream(STREAM_METHOD)(metadata=metadata))

    return run


@pytest.fixture
async def welcomed(coded: CodedStreet, serve: Any, raw_vehicle: Any) -> AsyncIterator[RawVehicle]:
    """A raw vehicle that a server has welcomed."""
    async with serve() as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        vehicle.server = server
        yield vehicle


class Driving:
    """A vehicle under way in this process, and what is known of it so far."""

    def __init__(self, vehicle: Vehicle, config: AgentConfig) -> None:
        self._vehicle = vehicle
        self._config = config
        self.task: asyncio.Task[Counter[str]] | None = None

    def lines(self) -> list[dict[str, Any]]:
        """Return the report: a line a picture that ended."""
        assert self._config.report is not None
        if not self._config.report.exists():
            return []
        return [json.loads(line) for line in self._config.report.read_text().splitlines()]

    def acked(self) -> int:
        """Return how many pictures were answered."""
        return sum(line["result"] == "acked" for line in self.lines())

    def fields(self) -> set[str]:
        """Return the names of the archives it holds."""
        return {path.name for path in self._config.fields.iterdir()}

    def handovers(self, cause: str) -> int:
        """Return how often it moved for that reason."""
        name = "rfedge_agent_handovers_total"
        return int(self._vehicle.registry.get_sample_value(name, {"cause": cause}) or 0)

    def value(self, name: str) -> float | None:
        """Return a metric without labels."""
        return self._vehicle.registry.get_sample_value(name)

    async def until(self, holds: Callable[[], bool]) -> None:
        """Wait until something holds, while the vehicle drives."""
        async with asyncio.timeout(60):
            while not holds():
                assert self.task is not None
                assert not self.task.done(), self.task.exception()
                await asyncio.sleep(0.02)

    async def end(self) -> Counter[str]:
        """Wait for the end of the drive; return how many pictures ended how."""
        assert self.task is not None
        return await self.task


@pytest.fixture
def vehicle(street: Street, tmp_path: Path) -> Callable[..., Any]:
    """Return a context manager that drives the street, in lockstep, until it is left."""

    @asynccontextmanager
    async def drive(address: object, **changes: Any) -> AsyncIterator[Driving]:
        config = AgentConfig(
            str(address),
            street.drive,
            street.store,
            pace=PaceKind.LOCKSTEP,
            coding=CoderSettings(effort="fast", check_decode=True),
            allow_recording=True,
            report=tmp_path / "driving.jsonl",
        )
        config = replace(config, **changes)
        vehicle = Vehicle(config)
        driving = Driving(vehicle, config)
        driving.task = asyncio.create_task(vehicle.run())
        try:
            yield driving
            vehicle.stop()
            await driving.task
        finally:
            driving.task.cancel()
            await asyncio.gather(driving.task, return_exceptions=True)

    return drive


@pytest.fixture
def small_things(monkeypatch: pytest.MonkeyPatch) -> None:
    """Things in pictures of 76x52 count, though the field is a cloud, without ground."""
    for name in ("LEAST_PX", "LEAST_COLUMNS", "LEAST_WIDTH_M", "LEAST_MARKED_M"):
        monkeypatch.setattr(contacts, name, 0)
    monkeypatch.setattr(contacts, "MOST_SLOPE", 1.0)
