"""How an agent ends that cannot go on: one line that says why, and exit status 2."""

import asyncio
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any


async def end_of_agent(street: Any, server: str, *more: str) -> tuple[int, list[str]]:
    """Run an agent to its end; return its status and its lines that are no log entries."""
    given = {"server": server, "drive": street.drive, "fields": street.store}
    given |= {"field": street.field_id, "effort": "fast", "pace": "lockstep"}
    arguments = [part for name, value in given.items() for part in (f"--{name}", str(value))]
    agent = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "cav_agent", *arguments, *more, stderr=subprocess.PIPE
    )
    _, errors = await agent.communicate()
    assert agent.returncode is not None
    lines = errors.decode().splitlines()
    return agent.returncode, [line for line in lines if not line.startswith("{")]


async def test_a_taken_metrics_port_is_named_before_anything_is_sent(
    street: Any, tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = str(holder.getsockname()[1])
        report = tmp_path / "report.jsonl"
        status, lines = await end_of_agent(
            street, "127.0.0.1:1", "--metrics-port", port, "--report", str(report)
        )
    assert status == 2
    (line,) = lines
    assert line.startswith(f"cav-agent: cannot serve metrics on 127.0.0.1:{port}: Address already")
    assert "--metrics-port" in line
    assert not report.exists()


async def test_a_report_that_cannot_be_written_is_named(street: Any, tmp_path: Path) -> None:
    path = tmp_path / "missing" / "report.jsonl"
    status, lines = await end_of_agent(street, "127.0.0.1:1", "--report", str(path))
    assert status == 2
    (line,) = lines
    assert str(path) in line
