"""Agents outlive what happens to a server: gone, back with another field, or of another mind."""

import asyncio
import json
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from live_server import until
from rfcore.wire.conventions import STREAM_METHOD
from rfedge.processes import service


@dataclass
class Agent:
    """A ``cav-agent`` that drives round and round, and what is known of it."""

    process: asyncio.subprocess.Process
    report: Path
    log: Path

    def acked(self) -> int:
        """Return how many pictures were answered."""
        if not self.report.exists():
            return 0
        lines = self.report.read_text().split("\n")[:-1]
        return sum(json.loads(line)["result"] == "acked" for line in lines)

    async def goes_on(self) -> None:
        """Wait for three more answers."""
        before = self.acked()
        await until(lambda: self.acked() >= before + 3 or self.process.returncode is not None)
        assert self.process.returncode is None, self.log.read_text()


@asynccontextmanager
async def running_command(log: Path, *arguments: object) -> AsyncIterator[Any]:
    """Run Python with these arguments until the end of the block."""
    with log.open("ab") as file:
        process = await asyncio.create_subprocess_exec(
            sys.executable, *map(str, arguments), stdout=file, stderr=file
        )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGKILL)
        await process.wait()


@contextmanager
def server_of(store: Path, folder: Path, listen: str = "127.0.0.1:0") -> Iterator[str]:
    """Run a server as a process of its own, and kill it; yield its address."""
    command = [sys.executable, "-m", "mec_server", "--fields", str(store), "--listen", listen]
    with service("mec-server", command, folder) as running:
        yield running.address
        running.process.kill()


@asynccontextmanager
async def agent_at(
    street: Any, folder: Path, address: str, *options: object
) -> AsyncIterator[Agent]:
    report, log, fields = folder / "report.jsonl", folder / "agent.log", folder / "fields"
    fields.mkdir()
    given = {"server": address, "drive": street.drive, "fields": fields}
    arguments = [part for name, value in given.items() for part in (f"--{name}", value)]
    more = ("--rate", 20, "--loop", "--report", report, *options)
    async with running_command(log, "-m", "cav_agent", *arguments, *more) as process:
        yield Agent(process, report, log)


async def test_a_server_that_comes_back_with_another_field_is_followed(
    street: Any, tmp_path: Path
) -> None:
    async with AsyncExitStack() as stack:
        with server_of(street.store, tmp_path) as address:
            agent = await stack.enter_async_context(agent_at(street, tmp_path, address))
            await agent.goes_on()
        stack.enter_context(server_of(street.other_store, tmp_path, address))
        await agent.goes_on()
        assert (tmp_path / "fields" / f"{street.other_id}.rff").exists()


class OnceUnwilling(grpc.GenericRpcHandler):
    """Refuses every stream with FAILED_PRECONDITION, and counts them."""

    def __init__(self) -> None:
        self.refused = 0

    def service(self, handler_call_details: Any) -> Any:
        if handler_call_details.method != STREAM_METHOD:
            return None

        async def refuse(_: object, context: Any) -> None:
            self.refused += 1
            await context.abort(grpc.StatusCode.FAILED_PRECONDITION, "not in this state")

        return grpc.stream_stream_rpc_method_handler(refuse)


async def test_a_failed_precondition_is_outlived_also_by_a_vehicle_that_only_starts(
    street: Any, tmp_path: Path
) -> None:
    unwilling = OnceUnwilling()
    first = grpc.aio.server(options=(("grpc.so_reuseport", 0),))
    first.add_generic_rpc_handlers((unwilling,))
    port = first.add_insecure_port("127.0.0.1:0")
    await first.start()
    address = f"127.0.0.1:{port}"
    stored = ("--field", street.field_id, "--fields", street.store)
    async with agent_at(street, tmp_path, address, *stored) as agent:
        await until(lambda: unwilling.refused >= 2)
        await first.stop(None)
        with server_of(street.store, tmp_path, address):
            await agent.goes_on()


async def test_without_a_server_for_as_long_as_is_given_the_drive_ends(
    street: Any, tmp_path: Path
) -> None:
    async with agent_at(street, tmp_path, "127.0.0.1:1", "--give-up-s", "0.3") as agent:
        assert await agent.process.wait() == 2
    assert "within 0.3 s" in agent.log.read_text()
