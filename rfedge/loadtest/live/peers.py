"""Who talks to the server: agents as processes of their own, consumers of the twin as threads."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import grpc

from rfcore.errors import RfedgeError
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.v1 import twin_pb2, twin_pb2_grpc
from rfedge.demo.processes import command_of

__all__ = ["Consumer", "agent", "watching"]

STOP_S = 20.0
END_S = 10.0


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


class Consumer:
    """Reads all pictures of a server as JPEG; ``ages_ms`` [N]: from capture until it had them."""

    def __init__(self, address: str) -> None:
        self.ages_ms: list[float] = []
        self._channel = grpc.insecure_channel(address, options=CONSUMER_OPTIONS)
        self._call = twin_pb2_grpc.TwinServiceStub(self._channel).Watch(
            twin_pb2.WatchRequest(), wait_for_ready=True
        )
        self._thread = threading.Thread(target=self._read, name="consumer", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with suppress(grpc.RpcError):  # the server, or this consumer, has ended
            for response in self._call:
                if response.HasField("picture"):
                    age_ns = time.time_ns() - response.picture.capture_time_ns
                    self.ages_ms.append(age_ns / 1e6)

    def close(self) -> None:
        """End."""
        self._call.cancel()
        self._thread.join(END_S)
        self._channel.close()


@contextmanager
def watching(address: str, count: int) -> Iterator[list[Consumer]]:
    """Watch with ``count`` consumers until the block ends."""
    with ExitStack() as stack:
        consumers = [Consumer(address) for _ in range(count)]
        for consumer in consumers:
            stack.callback(consumer.close)
        yield consumers
