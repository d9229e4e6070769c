"""Views of the street from any viewpoint, by real consumers from a real server."""

import asyncio
import math
import threading
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import numpy as np
import pytest

from mec_server.config import ServerBudget, SessionLimits
from mec_server.ledger.budgets import Limit, Resource
from mec_server.twin import rendering
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.errors import LimitExceeded
from rfcore.field import save_field
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.messages import Frame
from rfcore.wire.tile_manifest import Ground, publish
from rfcore.wire.tiles import Area
from rfcore.wire.twin import PictureEncoding
from rfcore.wire.twin_client import TwinClient
from rfcore.wire.twin_render import (
    NO_AGE,
    ObjectsRequest,
    ViewRequest,
    objects_from_wire,
    objects_request_to_wire,
    rendered_view_from_wire,
    view_request_to_wire,
)
from rfcore.wire.v1 import twin_pb2, twin_pb2_grpc
from wall_scene import WALL_M, wall_field

INTRINSICS = Intrinsics(76, 52, 50.0, 50.0, 38.0, 26.0)
ORIGIN = Camera(INTRINSICS, Pose.identity())


def asked(street: Any, camera: Camera = ORIGIN, **changes: Any) -> ViewRequest:
    changes = {"encoding": PictureEncoding.PNG, "max_age_s": 10.0, **changes}
    return ViewRequest(camera, field_id=street.field_id, **changes)


def stream_request(request: ViewRequest) -> twin_pb2.RenderStreamRequest:
    return twin_pb2.RenderStreamRequest(view=view_request_to_wire(request))


def field_picture(street: Any, camera: Camera) -> np.ndarray:
    colour = street.field.render(camera).colour.clip(0, 1)
    return np.rint(colour * np.float32(255)).astype(np.uint8)


@asynccontextmanager
async def stub_of(server: Any) -> AsyncIterator[Any]:
    async with grpc.aio.insecure_channel(str(server.address), options=CONSUMER_OPTIONS) as channel:
        yield twin_pb2_grpc.TwinServiceStub(channel)


async def refusal(call: Any) -> tuple[grpc.StatusCode, str]:
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await call
    return caught.value.code(), caught.value.details()


async def test_a_view_is_the_field_with_what_a_vehicle_sees_now(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    """The vehicle sees a red box that the field does not have; a neighbour's view shows it."""
    aside = Camera(INTRINSICS, Pose((0.05, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))

    def look() -> Any:
        with TwinClient(str(server.address)) as client:
            return client.render(asked(street, aside, number=7))

    async with serve() as server:
        empty = await asyncio.to_thread(look)
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            await vehicle.told(coded.frames[0])
            view = await asyncio.to_thread(look)
        gone = await asyncio.to_thread(look)
    field = field_picture(street, aside)
    assert np.array_equal(empty.rgb, field)
    assert not empty.live.any()
    assert (view.number, view.field_id) == (7, street.field_id)
    assert np.array_equal(view.depth, street.field.render(aside).depth)
    red = np.array([200, 40, 30])
    box, live = (slice(24, 32), slice(14, 21)), view.live[24:32, 14:21]
    assert live.mean() > 0.5
    before, after = (np.abs(rgb[box][live].astype(int) - red).mean() for rgb in (field, view.rgb))
    assert after < before / 2
    assert np.array_equal(view.rgb[~view.live], field[~view.live])
    (camera,) = view.cameras
    assert (camera.vehicle_id, camera.camera_id, camera.outvoted) == ("cav-raw", "front", False)
    assert camera.share == pytest.approx(view.live.mean())
    assert set(np.unique(view.age_ms)) == {round(1e3 * camera.age_s), NO_AGE}
    assert gone.live.any(), "a vehicle that left fades, it does not vanish"
    assert gone.cameras[0].age_s > camera.age_s


async def test_a_view_that_had_to_wait_shows_what_was_fresh_when_it_was_asked_for(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy machine draws it three seconds late, and pictures vouch for two."""
    clock = SimpleNamespace(
        monotonic=time.monotonic, time_ns=time.time_ns, thread_time=time.thread_time
    )
    nearest = rendering.nearest

    def late(*args: Any) -> Any:
        clock.monotonic = lambda: time.monotonic() + 3.0
        return nearest(*args)

    def look() -> Any:
        with TwinClient(str(server.address)) as client:
            return client.render(asked(street, max_age_s=2.0))

    monkeypatch.setattr(rendering, "time", clock)
    monkeypatch.setattr(rendering, "nearest", late)
    async with serve() as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        await vehicle.told(coded.frames[0])
        view = await asyncio.to_thread(look)
    assert view.live.any()
    assert view.cameras[0].age_s > 3.0


FAR = Camera(INTRINSICS, Pose((0.0, 0.0, -40.0), (1.0, 0.0, 0.0, 0.0)))


async def test_a_viewpoint_outside_of_the_field_is_refused(street: Any, serve: Any) -> None:
    async with serve() as server, stub_of(server) as stub:
        code, details = await refusal(stub.Render(view_request_to_wire(asked(street, FAR))))
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert "pose.z_m: -40 is more than 5 m outside of the field" in details


def a_tenth_apart(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames that were captured 0.1 s after one another, the last one now: those within
    ``SAME_INSTANT_S`` confirm nothing, and a fast server answers sooner."""
    now_ns = time.time_ns()
    ages_ns = (10**8 * later for later in reversed(range(len(frames))))
    return [
        replace(f, capture_time_ns=now_ns - age) for f, age in zip(frames, ages_ns, strict=True)
    ]


@pytest.mark.usefixtures("small_things")
async def test_a_place_of_the_world_names_its_tile_and_is_where_the_pose_is_relative_to(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, tmp_path: Path
) -> None:
    ground = Ground(Area((-50.0, -50.0), (50.0, 50.0)), 5.0)
    publish(tmp_path, "west", street.store / "street.rff", ground, datetime.now(UTC))
    place = TileOrigin(10.0, 20.0, 1.0)
    there = Camera(INTRINSICS, Pose((-10.0, -20.0, -1.0), (1.0, 0.0, 0.0, 0.0)))
    request = ViewRequest(there, place=place, encoding=PictureEncoding.PNG)
    beyond = replace(request, place=TileOrigin(500.0, 20.0))
    async with serve(fields=tmp_path) as server, stub_of(server) as stub:
        view = rendered_view_from_wire(await stub.Render(view_request_to_wire(request)), INTRINSICS)
        code, details = await refusal(stub.Render(view_request_to_wire(beyond)))
        calls = [
            stub.Objects(objects_request_to_wire(asked))
            for asked in (ObjectsRequest(tile="west"), ObjectsRequest(place=place))
        ]
        for call in calls:
            await call.initial_metadata()
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            for frame in a_tenth_apart(coded.frames[:4]):
                await vehicle.told(frame)
                told = [objects_from_wire(await call.read()) for call in calls]
    assert view.field_id == street.field_id
    assert np.array_equal(view.rgb, field_picture(street, ORIGIN))
    by_tile, by_place = (each.objects[0].at_m for each in told)
    assert np.subtract(by_tile, by_place) == pytest.approx((10.0, 20.0, 1.0), abs=0.5)
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert (
        "place: east 500 m, north 20 m is on no tile published here: "
        "west (east -50 to 50 m, north -50 to 50 m, and 5 m around)"
    ) in details


async def test_a_view_of_a_moment_ago_shows_what_was_there_then(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve() as server, stub_of(server) as stub, raw_vehicle(server.address) as vehicle:

        async def look(**changes: Any) -> Any:
            request = view_request_to_wire(asked(street, **changes))
            return rendered_view_from_wire(await stub.Render(request), INTRINSICS)

        await vehicle.greet(coded.hello)
        await vehicle.told(coded.frames[0])
        then_ns = time.time_ns()
        first = await look()
        for frame in coded.frames[1:4]:
            await vehicle.told(frame)
        last, again = await look(), await look(time_ns=then_ns)
        refused = [
            await refusal(stub.Render(view_request_to_wire(asked(street, time_ns=moment_ns))))
            for moment_ns in (time.time_ns() + 10**10, time.time_ns() - 10**10)
        ]
    assert np.array_equal(again.rgb, first.rgb)
    assert not np.array_equal(last.rgb, first.rgb)
    assert again.time_ns == then_ns
    assert again.cameras[0].age_s < first.cameras[0].age_s, "as old as it was then"
    for (code, details), when in zip(refused, ("s ahead by", "s ago by"), strict=True):
        assert code is grpc.StatusCode.INVALID_ARGUMENT
        assert when in details
        assert "ask for a moment that is 0 to 5 s ago" in details


async def test_a_viewpoint_inside_of_a_wall_is_refused(serve: Any, tmp_path: Path) -> None:
    """25 cm before a wall that is 8 m wide; from 2 m away it is a view like any other."""
    field_id = save_field(wall_field(0.5), tmp_path / "wall.rff")
    near, away = (
        Camera(INTRINSICS, Pose((0.0, 0.0, WALL_M - distance_m), (1.0, 0.0, 0.0, 0.0)))
        for distance_m in (0.25, 2.0)
    )
    async with serve(fields=tmp_path) as server, stub_of(server) as stub:
        ask = lambda camera: view_request_to_wire(ViewRequest(camera, field_id=field_id))  # noqa: E731
        code, details = await refusal(stub.Render(ask(near)))
        view = rendered_view_from_wire(await stub.Render(ask(away)), INTRINSICS)
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert "pose: 100% of the view is nearer than 0.3 m: the viewpoint is inside" in details
    assert view.depth[26, 38] == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize(
    ("change", "code", "problem"),
    [
        ({"field_id": ""}, "INVALID_ARGUMENT", "tile: name either"),
        ({"tile": "west"}, "INVALID_ARGUMENT", "tile: name either"),
        ({"field_id": "", "tile": "west"}, "INVALID_ARGUMENT", "'west' is not published here"),
        ({"field_id": "ab" * 32}, "NOT_FOUND", "is not on this server"),
        ({"max_age_ms": 10_001}, "INVALID_ARGUMENT", "max_age_ms: 10001.0 is outside 1..10000"),
        ({"encoding": 99}, "INVALID_ARGUMENT", "encoding: 99"),
        ({"pose": None}, "INVALID_ARGUMENT", "a view needs a pose"),
        (
            {"intrinsics.width_px": 4000, "intrinsics.height_px": 3000},
            "INVALID_ARGUMENT",
            "intrinsics: 4000 x 3000 are more than 2088960",
        ),
        (
            {"intrinsics.width_px": 8},
            "INVALID_ARGUMENT",
            "intrinsics.width_px: 8 px is below 16 px",
        ),
        (
            {"intrinsics.width_px": 0},
            "INVALID_ARGUMENT",
            "intrinsics.width_px: 0 px is outside 1..8192 px",
        ),
        (
            {"intrinsics.fx_px": 1.0},
            "INVALID_ARGUMENT",
            "intrinsics.fx_px: 1.0 is outside 7.6..1520",
        ),
        ({"intrinsics.fy_px": math.nan}, "INVALID_ARGUMENT", "intrinsics.fy_px: nan"),
        (
            {"intrinsics.cx_px": 1e9},
            "INVALID_ARGUMENT",
            "intrinsics.cx_px: 1000000000.0 is outside -76..152",
        ),
    ],
)
async def test_what_nobody_can_be_shown_is_refused(
    street: Any, serve: Any, change: dict[str, Any], code: str, problem: str
) -> None:
    request = view_request_to_wire(asked(street))
    for path, value in change.items():
        *part, name = path.split(".")
        message = getattr(request, part[0]) if part else request
        message.ClearField(name)
        if value is not None:
            setattr(message, name, value)
    async with serve() as server, stub_of(server) as stub:
        refused, details = await refusal(stub.Render(request))
    assert refused is grpc.StatusCode[code]
    assert problem in details


async def test_views_are_charged_and_limited(street: Any, serve: Any) -> None:
    async with serve(server_budget=ServerBudget(watches=1)) as server, stub_of(server) as stub:
        value = server.registry.get_sample_value
        moving = stub.RenderStream()
        await moving.write(stream_request(asked(street)))
        await moving.read()
        code, details = await refusal(stub.Render(view_request_to_wire(asked(street))))
        await moving.done_writing()
        assert await moving.code() is grpc.StatusCode.OK
        spent = value("rfedge_server_spent_total", {"resource": "worker_seconds"})
    assert code is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert "1 watches" in details
    assert spent > 0


async def test_a_view_that_waits_for_a_processor_costs_nothing_meanwhile(
    street: Any, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    compose = rendering.compose

    def late(*arguments: Any, **options: Any) -> Any:
        threading.Event().wait(2.0)  # others have the processors
        return compose(*arguments, **options)

    monkeypatch.setattr(rendering, "compose", late)
    monkeypatch.setattr(rendering, "VIEWS_NICE", 0)
    async with serve() as server, stub_of(server) as stub:
        await stub.Render(view_request_to_wire(asked(street)))
        spent = server.registry.get_sample_value(
            "rfedge_server_spent_total", {"resource": "worker_seconds"}
        )
    assert 0 < spent < 1.0


async def test_a_camera_that_moves_is_answered_in_order_with_the_newest(
    street: Any, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the first view is held back, four more requests come: one answer, of the last."""
    gate, begun, compose = threading.Event(), threading.Event(), rendering.compose

    def held_back(*args: Any) -> Any:
        begun.set()
        assert gate.wait(30)
        return compose(*args)

    monkeypatch.setattr(rendering, "compose", held_back)
    cameras = [
        replace(ORIGIN, world_from_cam=Pose((0.1 * i, 0, 0), (1, 0, 0, 0))) for i in range(5)
    ]
    async with serve() as server, stub_of(server) as stub:
        moving = stub.RenderStream()
        await moving.write(stream_request(asked(street, cameras[0], number=0)))
        assert await asyncio.to_thread(begun.wait, 30)
        for number in range(1, 5):
            await moving.write(stream_request(asked(street, cameras[number], number=number)))
        spent = ("rfedge_server_spent_total", {"resource": "messages"})
        async with asyncio.timeout(30):
            while server.registry.get_sample_value(*spent) < 5:
                await asyncio.sleep(0.001)
        gate.set()
        views = [rendered_view_from_wire((await moving.read()).view, INTRINSICS) for _ in range(2)]
        await moving.done_writing()
        assert await moving.read() is grpc.aio.EOF
    assert [(view.number, view.skipped) for view in views] == [(0, 0), (4, 3)]
    for view in views:
        assert np.array_equal(view.rgb, field_picture(street, cameras[view.number]))


async def test_a_stream_ends_with_what_is_wrong_and_with_its_server(
    street: Any, serve: Any
) -> None:
    async with stub_of_stopping(serve) as (stub, server):
        wrong, good = stub.RenderStream(), stub.RenderStream()
        await wrong.write(stream_request(asked(street, FAR)))
        assert await wrong.code() is grpc.StatusCode.INVALID_ARGUMENT
        await good.write(stream_request(asked(street)))
        await good.read()
        await server.stop()
        assert await good.code() is grpc.StatusCode.OK


async def test_a_stream_that_asks_for_nothing_gives_its_place_back(street: Any, serve: Any) -> None:
    limits = SessionLimits(idle_s=0.3)
    budget = ServerBudget(watches=1)
    async with serve(limits=limits, server_budget=budget) as server, stub_of(server) as stub:
        moving = stub.RenderStream()
        await moving.write(stream_request(asked(street)))
        await moving.read()
        assert await moving.code() is grpc.StatusCode.DEADLINE_EXCEEDED
        assert "no view was asked for within 0.3 s" in await moving.details()
        await stub.Render(view_request_to_wire(asked(street)))
        ended = ("rfedge_twin_consumers_ended_total", {"reason": "idle"})
        assert server.registry.get_sample_value(*ended) == 1


@asynccontextmanager
async def stub_of_stopping(serve: Any) -> AsyncIterator[tuple[Any, Any]]:
    async with serve() as server, stub_of(server) as stub:
        yield stub, server


async def test_a_view_that_nobody_waits_for_any_more_is_not_drawn(
    street: Any, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, drawn, compose = threading.Event(), [], rendering.compose

    def held_back(*args: Any) -> Any:
        drawn.append(1)
        assert gate.wait(30)
        return compose(*args)

    monkeypatch.setattr(rendering, "compose", held_back)
    request = view_request_to_wire(asked(street))
    async with serve(limits=SessionLimits()) as server, stub_of(server) as stub:
        held = lambda: server._entry.ledger.held("watches")  # noqa: E731
        first = stub.Render(request)
        async with asyncio.timeout(30):
            while not drawn:
                await asyncio.sleep(0.001)
            second = stub.Render(request)
            while held() < 2:
                await asyncio.sleep(0.001)
            second.cancel()
            while held() > 1:
                await asyncio.sleep(0.001)
        gate.set()
        await first
        await stub.Render(request)
    assert len(drawn) == 2


@pytest.mark.usefixtures("small_things")
async def test_objects_are_what_the_vehicle_sees_and_the_field_does_not_have(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    """The red box of the drive, once three pictures have shown it, until it is forgotten."""

    def classify(crop: np.ndarray) -> str:
        red, green, blue = crop.reshape(-1, 3).mean(axis=0)
        return "red-box" if red > 1.5 * max(green, blue) else ""

    async with serve(classify=classify) as server, stub_of(server) as stub:
        call = stub.Objects(objects_request_to_wire(ObjectsRequest(field_id=street.field_id)))
        await call.initial_metadata()
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            told = []
            for frame in a_tenth_apart(coded.frames[:4]):
                await vehicle.told(frame)
                told.append(objects_from_wire(await call.read()))
        async with asyncio.timeout(20):
            while (last := objects_from_wire(await call.read())).objects:
                assert last.objects[0].unseen_s > 0
    assert last.time_ns - told[3].time_ns < 3e9, "nothing freezes when the vehicle leaves"
    assert told[0].objects == told[1].objects == ()
    assert {each.field_id for each in told} == {street.field_id}
    assert told[0].time_ns < told[1].time_ns < told[2].time_ns
    thing = told[3].objects[0]
    assert thing.seen_by == (("cav-raw", "front"),)
    assert 0 < thing.confidence <= 1
    assert "red-box" in {each.label for each in told[3].objects}, "as the detector calls it"
    assert thing.unseen_s > 0, "it is told of as of now, not as of the picture's capture"
    assert 2 < thing.at_m[2] < 9, "on the surface behind the box: the field is a cloud at 2 to 8 m"


NOWHERE = twin_pb2.ObjectsRequest(place=twin_pb2.WorldPlace(east_m=float("nan")))


async def test_objects_without_worker_time_miss_pictures_and_go_on(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first two pictures find the consumer's worker time spent, the third does not."""
    async with serve() as server, stub_of(server) as stub:
        check, refused = server._entry.ledger.check, []

        def spent(identity: str, resource: Any, now: float) -> None:
            if resource is Resource.WORKER_SECONDS and len(refused) < 2:
                refused.append(identity)
                raise LimitExceeded(Limit.IDENTITY_WORKER_SECONDS, "spent", 1.0)
            check(identity, resource, now)

        monkeypatch.setattr(server._entry.ledger, "check", spent)
        call = stub.Objects(objects_request_to_wire(ObjectsRequest(field_id=street.field_id)))
        await call.initial_metadata()
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            for number, frame in enumerate(coded.frames[:3], start=1):
                assert await vehicle.told(frame) == ("ack", number - 1), "ingest goes on"
                async with asyncio.timeout(20):
                    while len(refused) < min(number, 2):
                        await asyncio.sleep(0.001)
            told = objects_from_wire(await call.read())
        assert told.field_id == street.field_id
        assert not call.done()
        assert len(set(refused)) == 1


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (twin_pb2.ObjectsRequest(), grpc.StatusCode.INVALID_ARGUMENT),
        (twin_pb2.ObjectsRequest(tile="west"), grpc.StatusCode.INVALID_ARGUMENT),
        (twin_pb2.ObjectsRequest(field_id="../x"), grpc.StatusCode.INVALID_ARGUMENT),
        (twin_pb2.ObjectsRequest(place=twin_pb2.WorldPlace()), grpc.StatusCode.INVALID_ARGUMENT),
        (NOWHERE, grpc.StatusCode.INVALID_ARGUMENT),
    ],
)
async def test_objects_of_no_place_are_refused(
    serve: Any, request_: twin_pb2.ObjectsRequest, code: grpc.StatusCode
) -> None:
    async with serve() as server, stub_of(server) as stub:
        assert await stub.Objects(request_).code() is code


async def test_objects_end_with_their_server(street: Any, serve: Any) -> None:
    request = objects_request_to_wire(ObjectsRequest(field_id=street.field_id))
    async with stub_of_stopping(serve) as (stub, server):
        call = stub.Objects(request)
        await call.initial_metadata()
        await server.stop()
        assert await call.code() is grpc.StatusCode.OK
