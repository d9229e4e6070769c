"""The commands as processes: signals, mistakes, ports, and what they load."""

import asyncio
import json
import shutil
import socket
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from live_server import until
from mec_server.config import ServerConfig
from mec_server.server import EdgeServer
from recorded import recorded
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.settings import MetricsSettings, TransportSettings
from rfedge.processes import Service, service

Process = asyncio.subprocess.Process


async def start(module: str, *arguments: str) -> Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", module, *arguments, stderr=subprocess.PIPE
    )


def server_process(street: Any, folder: Path, *more: str) -> AbstractContextManager[Service]:
    """Run a server as a process of its own."""
    command = [sys.executable, "-m", "mec_server", "--fields", str(street.store), *more]
    return service("mec-server", [*command, "--listen", "127.0.0.1:0"], folder)


def agent_arguments(street: Any, address: str, report: Path) -> list[str]:
    given = {"server": address, "drive": street.drive, "fields": street.store}
    given |= {"camera": "front", "rate": 10, "pace": "lockstep", "field": street.field_id}
    given |= {"effort": "fast", "report": report}
    options = [part for name, value in given.items() for part in (f"--{name}", str(value))]
    return [*options, "--allow-recording"]


def results(report: Path) -> list[str]:
    """Return how each picture ended so far."""
    text = report.read_text() if report.exists() else ""
    return [
        json.loads(line)["result"] for line in text.splitlines(keepends=True) if line[-1] == "\n"
    ]


async def test_a_drive_ends_with_exit_0_and_a_server_told_to_stop_does_too(
    street: Any, tmp_path: Path
) -> None:
    report, saved = tmp_path / "report.jsonl", tmp_path / "saved"
    options = ("--record", str(saved), "--metrics-port", "0")
    with server_process(street, tmp_path, *options) as server:
        agent = await start("cav_agent", *agent_arguments(street, server.address, report))
        _, told = await agent.communicate()
        assert agent.returncode == 0, told
        server.process.terminate()
        assert await asyncio.to_thread(server.process.wait) == 0
    assert results(report) == ["acked"] * 6
    assert len(recorded(saved, "cav-1", "front")) == 6
    for line in server.log_path.read_text().splitlines():
        assert json.loads(line)["level"] in ("info", "warning"), "logs are JSON off a terminal"


async def test_an_agent_told_to_stop_finishes_its_frame_and_ends_cleanly(
    street: Any, tmp_path: Path
) -> None:
    report = tmp_path / "report.jsonl"
    with server_process(street, tmp_path) as server:
        arguments = agent_arguments(street, server.address, report)
        agent = await start("cav_agent", *arguments, "--loop")
        await until(lambda: results(report).count("acked") >= 2 or agent.returncode is not None)
        agent.terminate()
        _, told = await agent.communicate()
        assert agent.returncode == 0, told
    assert set(results(report)) <= {"acked", "dropped"}, "nothing that was encoded was lost"


async def test_a_drive_without_an_acknowledged_picture_is_one_line_and_exit_2(
    street: Any, tmp_path: Path
) -> None:
    drive = tmp_path / "drive"
    shutil.copytree(street.drive, drive)
    for picture in drive.rglob("*.png"):
        picture.write_bytes(picture.read_bytes()[:100])
    with server_process(street, tmp_path) as server:
        arguments = agent_arguments(street, server.address, tmp_path / "report.jsonl")
        arguments[arguments.index("lockstep")] = "realtime"
        arguments[arguments.index("--drive") + 1] = str(drive)
        agent = await start("cav_agent", *arguments)
        _, told = await agent.communicate()
    assert agent.returncode == 2, told.decode()[-1500:]
    (line,) = [line for line in told.decode().splitlines() if not line.startswith("{")]
    assert line.startswith("cav-agent: no picture was acknowledged: ")
    assert "what helps: " in line


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"--server": "192.0.2.1:50051"}, "not encrypted; give --allow-insecure"),
        ({"--drive": "/nonexistent"}, "/nonexistent"),
        ({"--report": "/missing/report.jsonl"}, "/missing/report.jsonl"),
    ],
)
async def test_a_users_mistake_is_one_line_and_exit_2(
    street: Any, tmp_path: Path, change: dict[str, str], named: str
) -> None:
    arguments = agent_arguments(street, "127.0.0.1:1", tmp_path / "report.jsonl")
    for name, value in change.items():
        arguments[arguments.index(name) + 1] = value
    agent = await start("cav_agent", *arguments)
    _, told = await agent.communicate()
    lines = [line for line in told.decode().splitlines() if not line.startswith("{")]
    assert agent.returncode == 2, told.decode()[-1500:]
    assert len(lines) == 1
    assert lines[0].startswith("cav-agent: ")
    assert named in lines[0]


@pytest.mark.parametrize("module", ["cav_agent.__main__", "mec_server.__main__"])
def test_the_services_load_no_heavy_library(module: str) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"torch", "cv2", "matplotlib", "mitsuba", "jinja2"}


async def test_plaintext_is_served_to_this_machine_only_unless_allowed(serve: Any) -> None:
    with pytest.raises(InvalidInput, match=r"listen: 0\.0\.0\.0:0 is not a loopback address"):
        async with serve(listen="0.0.0.0:0"):
            pass
    async with serve(
        listen="0.0.0.0:0",
        sandbox_as_root=True,
        transport=TransportSettings(allow_insecure=True),
    ) as server:
        assert server.address.port > 0


@pytest.mark.parametrize("option", ["--listen", "--metrics-port"])
async def test_a_port_in_use_is_named_without_a_traceback_and_ends_with_status_2(
    street: Any, option: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        listening = ["--listen", f"127.0.0.1:{port}"]
        if option == "--metrics-port":
            listening = ["--listen", "127.0.0.1:0", "--metrics-port", str(port)]
        server = await start("mec_server", "--fields", str(street.store), *listening)
        _, told = await server.communicate()
    assert server.returncode == 2
    assert "Traceback" not in told.decode()
    lines = [line for line in told.decode().splitlines() if not line.startswith("{")]
    assert len(lines) == 1, "nothing of gRPC's or asyncio's own"
    listen = f"mec-server: cannot listen on 127.0.0.1:{port}: Address already in use; "
    metrics = f"mec-server: cannot serve metrics on 127.0.0.1:{port}: Address already in use; "
    assert lines[0].startswith(listen if option == "--listen" else metrics)
    assert f"give another {option}" in lines[0]


def is_served(server: EdgeServer) -> bool:
    """Whether somebody listens on the port of the server's metrics."""
    endpoint = server._metrics_endpoint
    assert endpoint is not None
    try:
        socket.create_connection(("127.0.0.1", endpoint.port)).close()
    except ConnectionRefusedError:
        return False
    return True


async def test_a_server_gives_its_ports_back_when_it_stops_or_cannot_start(
    serve: Any, street: Any
) -> None:
    metrics = MetricsSettings(port=0)
    async with serve(metrics=metrics) as first:
        assert is_served(first)
        config = ServerConfig(street.store, str(first.address), metrics=metrics)
        second = EdgeServer(config)
        with pytest.raises(RfedgeError, match="cannot listen"):
            await second.start()
        assert not is_served(second)
        assert is_served(first)
    assert not is_served(first)


NO_FIELDS = "no fields to serve: every vehicle will be refused"


async def test_a_server_without_fields_warns_and_takes_up_those_that_come(
    serve: Any, street: Any, travel: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    with capture_logs() as logs:
        async with serve(fields=folder) as server:
            (warning,) = [line for line in logs if line["event"] == NO_FIELDS]
            assert warning["log_level"] == "warning"
            assert warning["folder"] == str(folder)
            assert "put field archives (.rff) into this folder" in warning["remedy"]
            shutil.copy(street.store / "street.rff", folder)
            async with asyncio.timeout(30):
                while not any(line["event"] == "fields listed" for line in logs):
                    await asyncio.sleep(0.02)
            assert (await travel(server.address)).counts == {"acked": 6}
