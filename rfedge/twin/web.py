"""``rfedge twin``: the page over HTTP and one WebSocket a browser (aiohttp).

A browser says what its user looks at; everything else flows one way. Access: from this machine
alone, unless a token is set. Whatever the token, a WebSocket is opened only by the page itself, so
that no other site in the same browser can read the street (cross-site WebSocket hijacking).
"""

from __future__ import annotations

import asyncio
import hmac
import json
import os
import signal
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import structlog

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.field import SplatField
from rfcore.files import write_whole
from rfcore.perception.objects import CameraKey
from rfcore.wire.address import Address
from rfcore.wire.twin_render import ViewRequest
from rfedge.twin.comparing import Comparer
from rfedge.twin.drive_source import DriveSource
from rfedge.twin.scene import Board, Message, Reader, TwinScene
from rfedge.twin.sensorsim import Sensorsim
from rfedge.twin.server_source import ServerSource

with needs("twin"):
    from aiohttp import WSCloseCode, WSMsgType, web

log = structlog.get_logger()

PAGE: Final = Path(__file__).parent / "page"
MAX_BROWSERS: Final = 16
MAX_CONNECTIONS: Final = 128
"""A browser opens up to six beside its socket; those beyond are closed at once."""
FIRST_REQUEST_S: Final = 5.0
"""A connection that has sent no whole request by then is closed; so is one idle for KEPT_S."""
KEPT_S: Final = 15.0
LONGEST_REQUEST_BYTES: Final = 4096
HEARTBEAT_S: Final = 10.0
EXIT_SEEN_S: Final = 1.0
STALLED_S: Final = 10.0
"""A browser that takes nothing for this long is disconnected; it connects again by itself."""
HEALTH: Final = "/healthy"
"""Answers without a token, for supervisors that restart a service; discloses nothing else."""
COOKIE: Final = "rfedge-twin"
SHORTEST_TOKEN: Final = 16
POLICY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "worker-src 'self' blob: data:; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self' blob: data:; frame-ancestors 'none'"
)
"""The splat library starts workers from blobs and WebAssembly from a data URL."""
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(frozen=True)
class WebSettings:
    """The address to listen at, and the token that a browser must send (None: none, loopback
    only)."""

    address: Address
    token: str | None = None

    def __post_init__(self) -> None:
        if self.token is None and not self.address.is_loopback:
            raise InvalidInput(
                "http", f"{self.address} can be reached from other machines; give a token"
            )
        if self.token is not None and len(self.token) < SHORTEST_TOKEN:
            raise InvalidInput(
                "token", f"has {len(self.token)} characters, fewer than {SHORTEST_TOKEN}"
            )


@dataclass(frozen=True)
class Select:
    """The browser's user views this camera in full; ``None``: none."""

    camera: CameraKey | None


@dataclass(frozen=True)
class Look:
    """The browser shows the live view from here; ``None``: none any more."""

    request: ViewRequest | None


@dataclass(frozen=True)
class ShowObjects:
    """Whether the browser shows objects."""

    shown: bool


class TwinWeb:
    """Serves the page, its splats, and the board's messages; with ``live`` also objects and views
    from anywhere."""

    def __init__(
        self,
        settings: WebSettings,
        board: Board,
        scene: TwinScene,
        comparer: Comparer,
        clock: Callable[[], float] = time.monotonic,
        live: ServerSource | None = None,
    ) -> None:
        self._settings = settings
        self._live = live
        self._board = board
        self._scene = scene
        self._comparer = comparer
        self._clock = clock
        self._browsers: set[web.WebSocketResponse] = set()
        self._runner: web.AppRunner | None = None
        self._listening: asyncio.Server | None = None
        self._silent: set[asyncio.Protocol] = set()

    async def start(self) -> str:
        """Listen; return the page's address. Raises ``RfedgeError`` where the port is taken."""
        address = self._settings.address
        address.check_free("--http")
        app = web.Application(middlewares=[self._guarded])
        app.router.add_get("/", self._page)
        app.router.add_get(HEALTH, self._healthy)
        app.router.add_get("/socket", self._socket)
        app.router.add_get("/splats/{field}.spz", self._splats)
        app.router.add_static("/page", PAGE)
        self._runner = web.AppRunner(app, access_log=None, keepalive_timeout=KEPT_S)
        await self._runner.setup()
        loop = asyncio.get_running_loop()
        self._listening = await loop.create_server(self._connection, address.host, address.port)
        port = self._listening.sockets[0].getsockname()[1]
        query = f"?token={self._settings.token}" if self._settings.token else ""
        return f"http://{Address(address.host, port)}/{query}"

    async def stop(self) -> None:
        """Close every browser's socket and the port."""
        for socket in tuple(self._browsers):
            await socket.close(code=WSCloseCode.GOING_AWAY, message=b"rfedge twin ends")
        if self._listening is not None:
            self._listening.close()
        if self._runner is not None:
            await self._runner.cleanup()

    def _connection(self) -> asyncio.Protocol:
        """Make the protocol of a new connection, which is given little time and no more than there
        is room for."""
        assert self._runner is not None
        server = self._runner.server
        assert server is not None
        if len(server.connections) >= MAX_CONNECTIONS:
            return _Refused()
        handler = server()
        self._silent.add(handler)
        asyncio.get_running_loop().call_later(FIRST_REQUEST_S, self._close_silent, handler)
        return handler

    def _close_silent(self, handler: web.RequestHandler) -> None:
        if handler in self._silent:
            self._silent.discard(handler)
            if handler.transport is not None:
                handler.transport.abort()

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse browsers without the token; set the headers that restrict the page."""
        self._silent.discard(request.protocol)
        if request.path != HEALTH and not self._is_known(request):
            raise web.HTTPForbidden(text="this page needs its token: /?token=...\n")
        response = await handler(request)
        if not response.prepared:
            response.headers["Content-Security-Policy"] = POLICY
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["X-Content-Type-Options"] = "nosniff"
            if request.query.get("token") and request.path != HEALTH:
                response.set_cookie(
                    COOKIE, request.query["token"], httponly=True, samesite="Strict"
                )
        return response

    def _is_known(self, request: web.Request) -> bool:
        token = self._settings.token
        if token is None:  # a name that resolves to this machine is no proof (DNS rebinding)
            return _host(request.host).is_loopback
        given = request.query.get("token") or request.cookies.get(COOKIE) or ""
        return hmac.compare_digest(given.encode(errors="backslashreplace"), token.encode())

    async def _healthy(self, _: web.Request) -> web.StreamResponse:
        return web.Response(text="ok\n")

    async def _page(self, _: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _splats(self, request: web.Request) -> web.StreamResponse:
        placed = self._scene.field(request.match_info["field"])
        if placed is None or not placed.spz:
            raise web.HTTPNotFound(text="no splats of this field\n")
        headers = {"Cache-Control": "private, max-age=86400, immutable"}
        return web.Response(
            body=placed.spz, content_type="application/octet-stream", headers=headers
        )

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        origin = request.headers.get("Origin", "")
        if origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text="a socket is opened by the page alone\n")
        if len(self._browsers) >= MAX_BROWSERS:
            raise web.HTTPServiceUnavailable(text=f"{MAX_BROWSERS} browsers look already\n")
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=LONGEST_REQUEST_BYTES, compress=False
        )
        await socket.prepare(request)
        self._browsers.add(socket)
        try:
            await self._serve(socket)
        finally:
            self._browsers.discard(socket)
        return socket

    async def _serve(self, socket: web.WebSocketResponse) -> None:
        arrived = asyncio.Event()
        reader = self._board.read(arrived.set)
        if self._live is not None:
            reader.put("abilities", Message({"kind": "abilities", "live": True}, self._clock()))
        writing = asyncio.create_task(self._write(socket, reader, arrived))
        user = _User(self._comparer, self._live, reader)
        try:
            await self._listen(socket, user)
        finally:
            user.leave()
            writing.cancel()
            self._board.leave(reader)

    async def _write(
        self, socket: web.WebSocketResponse, reader: Reader, arrived: asyncio.Event
    ) -> None:
        while True:
            message = reader.take()
            if message is None:
                arrived.clear()
                await arrived.wait()
                continue
            data = message.encode(self._clock())
            try:
                await asyncio.wait_for(socket.send_bytes(data), STALLED_S)
            except (TimeoutError, ConnectionError):
                log.info("browser let go", missed=reader.missed)
                await socket.close(code=WSCloseCode.TRY_AGAIN_LATER)
                return

    async def _listen(self, socket: web.WebSocketResponse, user: _User) -> None:
        """Follow the browser's selections until it leaves."""
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT:
                    user.take(wish(message.data))
        except ValueError as error:
            log.info("browser sent what the page does not", problem=str(error))
            await socket.close(code=WSCloseCode.POLICY_VIOLATION)


class _Refused(asyncio.Protocol):
    """Closes a connection that there is no room for."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


class _User:
    """The interests of one browser's user: a camera, objects, a live view."""

    def __init__(self, comparer: Comparer, live: ServerSource | None, reader: Reader) -> None:
        self._comparer = comparer
        self._live = live
        self._camera: CameraKey | None = None
        self._shows_objects = False
        self._view = live.open_view(lambda message: reader.put("view", message)) if live else None

    def take(self, wished: Select | Look | ShowObjects) -> None:
        """Follow a message of the browser."""
        match wished:
            case Select(camera):
                self._select(camera)
            case Look(request) if self._view is not None:
                self._view.look(request)
            case ShowObjects(shown) if self._live is not None and shown != self._shows_objects:
                self._shows_objects = shown
                self._live.want_objects(shown)

    def leave(self) -> None:
        """Let go of everything."""
        self._select(None)
        self.take(ShowObjects(False))
        if self._view is not None:
            self._view.close()

    def _select(self, camera: CameraKey | None) -> None:
        if self._camera is not None:
            self._comparer.release(self._camera)
        self._camera = camera
        if camera is not None:
            self._comparer.select(camera)


def wish(text: str) -> Select | Look | ShowObjects:
    """Return the request in a browser's message; raise ``ValueError`` (which ``InvalidInput`` is)
    for anything that the page does not send.

    A message has one member: ``select`` is null or [vehicle, camera]; ``objects`` a boolean;
    ``look`` null, or the ``field`` and a camera relative to its tile: ``translation_m``,
    ``rotation_wxyz``, and ``intrinsics`` by the names of ``Intrinsics``.
    """
    try:
        message = json.loads(text)
    except RecursionError as error:
        raise ValueError("a message is nested too deep") from error
    match message:
        case {"select": None, **rest} if not rest:
            return Select(None)
        case {"select": [str(vehicle), str(camera)], **rest} if not rest:
            return Select((vehicle, camera))
        case {"objects": bool(shown), **rest} if not rest:
            return ShowObjects(shown)
        case {"look": None, **rest} if not rest:
            return Look(None)
        case {"look": dict() as place, **rest} if not rest:
            return Look(_viewpoint(place))
    raise ValueError("a message has one member: select, objects or look")


def _viewpoint(place: dict[str, Any]) -> ViewRequest:
    try:
        intrinsics = Intrinsics(**place["intrinsics"])
        if type(intrinsics.width_px) is not int or type(intrinsics.height_px) is not int:
            raise InvalidInput("intrinsics", "width and height are whole numbers of pixels")
        pose = Pose(tuple(place["translation_m"]), tuple(place["rotation_wxyz"]))
        return ViewRequest(Camera(intrinsics, pose), field_id=place["field"])
    except (KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"look: {error!r}") from error


def _host(host_and_port: str) -> Address:
    """Return the host of an HTTP header, with or without a port, brackets taken off."""
    bare = host_and_port if host_and_port.endswith("]") else host_and_port.rpartition(":")[0]
    return Address((bare or host_and_port).strip("[]"), 0)


class Source(Protocol):
    """A source of fields and pictures; ``live``: whether it can show more."""

    @property
    def live(self) -> ServerSource | None:
        """The source itself, if it shows objects and views from anywhere."""

    def run(self) -> Coroutine[Any, Any, None]:
        """Show things in the scene, until cancelled."""


@dataclass(frozen=True)
class TwinRun:
    """Settings of ``rfedge twin``; ``source`` makes the source for a scene."""

    web: WebSettings
    source: Callable[[TwinScene], Source]
    ready_file: Path | None = None
    """Written with the page's address once it can be opened."""
    until_exit_of: int | None = None
    """A process at whose end this one ends, too."""
    sensorsim: Address | None = None
    """Where simulators ask for pictures."""
    shapes: Mapping[str, SplatField] = field(default_factory=dict)
    """The fields of a simulator's objects, by their ids."""


def run_twin(run: TwinRun) -> None:
    """Serve until SIGINT or SIGTERM; raises what the source raises."""
    asyncio.run(_serve(run))


async def _serve(run: TwinRun) -> None:
    board = Board()
    scene = TwinScene(board)
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    with ThreadPoolExecutor(1, "compare") as executor:
        comparer = Comparer(scene, executor)
        source = run.source(scene)
        simulators = await _for_simulators(run, scene, source)
        page = TwinWeb(run.web, board, scene, comparer, live=source.live)
        address = await page.start()
        print(f"open {address}", flush=True)
        if run.ready_file is not None:
            write_whole(run.ready_file, address.encode())
        tasks = [
            asyncio.create_task(source.run()),
            asyncio.create_task(comparer.run()),
            asyncio.create_task(stopped.wait()),
            *([asyncio.create_task(_exit_of(run.until_exit_of))] if run.until_exit_of else []),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            if simulators is not None:
                await simulators.stop()
            await page.stop()


async def _for_simulators(run: TwinRun, scene: TwinScene, source: Source) -> Sensorsim | None:
    """Serve simulators, if that is asked for; they are offered a drive's cameras and poses."""
    if run.sensorsim is None:
        return None
    drive = source.pictures if isinstance(source, DriveSource) else ()
    service = Sensorsim(run.sensorsim, scene, drive, run.shapes)
    print(f"simulators: {await service.start()}", flush=True)
    return service


async def _exit_of(pid: int) -> None:
    """Wait until a process has ended."""
    while _runs(pid):
        await asyncio.sleep(EXIT_SEEN_S)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it runs as another user
        return True
    return True
