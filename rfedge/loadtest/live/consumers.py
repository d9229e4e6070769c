"""Consumers of the twin, each on a thread and a channel of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import grpc

from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.v1 import twin_pb2, twin_pb2_grpc

__all__ = ["Consumer", "watching"]

END_S = 10.0


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
