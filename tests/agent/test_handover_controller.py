"""The drive over streams in memory: who takes each picture, what is counted, and what ends it."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry
from structlog.testing import capture_logs

from cav_agent.capture_schedule import recorded_schedule
from cav_agent.client import CameraTaken, StreamOwner
from cav_agent.config import AgentConfig, AgentLimits, PaceKind
from cav_agent.frame_log import DriveObserver
from cav_agent.frames import Capture, EndReason, FrameResult, Outcome
from cav_agent.handover import ServedTile
from cav_agent.handover_controller import HandoverController, OpenStream, TileStream
from cav_agent.metrics import AgentMetrics
from rfcore.errors import FieldFormatError, ProtocolError, RfedgeError
from rfcore.wire.address import Address
from rfcore.wire.tiles import Area, Tile
from rfcore.wire.waits import WaitLog, log_wait

REFUSED = ProtocolError("hello.field_ids: none is here")
ADDRESSES = (Address("127.0.0.1", 1), Address("127.0.0.1", 2))


def tile(server: int, west_m: float, east_m: float) -> ServedTile:
    area = Area((west_m, -5.0), (east_m, 5.0))
    return ServedTile(server, Tile(f"tile-{server}", f"{server}a" * 32, 1, area, 4.0))


WEST, EAST = tile(0, -100, 0), tile(1, 0, 100)
POSITIONS = [(-20.0, 0.0), (-10.0, 0.0), (10.0, 0.0), (20.0, 0.0)]


class MemoryClient:
    """Stands for ``StreamClient``: acknowledges every picture as soon as it is captured."""

    rate_limit_hz = 0.0
    is_draining = False
    waits_for = ""

    def __init__(
        self,
        owner: StreamOwner,
        make_capture: Callable[..., Capture],
        error: Exception | None,
        on_capture: Callable[[int], None],
    ) -> None:
        self.captured: list[int] = []
        self.left_behind: list[Capture] = []
        self.is_streaming = error is None
        self.withdrawn = False
        self._owner = owner
        self._make_capture = make_capture
        self._error = error
        self._on_capture = on_capture
        self._finishing = asyncio.Event()
        self.may_close = asyncio.Event()
        self.may_close.set()

    def capture(self, index: int) -> None:
        if self._error is not None or self._finishing.is_set():
            self.left_behind.append(self._make_capture(index))
            return
        self.captured.append(index)
        self._on_capture(index)
        result = FrameResult(self._make_capture(index), Outcome.ACKED)
        asyncio.get_running_loop().call_soon(self._owner.ended, result)

    def withdraw(self) -> None:
        self.withdrawn = True

    def finish(self) -> None:
        self.is_streaming = False
        self._finishing.set()

    stop = finish

    def abandon(self, problem: str) -> None:
        for capture in self.left_behind:
            lost = FrameResult(capture, Outcome.LOST, EndReason.ABANDONED, problem)
            self._owner.ended(lost)

    async def run(self) -> None:
        if self._error is not None:
            raise self._error
        self._owner.welcomed()
        await self._finishing.wait()
        await self.may_close.wait()
        if self._error is not None:
            raise self._error

    def break_off(self, error: Exception) -> None:
        """End the stream from the server's side."""
        self._error = error
        self.finish()


@dataclass
class Owner:
    """Owns a stream, and keeps how its pictures ended."""

    results: list[FrameResult] = field(default_factory=list)

    def ended(self, result: FrameResult) -> None:
        self.results.append(result)

    def welcomed(self) -> None:
        """Not looked at."""


@dataclass
class Site:
    """Makes streams, and keeps them by tile; ``errors`` says which fail."""

    make_capture: Callable[..., Capture]
    errors: dict[ServedTile, Exception] = field(default_factory=dict)
    failing_fields: dict[ServedTile, Exception] = field(default_factory=dict)
    clients: dict[ServedTile, list[MemoryClient]] = field(default_factory=dict)
    streaming: dict[int, set[ServedTile]] = field(default_factory=dict)
    """The tiles that had a stream when a picture was captured."""
    breaks_at: int | None = None
    """The picture at which the stream that takes it is refused, once it was answered."""
    drains_at: int | None = None
    """The picture at which the server of the stream that takes it begins to drain."""
    failing: int = 0
    """Number of streams after a tile's first one that are refused at once."""

    async def prepare(self, served: ServedTile) -> OpenStream:
        if served in self.failing_fields:
            raise self.failing_fields[served]

        def open_stream(owner: StreamOwner) -> MemoryClient:
            error = self.errors.get(served)
            if served in self.clients and self.failing:
                self.failing -= 1
                error = REFUSED
            client = MemoryClient(owner, self.make_capture, error, self._note_streaming)
            self.clients.setdefault(served, []).append(client)
            return client

        return open_stream  # type: ignore[return-value]

    def _note_streaming(self, index: int) -> None:
        if index == self.breaks_at:
            self.breaks_at = None
            (client,) = (c for clients in self.clients.values() for c in clients)
            client.break_off(REFUSED)
        if index == self.drains_at:
            (client,) = (c for clients in self.clients.values() for c in clients)
            client.is_draining = True
        self.streaming[index] = {
            served
            for served, clients in self.clients.items()
            if any(client.is_streaming for client in clients)
        }

    def captured(self, served: ServedTile) -> list[int]:
        return [index for client in self.clients.get(served, []) for index in client.captured]


@pytest.fixture
def site(make_capture: Callable[..., Capture]) -> Site:
    return Site(make_capture)


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


@pytest.fixture
def drive(site: Site, registry: CollectorRegistry) -> Callable[..., HandoverController]:
    """Return a function that makes the controller of a drive in lockstep past ``tiles``."""

    def make(*tiles: ServedTile, give_up_s: float = 30.0, loop: bool = False) -> HandoverController:
        config = AgentConfig(
            "127.0.0.1:1",
            Path("drive"),
            loop=loop,
            pace=PaceKind.LOCKSTEP,
            limits=AgentLimits(give_up_s=give_up_s),
        )
        observer = DriveObserver(AgentMetrics(registry), ADDRESSES)
        schedule = recorded_schedule(config, len(POSITIONS), 1)
        controller = HandoverController(
            config, POSITIONS, schedule, site.prepare, observer, asyncio.Event()
        )
        for server in sorted({served.server for served in tiles}):
            mine = [served for served in tiles if served.server == server]
            controller.tiles_published(server, mine)
        return controller

    return make


Drive = Callable[..., HandoverController]


async def test_every_picture_goes_to_the_tile_it_was_taken_on(drive: Drive, site: Site) -> None:
    await drive(WEST, EAST).run()
    assert site.captured(WEST) == [0, 1]
    assert site.captured(EAST) == [2, 3]


async def test_a_field_that_does_not_come_is_named_as_what_the_drive_waits_for(
    drive: Drive, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cav_agent.handover_controller.ANSWERED_S", 0.0)
    monkeypatch.setattr(site, "prepare", lambda _: asyncio.get_running_loop().create_future())
    with capture_logs() as logs:
        controller = drive(WEST)
        controller._waits = WaitLog(log_wait, first_s=0.0)
        running = asyncio.create_task(controller.run())
        while not logs:
            await asyncio.sleep(0)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert logs[0]["event"] == "waiting"
    assert logs[0]["what"] == f"field {WEST.tile.field_id} of tile tile-0"


async def test_a_handover_is_counted_and_closes_the_stream_that_was_left(
    drive: Drive, site: Site, registry: CollectorRegistry
) -> None:
    await drive(WEST, EAST).run()
    labels = {"cause": "tile"}
    assert registry.get_sample_value("rfedge_agent_handovers_total", labels) == 1
    assert site.streaming[1] == {WEST, EAST}, "opened ahead of the border"
    assert site.streaming[2] == {EAST}, "one vehicle is shown by one server at a time"
    assert not site.clients[WEST][0].withdrawn, "its server answers, so it keeps what it has taken"


async def test_a_stream_that_is_still_closing_takes_no_picture_of_a_vehicle_that_comes_back(
    drive: Drive, site: Site
) -> None:
    controller = drive(WEST, EAST, loop=True)
    running = asyncio.create_task(controller.run())
    while not site.captured(WEST):
        await asyncio.sleep(0)
    (west,) = site.clients[WEST]
    west.may_close.clear()
    while not site.captured(EAST):
        await asyncio.sleep(0)
    while controller.counts["acked"] < 4:
        await asyncio.sleep(0)
    assert (west.left_behind, len(site.clients[WEST])) == ([], 1), "the next picture waits"
    west.may_close.set()
    while len(site.captured(WEST)) < 4:
        await asyncio.sleep(0)
    controller.stop()
    await running
    assert set(controller.counts) == {"acked"}
    assert len(site.clients[WEST]) == 2


async def test_the_only_stream_that_fails_ends_the_drive_with_its_error(
    drive: Drive, site: Site
) -> None:
    site.errors[WEST] = ProtocolError("hello.field_ids: none is here")
    with pytest.raises(ProtocolError, match="none is here"):
        await drive(WEST).run()


async def test_a_server_that_welcomed_the_vehicle_once_is_tried_again_for_ever(
    drive: Drive, site: Site, registry: CollectorRegistry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cav_agent.handover_controller.FIRST_RETRY_S", 0.001)
    monkeypatch.setattr("cav_agent.handover_controller.LONGEST_RETRY_S", 0.001)
    site.breaks_at, site.failing = 1, 3
    await drive(WEST, give_up_s=0.0).run()
    assert site.captured(WEST) == [0, 1, 2, 3]
    assert len(site.clients[WEST]) == 5, "one that broke, three that were refused, one that went on"
    retried = registry.get_sample_value("rfedge_agent_retries_total", {"reason": "refused"})
    assert retried == 4


async def test_a_second_stream_to_the_same_tile_takes_over_where_its_server_is_draining(
    drive: Drive, site: Site
) -> None:
    """As behind a proxy, which places the second stream on another server."""
    site.drains_at = 1
    await drive(WEST).run()
    first, second = site.clients[WEST]
    assert first.captured + second.captured == [0, 1, 2, 3]
    assert second.captured, "the rest of the drive"
    assert not first.is_streaming, "the vehicle is shown once"


async def test_no_server_for_as_long_as_may_be_ends_the_drive(
    drive: Drive, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cav_agent.handover_controller.FIRST_RETRY_S", 0.3)
    site.errors[WEST] = RfedgeError("UNAVAILABLE")
    with pytest.raises(RfedgeError, match="UNAVAILABLE"):
        await drive(WEST, give_up_s=1.2).run()
    assert len(site.clients[WEST]) > 1


async def test_a_field_that_cannot_be_prepared_ends_the_drive_with_its_error(
    drive: Drive, site: Site
) -> None:
    site.failing_fields[WEST] = FieldFormatError("field 0a0a is damaged")
    with pytest.raises(FieldFormatError, match="is damaged"):
        await drive(WEST).run()
    assert site.clients == {}


async def test_a_camera_that_another_agent_sends_ends_the_drive_though_a_neighbour_is_there(
    drive: Drive, site: Site
) -> None:
    """The neighbour would only let the two agents alternate."""
    site.errors[WEST] = CameraTaken("camera_taken: another agent sends camera front")
    with pytest.raises(CameraTaken):
        await drive(WEST, EAST).run()


async def test_one_of_two_streams_that_fails_is_held_back_and_tried_again(
    site: Site, make_capture: Callable[..., Capture]
) -> None:
    owner = Owner()
    site.errors[WEST] = ProtocolError("draining")
    stream = TileStream(WEST, site.prepare, owner, asyncio.Event())
    stream.open(0.0)
    await asyncio.gather(*stream.tasks)
    assert stream.collect() is None
    stream.open(0.0)
    (client,) = site.clients[WEST]
    client.left_behind.append(make_capture(1))
    await asyncio.gather(*stream.tasks, return_exceptions=True)
    assert isinstance(stream.collect(), ProtocolError)
    assert [(r.capture.index, r.reason) for r in owner.results] == [(1, EndReason.ABANDONED)]
    assert stream.client is None
    stream.retry_at_s = 2.0
    stream.open(1.9)
    assert len(site.clients[WEST]) == 1, "too early"
    del site.errors[WEST]
    stream.open(2.0)
    assert len(site.clients[WEST]) == 2
    assert stream.is_streaming
    stream.close()
    await stream.wait_closed()


async def test_a_drive_that_is_stopped_captures_no_more(drive: Drive, site: Site) -> None:
    controller = drive(WEST, EAST)
    running = asyncio.create_task(controller.run())
    while not site.captured(WEST):
        await asyncio.sleep(0)
    controller.stop()
    await running
    assert sum(controller.counts.values()) <= 2
    assert site.captured(EAST) == []


async def test_tiles_that_are_published_later_are_followed(drive: Drive, site: Site) -> None:
    """The first server lists its tiles before the second: its own pictures are sent meanwhile."""
    controller = drive(WEST)
    running = asyncio.create_task(controller.run())
    while not site.captured(WEST):
        await asyncio.sleep(0)
    controller.tiles_published(1, [EAST])
    await running
    assert site.captured(EAST) == [2, 3]
