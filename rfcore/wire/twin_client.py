"""Clients of a server's twin: pictures as they are reconstructed, objects, and rendered views.

``TwinClient`` is for threads, ``AsyncTwinClient`` for an event loop. Both connect to one server,
in plaintext only on this machine unless that is allowed. What goes wrong is an ``RfedgeError``:
``AccessDenied`` where waiting does not help, ``ProtocolError`` for an impossible answer.
"""

from __future__ import annotations

import threading
import time
from collections.abc import AsyncIterator, Callable, Generator, Iterable, Iterator
from types import TracebackType
from typing import Any

import grpc

from rfcore.errors import AccessDenied, RfedgeError
from rfcore.wire.address import ASK_AFTER_S, Address, check_handshake
from rfcore.wire.conventions import CONSUMER_OPTIONS, MAY_SEE
from rfcore.wire.tls import TlsFiles
from rfcore.wire.twin import (
    Departure,
    Subscription,
    TwinPicture,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.twin_render import (
    ObjectsRequest,
    ObjectsSeen,
    RenderedView,
    ViewRequest,
    objects_from_wire,
    objects_request_to_wire,
    rendered_view_from_wire,
    view_request_to_wire,
)
from rfcore.wire.v1 import twin_pb2_grpc

CONNECT_S = 10.0
RENDER_TIMEOUT_S = 30.0
Metadata = Iterable[tuple[str, str | bytes]]
REFUSED = (
    grpc.StatusCode.PERMISSION_DENIED,
    grpc.StatusCode.UNAUTHENTICATED,
    grpc.StatusCode.UNIMPLEMENTED,
)
"""Statuses that do not pass by waiting."""


def twin_error(error: grpc.RpcError) -> RfedgeError:
    """Return a failed call as one of our errors."""
    if not isinstance(error, grpc.Call | grpc.aio.AioRpcError):
        return RfedgeError(str(error))
    kind = AccessDenied if error.code() in REFUSED else RfedgeError
    return kind(f"{error.code().name.lower()}: {error.details()}")


class TwinClient:
    """Watches one server's twin and asks it for views; for threads.

    >>> from rfcore.wire.twin import TwinPicture
    >>> from rfcore.wire.twin_client import TwinClient
    >>> with TwinClient("127.0.0.1:50051") as twin:
    ...     for message in twin.watch():
    ...         if isinstance(message, TwinPicture):
    ...             print(message.vehicle_id, message.camera_id, message.rgb.shape)
    cav-1 front (360, 640, 3)

    Raises ``InvalidInput`` for an address that is none, and for plaintext to another machine unless
    ``allow_insecure``.
    """

    def __init__(
        self, address: str, tls: TlsFiles | None = None, *, allow_insecure: bool = False
    ) -> None:
        self.address = _checked(address, tls, allow_insecure)
        self._tls = tls
        self._channel: grpc.Channel = _channel(self.address, tls, grpc)
        self._lock = threading.Lock()
        self._stopped = False
        self._call: grpc.Call | None = None

    def __enter__(self) -> TwinClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()

    def watch(
        self,
        subscription: Subscription | None = None,
        connected: Callable[[str], None] = lambda _: None,
        problem: Callable[[str], None] = lambda _: None,
    ) -> Generator[TwinPicture | Departure, None, None]:
        """Yield pictures and departures until the server ends the stream, or ``stop``.

        The newest picture of each camera comes first; a reader that is slow misses pictures. By
        default pictures of all vehicles come, as JPEG. ``connected`` is called once the server has
        accepted the call, with what the certificate may see, "" for everything; ``problem``, on any
        thread, with why there is no connection yet. Raises ``RfedgeError`` if no server answers
        within ``CONNECT_S``.
        """
        request = subscription_to_wire(subscription or Subscription())
        stub = twin_pb2_grpc.TwinServiceStub(self._channel)
        with self._lock:
            if self._stopped:
                return
            self._call = call = stub.Watch(request, wait_for_ready=True)
        try:
            self._wait_for_server(call, problem)
            connected(_may_see(call.initial_metadata()))
            for response in call:
                if self._stopped:
                    return
                yield twin_message_from_wire(response)
        except grpc.RpcError as error:
            if not self._stopped:
                raise twin_error(error) from error
        finally:
            call.cancel()

    def stop(self) -> None:
        """End ``watch``; may be called from any thread, and before ``watch``."""
        with self._lock:
            self._stopped = True
            if self._call is not None:
                self._call.cancel()

    def render(self, request: ViewRequest) -> RenderedView:
        """Return the street as it is from one viewpoint."""
        stub = twin_pb2_grpc.TwinServiceStub(self._channel)
        try:
            answer = stub.Render(view_request_to_wire(request), timeout=RENDER_TIMEOUT_S)
        except grpc.RpcError as error:
            raise twin_error(error) from error
        return rendered_view_from_wire(answer, request.camera.intrinsics)

    def objects(self, request: ObjectsRequest) -> Iterator[ObjectsSeen]:
        """Yield what stands on the ground of a tile and is not in its field, with each picture.

        Ends when the client is closed.
        """
        call = twin_pb2_grpc.TwinServiceStub(self._channel).Objects(
            objects_request_to_wire(request)
        )
        try:
            for response in call:
                yield objects_from_wire(response)
        except grpc.RpcError as error:
            if not self._stopped:
                raise twin_error(error) from error
        finally:
            call.cancel()

    def _wait_for_server(self, call: grpc.Call, tell: Callable[[str], None]) -> None:
        """Wait until the server answers, or the call is cancelled; raise ``RfedgeError``."""
        answered = threading.Event()
        problems: list[RfedgeError] = []

        def ask() -> None:
            problem = ""
            end_s = time.monotonic() + CONNECT_S
            while (left_s := end_s - time.monotonic()) > 0:
                if answered.wait(min(ASK_AFTER_S, left_s)) or self._stopped:
                    return
                before = problem
                try:
                    problem = check_handshake(self.address, self._tls)
                except AccessDenied as error:
                    problems.append(error)
                    break
                if problem != before and not answered.is_set():
                    tell(f"{problem} (tried again for {CONNECT_S:g} s)")
            cause = f": {problem}" if problem else ""
            no_server = f"no server at {self.address} within {CONNECT_S:g} s{cause}"
            problems.append(RfedgeError(no_server))
            call.cancel()

        asking = threading.Thread(target=ask, name="asking", daemon=True)
        asking.start()
        try:
            call.initial_metadata()
        finally:
            answered.set()
        if problems and not self._stopped:
            raise problems[0]


class AsyncTwinClient:
    """``TwinClient`` for an event loop; connected inside of ``async with``.

    Waits for a server that is not there yet. Raises as ``TwinClient`` does.
    """

    def __init__(
        self, address: str, tls: TlsFiles | None = None, *, allow_insecure: bool = False
    ) -> None:
        self.address = _checked(address, tls, allow_insecure)
        self._tls = tls
        self._channel: grpc.aio.Channel | None = None

    async def __aenter__(self) -> AsyncTwinClient:
        self._channel = _channel(self.address, self._tls, grpc.aio)
        return self

    async def __aexit__(self, *_: object) -> None:
        channel, self._channel = self._channel, None
        if channel is not None:
            await channel.close()

    @property
    def channel(self) -> grpc.aio.Channel:
        """The connection, for the server's other services; raises ``RfedgeError`` if closed."""
        if self._channel is None:
            raise RfedgeError("there is no connection to the server")
        return self._channel

    def connection_problem(self) -> str:
        """Make a connection, blocking; return why there is none, "" if there is one.

        Raises ``AccessDenied`` if the ends refuse each other.
        """
        return check_handshake(self.address, self._tls)

    async def watch(
        self,
        subscription: Subscription | None = None,
        connected: Callable[[str], None] = lambda _: None,
    ) -> AsyncIterator[TwinPicture | Departure]:
        """Yield pictures and departures until the server ends the stream.

        ``connected`` is called once the server has accepted the call, with what may be seen.
        """
        request = subscription_to_wire(subscription or Subscription())
        stub = twin_pb2_grpc.TwinServiceStub(self.channel)
        call = stub.Watch(request, wait_for_ready=True)
        try:
            connected(_may_see(await call.initial_metadata() or ()))
            async for response in call:
                yield twin_message_from_wire(response)
        except grpc.aio.AioRpcError as error:
            raise twin_error(error) from error
        finally:
            call.cancel()

    async def objects(self, request: ObjectsRequest) -> AsyncIterator[ObjectsSeen]:
        """Yield what stands on the ground of a tile and is not in its field, with each picture."""
        call = twin_pb2_grpc.TwinServiceStub(self.channel).Objects(objects_request_to_wire(request))
        try:
            async for response in call:
                yield objects_from_wire(response)
        except grpc.aio.AioRpcError as error:
            raise twin_error(error) from error
        finally:
            call.cancel()


def _may_see(stated: Metadata) -> str:
    """Return what a server states that the caller may see, "" for everything."""
    return next((str(value) for key, value in stated if key == MAY_SEE), "")


def _checked(address: str, tls: TlsFiles | None, allow_insecure: bool) -> Address:
    parsed = Address.parse("address", address)
    if tls is None:
        parsed.require_private("address", allow_insecure)
    return parsed


def _channel(address: Address, tls: TlsFiles | None, api: Any) -> Any:
    """Return a channel of ``api``: ``grpc`` for threads, or ``grpc.aio``."""
    if tls is None:
        return api.insecure_channel(str(address), options=CONSUMER_OPTIONS)
    return api.secure_channel(str(address), tls.channel_credentials(), options=CONSUMER_OPTIONS)
