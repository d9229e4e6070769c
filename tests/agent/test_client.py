"""A stream to one server, with the server in memory: what is retried, what is final, who hears."""

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import grpc
import pytest

from cav_agent.client import CameraSource, CameraTaken, FieldNotServed, StreamClient
from cav_agent.config import AgentLimits
from cav_agent.frames import (
    Capture,
    EncodedFrame,
    EncodeJob,
    EndReason,
    FrameResult,
    Outcome,
    RetryReason,
)
from cav_agent.rate_control import RateControl
from cav_agent.session import AgentSession
from rfcore.errors import CodecError, ProtocolError, RejectReason, RfedgeError
from rfcore.wire.conventions import TILE, VEHICLE
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.convert_answers import AnswerWriter
from rfcore.wire.head import FrameReader
from rfcore.wire.messages import (
    Ack,
    Credit,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.notices import StreetNotice

Answer = Callable[[Hello | Frame], list[ServerMessage] | grpc.aio.AioRpcError | None]
TAKEN = "camera_taken: another agent sends camera front of vehicle cav-1; stop it"


def welcoming(message: Hello | Frame) -> list[ServerMessage]:
    """Welcome whoever comes, and acknowledge every frame."""
    if isinstance(message, Hello):
        return [Welcome("s-1", exact=True, rate_hz=5.0), Credit("front", 2)]
    granted = message.address.sequence + 3
    return [Ack(message.address, StageTimes(), b"digest"), Credit("front", granted)]


def refusal(
    code: grpc.StatusCode, details: str, *trailing: tuple[str, str]
) -> grpc.aio.AioRpcError:
    return grpc.aio.AioRpcError(
        code, grpc.aio.Metadata(), grpc.aio.Metadata(*trailing), details=details
    )


class MemoryStream:
    """A call whose server answers every message at once."""

    def __init__(self, answer: Answer) -> None:
        self.received: list[Hello | Frame] = []
        self._answer = answer
        self._down: asyncio.Queue[bytes | BaseException | None] = asyncio.Queue()

    async def write(self, data: bytes) -> None:
        message = client_message_from_bytes(data)
        if isinstance(message, Hello):
            self._reader = FrameReader(message)
            self._writer = AnswerWriter(camera.camera_id for camera in message.cameras)
        else:
            message = self._reader.read(message)
        self.received.append(message)
        answer = self._answer(message)
        if isinstance(answer, list):
            for entry in self._writer.messages(answer):
                self._down.put_nowait(entry)
        else:
            self._down.put_nowait(answer)

    async def done_writing(self) -> None:
        self._down.put_nowait(None)

    def cancel(self) -> None:
        self._down.put_nowait(asyncio.CancelledError())

    async def __aiter__(self) -> AsyncIterator[bytes]:
        while (entry := await self._down.get()) is not None:
            if isinstance(entry, BaseException):
                raise entry
            yield entry


class MemoryServer:
    """Stands for ``ServerConnection``; ``answers`` are one per stream, the last for all others."""

    def __init__(self, *answers: Answer) -> None:
        self.fields_changed = asyncio.Event()
        self.streams: list[MemoryStream] = []
        self.metadata: list[tuple[tuple[str, str], ...]] = []
        self._answers = deque(answers)

    @property
    def channel(self) -> "MemoryServer":
        return self

    async def wait_until_ready(self, within_s: float | None) -> None:
        if within_s is not None and within_s < 0:
            raise TimeoutError

    def stream_stream(self, method: str) -> Callable[..., MemoryStream]:
        assert method == "/rfcore.wire.v1.EdgeService/Stream"

        def call(metadata: tuple[tuple[str, str], ...]) -> MemoryStream:
            self.metadata.append(metadata)
            answer = self._answers.popleft() if len(self._answers) > 1 else self._answers[0]
            self.streams.append(MemoryStream(answer))
            return self.streams[-1]

        return call

    @property
    def frames(self) -> list[Frame]:
        received = [message for stream in self.streams for message in stream.received]
        return [message for message in received if isinstance(message, Frame)]


@dataclass
class Heard:
    """The owner and observer of a client; keeps what it was told."""

    results: list[FrameResult] = field(default_factory=list)
    connections: list[bool] = field(default_factory=list)
    retries: list[RetryReason] = field(default_factory=list)
    unknown: int = 0
    on_result: Callable[[], None] = lambda: None

    def ended(self, result: FrameResult) -> None:
        self.results.append(result)
        self.on_result()

    def welcomed(self) -> None:
        assert self.connections[-1]

    def connected(self, is_connected: bool) -> None:
        self.connections.append(is_connected)

    def retrying(self, reason: RetryReason) -> None:
        self.retries.append(reason)

    def noticed(self, notice: StreetNotice) -> None:
        pass

    def message_unknown(self) -> None:
        self.unknown += 1

    @property
    def outcomes(self) -> list[tuple[int, str]]:
        return [(result.capture.index, str(result.outcome)) for result in self.results]


@pytest.fixture
def executor() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as executor:
        yield executor


@pytest.fixture
def open_client(
    hello: Hello,
    make_capture: Callable[..., Capture],
    encode: Callable[[EncodeJob], EncodedFrame],
    executor: ThreadPoolExecutor,
) -> Callable[..., StreamClient]:
    """Return a function that makes a client of a server in memory."""

    def make(
        server: MemoryServer,
        heard: Heard,
        limits: AgentLimits | None = None,
        coder: Callable[[EncodeJob], EncodedFrame] = encode,
        take: Callable[[int], Sequence[Capture]] | None = None,
        rate_control: RateControl | None = None,
    ) -> StreamClient:
        limits = limits or AgentLimits()
        session = AgentSession(hello, limits, rate_control)
        take = take or (lambda index: [make_capture(index, time.monotonic())])
        source = CameraSource(take, lambda job, _: coder(job), executor)
        return StreamClient(server, session, source, heard, heard, limits, tile="street")  # type: ignore[arg-type]

    return make


OpenClient = Callable[..., StreamClient]


async def one_picture(open_client: OpenClient, server: MemoryServer, **more: Any) -> Heard:
    """Have a client capture a picture, and expect that it is acknowledged in the end."""
    heard = Heard()
    client = open_client(server, heard, **more)
    client.capture(0)
    heard.on_result = client.finish
    await client.run()
    assert heard.outcomes == [(0, "acked")]
    return heard


async def test_a_picture_is_encoded_sent_and_reported_once(open_client: OpenClient) -> None:
    server, heard = MemoryServer(welcoming), Heard()
    client = open_client(server, heard)
    client.capture(2)
    client.finish()
    await client.run()
    assert heard.outcomes == [(2, "acked")]
    assert len(server.frames) == 1
    assert heard.connections == [True]
    assert client.rate_limit_hz == 5.0
    names = dict(server.metadata[0])
    assert (names[VEHICLE], names[TILE]) == ("cav-1", "street"), "by which a proxy places it"


@pytest.mark.parametrize(
    "code",
    [
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.NOT_FOUND,
        grpc.StatusCode.PERMISSION_DENIED,
        grpc.StatusCode.UNAUTHENTICATED,
    ],
)
async def test_a_refusal_that_another_try_would_repeat_ends_the_stream_with_its_reason(
    open_client: OpenClient, code: grpc.StatusCode
) -> None:
    server = MemoryServer(lambda _: refusal(code, "hello.field_ids: none is here"))
    client = open_client(server, Heard())
    with pytest.raises(ProtocolError, match=r"^hello\.field_ids: none is here$"):
        await client.run()
    assert len(server.streams) == 1


async def test_a_field_that_is_gone_ends_the_stream_and_has_the_tiles_asked_for_again(
    open_client: OpenClient,
) -> None:
    server = MemoryServer(lambda _: refusal(grpc.StatusCode.NOT_FOUND, "field ab: not here"))
    with pytest.raises(FieldNotServed, match="not here"):
        await open_client(server, Heard()).run()
    assert server.fields_changed.is_set()


async def test_one_failed_precondition_is_tried_again(open_client: OpenClient) -> None:
    once: Answer = lambda _: refusal(grpc.StatusCode.FAILED_PRECONDITION, "not yet")  # noqa: E731
    server = MemoryServer(once, welcoming)
    heard = await one_picture(open_client, server)
    assert heard.retries == [RetryReason.STREAM]


async def test_a_message_of_a_newer_server_is_counted_and_ignored(open_client: OpenClient) -> None:
    """Field 100 of StreamResponse, which this vehicle's protocol does not have."""
    newer = b"\xa2\x06\x03new"

    class NewerStream(MemoryStream):
        async def write(self, data: bytes) -> None:
            self._down.put_nowait(newer)
            await super().write(data)

    class NewerServer(MemoryServer):
        def stream_stream(self, method: str) -> Callable[..., MemoryStream]:  # noqa: ARG002
            self.streams.append(NewerStream(welcoming))
            return lambda **_: self.streams[-1]

    server = NewerServer(welcoming)
    heard = await one_picture(open_client, server)
    assert heard.unknown == 2, "one before the Welcome, one before the Ack"
    assert heard.retries == []


async def test_bytes_that_are_no_message_cost_the_stream_and_not_the_drive(
    open_client: OpenClient,
) -> None:
    class BrokenStream(MemoryStream):
        async def write(self, data: bytes) -> None:  # noqa: ARG002
            self._down.put_nowait(b"\xff\xff\xff")

    class BrokenOnce(MemoryServer):
        def stream_stream(self, method: str) -> Callable[..., MemoryStream]:  # noqa: ARG002
            kind = MemoryStream if self.streams else BrokenStream
            self.streams.append(kind(welcoming))
            return lambda **_: self.streams[-1]

    server = BrokenOnce(welcoming)
    heard = await one_picture(open_client, server)
    assert heard.retries == [RetryReason.STREAM]


async def test_a_lost_stream_is_opened_again_and_the_next_picture_goes_on(
    open_client: OpenClient,
) -> None:
    def breaking(message: Hello | Frame) -> list[ServerMessage] | grpc.aio.AioRpcError:
        if isinstance(message, Frame):
            return refusal(grpc.StatusCode.UNAVAILABLE, "connection reset by 203.0.113.7")
        return welcoming(message)

    server, heard = MemoryServer(breaking, welcoming), Heard()
    client = open_client(server, heard)
    heard.on_result = lambda: client.capture(1) if len(heard.results) == 1 else client.finish()
    client.capture(0)
    await client.run()
    assert heard.outcomes == [(0, "lost"), (1, "acked")]
    assert heard.results[0].reason is EndReason.STREAM_LOST
    assert heard.results[0].problem == "UNAVAILABLE: connection reset by 203.0.113.7"
    assert heard.connections == [True, False, True]


async def test_a_camera_that_another_agent_sends_is_tried_twice_and_then_given_up(
    open_client: OpenClient,
) -> None:
    """Between the two tries, an agent that has died is forgotten by the server."""
    server = MemoryServer(lambda _: refusal(grpc.StatusCode.RESOURCE_EXHAUSTED, TAKEN))
    heard = Heard()
    client = open_client(server, heard)
    with pytest.raises(CameraTaken, match=f"^{TAKEN}$"):
        await client.run()
    assert len(server.streams) == 2
    assert heard.connections == []


async def test_a_camera_that_is_free_at_the_second_try_is_sent(open_client: OpenClient) -> None:
    taken: Answer = lambda _: refusal(grpc.StatusCode.RESOURCE_EXHAUSTED, TAKEN)  # noqa: E731
    full: Answer = lambda _: refusal(  # noqa: E731
        grpc.StatusCode.RESOURCE_EXHAUSTED, "server_streams: 9 streams are open"
    )
    server = MemoryServer(taken, full, taken, welcoming)
    await one_picture(open_client, server)
    assert len(server.streams) == 4, "a full server is no refusal of the camera"


async def test_a_server_that_is_full_is_left_alone_as_long_as_it_asks(
    open_client: OpenClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    sleep = asyncio.sleep

    async def note(seconds: float) -> None:
        waits.append(seconds)
        await sleep(0)

    monkeypatch.setattr("cav_agent.client.asyncio.sleep", note)
    status = grpc.StatusCode.RESOURCE_EXHAUSTED
    server = MemoryServer(
        lambda _: refusal(status, "capacity: full", ("retry-after-ms", "700")),
        lambda _: refusal(status, "capacity: full", ("retry-after-ms", "99999999")),
        lambda _: refusal(status, "capacity: full", ("retry-after-ms", "soon")),
        welcoming,
    )
    await one_picture(open_client, server)
    assert waits[:2] == [0.7, 30.0]
    assert waits[2] < 1, "what is no number is not waited for"


async def test_a_refused_hello_ends_the_stream_with_the_servers_words(
    open_client: OpenClient,
) -> None:
    problem = "codec.width_px: 640 px, but intrinsics.width_px is 320 px"
    nack = Nack(FrameAddress("", 0, 0), RejectReason.INVALID_ARGUMENT, problem)
    client = open_client(MemoryServer(lambda _: [nack]), Heard())
    with pytest.raises(ProtocolError, match=r"refused this vehicle's Hello: codec\.width_px: 640"):
        await client.run()


async def test_a_notice_of_other_fields_reaches_the_connection(open_client: OpenClient) -> None:
    def noticing(message: Hello | Frame) -> list[ServerMessage]:
        return [*welcoming(message), FieldNotice(("cd" * 32,))]

    server = MemoryServer(noticing)
    await one_picture(open_client, server)
    assert server.fields_changed.is_set()


async def test_no_welcome_within_the_time_allowed_breaks_the_stream_and_another_is_tried(
    open_client: OpenClient,
) -> None:
    server = MemoryServer(lambda _: [], welcoming)
    heard = await one_picture(open_client, server, limits=AgentLimits(greeting_s=0.05))
    assert heard.retries == [RetryReason.STREAM]


async def test_a_server_that_never_welcomes_is_given_up(open_client: OpenClient) -> None:
    server = MemoryServer(lambda _: refusal(grpc.StatusCode.UNAVAILABLE, "restarting"))
    client = open_client(server, Heard(), AgentLimits(give_up_s=0.1))
    with pytest.raises(RfedgeError, match=r"no server welcomed this vehicle within 0\.1 s"):
        await client.run()
    assert len(server.streams) >= 2


async def test_a_picture_that_cannot_be_coded_is_dropped_and_the_next_one_is_sent(
    open_client: OpenClient, encode: Callable[[EncodeJob], EncodedFrame]
) -> None:
    def code(job: EncodeJob) -> EncodedFrame:
        if job.capture.index == 0:
            raise CodecError("x264 refused the picture")
        return encode(job)

    server, heard = MemoryServer(welcoming), Heard()
    client = open_client(server, heard, coder=code)
    heard.on_result = lambda: client.capture(1) if len(heard.results) == 1 else client.finish()
    client.capture(0)
    await client.run()
    assert heard.outcomes == [(0, "dropped"), (1, "acked")]
    assert heard.results[0].reason is EndReason.NOT_CODED
    assert heard.results[0].problem == "x264 refused the picture"


async def test_a_picture_that_waited_too_long_is_reported_though_nothing_else_happens(
    open_client: OpenClient, make_capture: Callable[..., Capture]
) -> None:
    """A lockstep drive captures nothing before it hears how the last picture ended."""

    def take(index: int) -> list[Capture]:
        return [make_capture(index, time.monotonic() - 3600 * index)]

    def acking(message: Hello | Frame) -> list[ServerMessage]:
        if isinstance(message, Hello):
            return welcoming(message)
        return [Ack(message.address, StageTimes(), b"digest")]

    heard = Heard()
    client = open_client(MemoryServer(acking), heard, take=take, rate_control=RateControl(60.0))
    loop = asyncio.get_running_loop()
    ends = iter((lambda: loop.call_soon(client.capture, 1), client.finish))
    heard.on_result = lambda: next(ends)()
    client.capture(0)
    async with asyncio.timeout(10):
        await client.run()
    assert heard.outcomes == [(0, "acked"), (1, "dropped")]
    assert heard.results[1].reason is EndReason.TOO_LATE


async def test_a_client_that_is_stopped_drops_what_waits_and_ends(open_client: OpenClient) -> None:
    server, heard = MemoryServer(lambda _: []), Heard()
    client = open_client(server, heard, AgentLimits(drain_s=0.0))
    client.capture(0)
    client.stop()
    await client.run()
    assert heard.outcomes == [(0, "dropped")]
    assert heard.results[0].reason is EndReason.STOPPING


async def test_what_an_abandoned_client_did_not_finish_is_reported_as_lost(
    open_client: OpenClient,
) -> None:
    server, heard = MemoryServer(lambda _: refusal(grpc.StatusCode.NOT_FOUND, "no field")), Heard()
    client = open_client(server, heard)
    client.capture(3)
    with pytest.raises(ProtocolError):
        await client.run()
    assert heard.results == []
    client.abandon("its stream was given up")
    (result,) = heard.results
    assert (result.capture.index, result.outcome) == (3, Outcome.LOST)
    assert (result.reason, result.problem) == (EndReason.ABANDONED, "its stream was given up")
    client.abandon("again")
    assert len(heard.results) == 1, "each picture ends once"


async def test_an_observer_that_gives_up_ends_the_stream_with_its_error(
    open_client: OpenClient,
) -> None:
    server, heard = MemoryServer(welcoming), Heard()

    def give_up() -> None:
        raise RfedgeError("picture 000.png was lost 5 times")

    heard.on_result = give_up
    client = open_client(server, heard)
    client.capture(0)
    with pytest.raises(RfedgeError, match=r"000\.png was lost 5 times"):
        await client.run()


async def test_a_picture_withdrawn_for_another_server_is_lost_here(
    open_client: OpenClient,
) -> None:
    heard = Heard()
    client = open_client(MemoryServer(welcoming), heard)
    client.capture(0)
    client.withdraw()
    client.finish()
    await client.run()
    assert heard.outcomes == [(0, "lost")]
    assert heard.results[0].reason is EndReason.HANDED_OVER
