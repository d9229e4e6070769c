"""Start, await and stop the demo's processes.

A service says that it is listening by writing HOST:PORT to its ready file; nothing here guesses
ports. A process that ends early is reported with the last lines of its log.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import RfedgeError

__all__ = ["Service", "command_of", "run_to_end", "service"]

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
def service(name: str, command: Sequence[str], work_dir: Path) -> Iterator[Service]:
    """Run a service until the block ends, then stop it with SIGTERM.

    ``--ready-file`` is appended to ``command``. Raises ``RfedgeError`` when the process ends or
    stays silent before it is ready, and when it does not stop within 10 s.
    """
    ready_path, log_path = work_dir / f"{name}.ready.json", work_dir / f"{name}.log"
    ready_path.unlink(missing_ok=True)
    with log_path.open("wb") as log:
        process = subprocess.Popen(
            [*command, "--ready-file", str(ready_path)], stdout=log, stderr=subprocess.STDOUT
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
            raise RfedgeError(
                f"{name} did not end within {timeout_s:.0f} s{_tail(log_path)}"
            ) from None
    if done.returncode != 0:
        raise RfedgeError(f"{name} ended with status {done.returncode}{_tail(log_path)}")


def _await_ready(
    name: str, process: subprocess.Popen[bytes], ready_path: Path, log_path: Path
) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while not ready_path.exists():
        if process.poll() is not None:
            raise RfedgeError(
                f"{name} ended with status {process.returncode} before it was ready"
                f"{_tail(log_path)}"
            )
        if time.monotonic() > deadline:
            raise RfedgeError(f"{name} not ready after {START_TIMEOUT_S:.0f} s{_tail(log_path)}")
        time.sleep(POLL_S)


def _stop(name: str, process: subprocess.Popen[bytes], log_path: Path) -> None:
    process.terminate()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise RfedgeError(
            f"{name} did not stop within {STOP_TIMEOUT_S:.0f} s of SIGTERM{_tail(log_path)}"
        ) from None


def _tail(log_path: Path) -> str:
    lines = log_path.read_text(errors="replace").splitlines()[-LOG_LINES_SHOWN:]
    return "".join(f"\n  {line}" for line in lines)
