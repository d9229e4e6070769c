"""Reads the twins of servers in threads, for experiments that measure what consumers get."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import grpc

from rfcore.errors import RfedgeError
from rfcore.wire.twin import Subscription, TwinPicture
from rfcore.wire.twin_client import TwinClient

END_S = 20.0


class TwinReader:
    """Hands every picture of a server's twin to ``take`` in a thread, inside ``with``.

    A server that ends or is killed has been read to its end; ``problem`` is set for any other end.
    """

    def __init__(
        self,
        address: str,
        take: Callable[[TwinPicture], object],
        subscription: Subscription | None = None,
    ) -> None:
        self.problem: RfedgeError | None = None
        self._take, self._subscription = take, subscription
        self._client = TwinClient(address)
        self._connected = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"twin {address}", daemon=True)

    def __enter__(self) -> TwinReader:
        self._thread.start()
        self._connected.wait()
        return self

    def __exit__(self, *_: object) -> None:
        self._client.stop()
        self._thread.join(END_S)
        self._client.close()

    def _read(self) -> None:
        try:
            for message in self._client.watch(self._subscription, lambda _: self._connected.set()):
                if isinstance(message, TwinPicture):
                    self._take(message)
        except RfedgeError as error:
            call = error.__cause__
            if not (isinstance(call, grpc.Call) and call.code() is grpc.StatusCode.UNAVAILABLE):
                self.problem = error
        finally:
            self._connected.set()


@contextmanager
def reading(address: str, take: Callable[[TwinPicture], object], count: int = 1) -> Iterator[None]:
    """Read a twin with ``count`` consumers, pictures as JPEG, until the block ends."""
    with ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(TwinReader(address, take))
        yield
