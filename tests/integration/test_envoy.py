"""Three servers behind a real Envoy with deploy/envoy's configuration, and vehicles through it."""

import asyncio
import signal
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack, ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml

from cav_agent.config import AgentLimits, PaceKind
from rfcore.wire.publish import Ground, publish
from rfcore.wire.tiles import Area
from rfedge.demo.processes import Service, command_of, service
from rfedge.loadtest.scale.envoy import Envoy, EnvoySetup, check_config, envoy_binary, run_envoy

pytestmark = pytest.mark.slow

DEPLOY = Path(__file__).parents[2] / "deploy" / "envoy"
VEHICLES, SERVERS = 12, 3
MOST_OVER_MEAN = 1.5
PATIENT = AgentLimits(answer_s=60.0)
"""A busy machine is not a server that is lost."""

EVERYWHERE = Ground(Area((-5.0, -5.0), (5.0, 5.0)), 0.0)
PROXIED = (
    "--drain-hold-s", "3", "--identity-share", "1", "--identity-streams", "256",
    "--identity-fetches", "16", "--identity-rpcs", "512", "--identity-calls-per-s", "1000",
)  # fmt: skip
"""Without certificates the servers take Envoy, and all vehicles behind it, for one peer."""


class Site:
    """Servers as processes, and Envoy before them."""

    def __init__(self, store: Path, folder: Path) -> None:
        self.servers: list[Service] = []
        self.setup = EnvoySetup(envoy_binary(), DEPLOY / "envoy.yaml", folder / "envoy")
        self.setup.folder.mkdir()
        self._store, self._folder = store, folder
        self._stack = ExitStack()
        self._started = 0

    def start_server(self) -> Service:
        self._started += 1
        options = ("--fields", str(self._store), "--listen", "127.0.0.1:0", *PROXIED)
        command = [*command_of("mec-server"), *options]
        started = self._stack.enter_context(
            service(f"server{self._started}", command, self._folder)
        )
        self._stack.callback(started.process.kill)
        self.servers.append(started)
        return started

    def start_envoy(self) -> Envoy:
        return self._stack.enter_context(run_envoy(self.setup, self.addresses))

    @property
    def addresses(self) -> list[str]:
        return [server.address for server in self.servers]

    def list_servers(self) -> None:
        self.setup.list_servers(self.addresses)

    def close(self) -> None:
        self._stack.close()


async def settled(envoy: Envoy, holds: Callable[[Mapping[str, int]], bool]) -> dict[str, int]:
    """Wait until something holds of the calls by server, while the vehicles drive."""
    return await asyncio.to_thread(envoy.until, holds)


def of_all(vehicles: list[Any]) -> list[dict[str, Any]]:
    """Return the lines of all reports."""
    return [line for vehicle in vehicles for line in vehicle.lines()]


def failures(vehicles: list[Any]) -> list[dict[str, Any]]:
    return [line for line in of_all(vehicles) if line["result"] in ("lost", "nacked")]


async def all_go_on(vehicles: list[Any]) -> None:
    """Wait until every vehicle had two more pictures acknowledged."""
    before = [vehicle.acked() for vehicle in vehicles]
    for vehicle, had in zip(vehicles, before, strict=True):
        await vehicle.until(lambda vehicle=vehicle, had=had: vehicle.acked() >= had + 2)


async def test_envoy_places_streams_and_moves_them_when_a_server_dies_or_drains(
    street: Any, vehicle: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cav_agent.frames_in_flight.STALL_S", PATIENT.answer_s)
    store = tmp_path / "published"
    store.mkdir()
    archive, now = street.store / "street.rff", datetime(2026, 1, 1, tzinfo=UTC)
    publish(store, "street", archive, EVERYWHERE, now)
    site = Site(store, tmp_path)
    async with AsyncExitStack() as stack:
        stack.callback(site.close)
        for _ in range(SERVERS):
            site.start_server()
        envoy = site.start_envoy()
        vehicles = [
            await stack.enter_async_context(
                vehicle(
                    envoy.address, vehicle=f"cav-{i}", fields=tmp_path / f"mine{i}",
                    pace=PaceKind.REALTIME, rate=2.0, loop=True, limits=PATIENT,
                    report=tmp_path / f"{i}.jsonl",
                )
            )
            for i in range(VEHICLES)
        ]  # fmt: skip
        await all_go_on(vehicles)

        placed = await settled(envoy, lambda seen: sum(seen.values()) == VEHICLES)
        assert len(placed) == SERVERS
        assert max(placed.values()) <= MOST_OVER_MEAN * VEHICLES / SERVERS, placed
        assert failures(vehicles) == []

        killed = site.servers.pop(0)
        killed.process.kill()
        placed = await settled(
            envoy,
            lambda seen: set(seen) == set(site.addresses) and sum(seen.values()) == VEHICLES,
        )
        assert max(placed.values()) <= MOST_OVER_MEAN * VEHICLES / len(placed), placed
        await all_go_on(vehicles)

        added = await asyncio.to_thread(site.start_server)
        site.list_servers()
        await settled(envoy, lambda seen: set(seen) == set(site.addresses))

        lost = len(failures(vehicles))
        drained = site.servers.pop(0)
        drained.process.send_signal(signal.SIGTERM)
        assert await asyncio.to_thread(drained.process.wait, 60) == 0
        placed = await settled(
            envoy,
            lambda seen: set(seen) == set(site.addresses) and sum(seen.values()) == VEHICLES,
        )
        assert placed[added.address] >= VEHICLES / 4, "the new server took the drained one's"
        await all_go_on(vehicles)
        assert len(failures(vehicles)) == lost, "the drain lost no frame"

    lines = of_all(vehicles)
    assert {line["result"] for line in lines} >= {"acked"}
    for line in lines:
        if line["result"] == "acked":
            assert line["server_digest"] == line["reconstruction_digest"], "the same bytes"
            assert "render" in line["references"], "never a keyframe"


def test_envoy_accepts_the_configuration_and_the_list_of_servers_is_as_the_test_writes_it(
    tmp_path: Path,
) -> None:
    setup = EnvoySetup(envoy_binary(), DEPLOY / "envoy.yaml", tmp_path, port=50050)
    setup.list_servers([f"127.0.0.1:{port}" for port in (50051, 50052, 50053)])
    check_config(setup)
    written, deployed = (
        yaml.safe_load((folder / "servers.yaml").read_text()) for folder in (tmp_path, DEPLOY)
    )
    assert deployed["resources"] == written["resources"]
