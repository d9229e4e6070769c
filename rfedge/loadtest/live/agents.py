"""A vehicle's agent as a process, which has no address to wait for."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rfcore.errors import RfedgeError
from rfedge.demo.processes import command_of

__all__ = ["agent"]

STOP_S = 20.0


@contextmanager
def agent(name: str, arguments: Sequence[str], work: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``cav-agent`` until the block ends; its log is NAME.log.

    Raises ``RfedgeError`` if it has ended by then, or does not end within 20 s of SIGTERM.
    """
    log_path = work / f"{name}.log"
    with log_path.open("wb") as log:
        command = [*command_of("cav-agent"), *arguments, "--vehicle", name]
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        yield process
        if process.poll() is not None:
            raise RfedgeError(f"{name} ended early; see {log_path}")
    finally:
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise RfedgeError(f"{name} did not end; see {log_path}") from None
