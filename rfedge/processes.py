"""Start, await and stop the project's commands as processes of this machine.

A service says that it listens by writing HOST:PORT to its ready file, so nothing here guesses
ports. A process that ends early is reported with the last lines of its log.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import RfedgeError

START_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 10.0
POLL_S = 0.02
LOG_LINES_SHOWN = 12


@dataclass(frozen=True)
class Service:
    """A running process that listens at ``address`` (host:port)."""

    name: str
    process: subprocess.Popen[bytes]
    address: str
    log_path: Path


def command_of(name: str) -> list[str]:
    """Return how to start one of the project's commands with this interpreter's installation."""
    return [str(Path(sys.executable).parent / name)]


@contextmanager
def service(
    name: str, command: Sequence[str], work_dir: Path, variables: Mapping[str, str] | None = None
) -> Iterator[Service]:
    """Run a service until the block ends, then stop it with SIGTERM.

    ``--ready-file`` is appended to ``command``; ``variables`` are added to its environment. Raises
    ``RfedgeError`` when the process ends or stays silent before it is ready, and when it does not
    stop within 10 s.
    """
    ready_path, log_path = work_dir / f"{name}.ready.json", work_dir / f"{name}.log"
    ready_path.unlink(missing_ok=True)
    with log_path.open("wb") as log:
        process = subprocess.Popen(
            [*command, "--ready-file", str(ready_path)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **(variables or {})},
        )
        try:
            _await_ready(name, process, ready_path, log_path)
            yield Service(name, process, ready_path.read_text().strip(), log_path)
        finally:
            _stop(name, process, log_path)


def run_to_end(name: str, command: Sequence[str], work_dir: Path, timeout_s: float) -> None:
    """Run a command that ends by itself; raise ``RfedgeError`` if it fails or runs over."""
    log_path = work_dir / f"{name}.log"
    with log_path.open("wb") as log:
        try:
            done = subprocess.run(
                list(command), stdout=log, stderr=subprocess.STDOUT, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            raise _failure(f"{name} did not end within {timeout_s:.0f} s", log_path) from None
    if done.returncode != 0:
        raise _failure(f"{name} ended with status {done.returncode}", log_path)


def _await_ready(
    name: str, process: subprocess.Popen[bytes], ready_path: Path, log_path: Path
) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while not ready_path.exists():
        if process.poll() is not None:
            status = process.returncode
            raise _failure(f"{name} ended with status {status} before it was ready", log_path)
        if time.monotonic() > deadline:
            raise _failure(f"{name} not ready after {START_TIMEOUT_S:.0f} s", log_path)
        time.sleep(POLL_S)


def _stop(name: str, process: subprocess.Popen[bytes], log_path: Path) -> None:
    process.terminate()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        problem = f"{name} did not stop within {STOP_TIMEOUT_S:.0f} s of SIGTERM"
        raise _failure(problem, log_path) from None


def _failure(problem: str, log_path: Path) -> RfedgeError:
    """Return the error for a problem, with the last lines of the log."""
    lines = log_path.read_text(errors="replace").splitlines()[-LOG_LINES_SHOWN:]
    return RfedgeError(problem + "".join(f"\n  {line}" for line in lines))
