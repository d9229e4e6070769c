"""``rfedge watch`` ends when it is told to, at whatever moment that is."""

import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import grpc
import pytest

from rfcore.camera import Intrinsics, Pose
from rfcore.errors import RfedgeError
from rfcore.wire import twin_client
from rfcore.wire.twin import Departure, PictureEncoding, TwinPicture, twin_message_to_wire
from rfcore.wire.twin_client import TwinClient
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge import watch as module
from rfedge.processes import command_of
from rfedge.watch import WatchSettings, watch_until_stopped

DEPARTURE = twin_message_to_wire(Departure("cav-1", "front"))
STARTED_S = 60.0


def grey(sequence: int) -> TwinPicture:
    """A grey picture of 16x16 px, captured 0.1 s after the one before."""
    return TwinPicture(
        vehicle_id="cav-1",
        camera_id="front",
        session_id="s",
        epoch=0,
        sequence=sequence,
        capture_time_ns=sequence * 10**8,
        age_ns=0,
        pose=Pose.identity(),
        intrinsics=Intrinsics(16, 16, 8.0, 8.0, 8.0, 8.0),
        field_id="ab" * 32,
        reconstruction_digest=b"d" * 16,
        encoding=PictureEncoding.I420,
        picture=b"\x80" * (16 * 16 * 3 // 2),
    )


class EndlessTwin(twin_pb2_grpc.TwinServiceServicer):
    """Sends without end, and counts; with ``idle`` it sends nothing."""

    def __init__(self) -> None:
        self.sent = 0
        self.idle = False
        self.pictures = False
        self.watched = threading.Event()
        self.enough = threading.Event()
        self.enough_at = 0

    def Watch(self, request: Any, context: Any) -> Iterator[Any]:  # noqa: N802, ARG002
        over = threading.Event()
        context.add_callback(over.set)
        context.send_initial_metadata(())
        self.watched.set()
        if self.idle:
            over.wait()
        while not over.is_set():
            self.sent += 1
            yield twin_message_to_wire(grey(self.sent)) if self.pictures else DEPARTURE
            if self.sent >= self.enough_at:
                self.enough.set()


@pytest.fixture
def twin() -> EndlessTwin:
    return EndlessTwin()


@pytest.fixture
def address(twin: EndlessTwin) -> Iterator[str]:
    server = grpc.server(ThreadPoolExecutor(4))
    twin_pb2_grpc.add_TwinServiceServicer_to_server(twin, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}"
    server.stop(0).wait()


def in_thread(run: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("repetition", range(3))
@pytest.mark.parametrize("after", [0, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])
def test_a_watcher_ends_after_any_number_of_messages(
    twin: EndlessTwin, address: str, after: int, repetition: int
) -> None:
    """Stopped from another thread while messages stream in."""
    del repetition
    twin.enough_at = after
    client = TwinClient(address)
    thread = in_thread(lambda: module.watch(WatchSettings(), client))
    assert (twin.watched if after == 0 else twin.enough).wait(STARTED_S)
    client.stop()
    thread.join(STARTED_S)
    assert not thread.is_alive()


@pytest.mark.parametrize("calls", [1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024])
def test_a_watcher_ends_at_any_point_of_its_start(address: str, calls: int) -> None:
    """Stopped once it has called so many functions: connecting, asking, the first messages."""
    client, counted, reached = TwinClient(address), itertools.count(1), threading.Event()

    def count(*_: Any) -> None:
        if next(counted) == calls:
            reached.set()

    def run() -> None:
        sys.settrace(count)
        try:
            module.watch(WatchSettings(), client)
        finally:
            sys.settrace(None)
            reached.set()

    thread = in_thread(run)
    assert reached.wait(STARTED_S)
    client.stop()
    thread.join(STARTED_S)
    assert not thread.is_alive()


def test_a_watcher_that_was_stopped_before_it_ran_ends_at_once(address: str) -> None:
    client = TwinClient(address)
    client.stop()
    module.watch(WatchSettings(), client)


def test_a_watcher_ends_while_it_waits_for_a_server_or_for_pictures(
    twin: EndlessTwin, address: str
) -> None:
    twin.idle = True
    clients = [TwinClient(address), TwinClient(NOWHERE)]
    threads = [in_thread(lambda c=c: module.watch(WatchSettings(), c)) for c in clients]  # type: ignore[misc]
    assert twin.watched.wait(STARTED_S)
    for client in clients:
        client.stop()
    for thread in threads:
        thread.join(STARTED_S)
    assert not any(thread.is_alive() for thread in threads)


NOWHERE = "127.0.0.1:1"


@pytest.fixture
def handlers() -> Iterator[None]:
    """The handlers of the test's own process are in place again afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == before


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_watch_at_any_moment_with_a_whole_video(
    twin: EndlessTwin,
    address: str,
    number: signal.Signals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    twin.pictures = True
    for pictures in (2, 3, 7, 40):
        lines: list[str] = []
        enough = threading.Event()

        def count(line: str, flush: bool, lines: Any = lines, enough: Any = enough) -> None:
            assert flush
            lines.append(line)
            if len(lines) == pictures:  # noqa: B023 - called in this repetition only
                enough.set()

        def tell(enough: Any = enough) -> None:
            assert enough.wait(STARTED_S)
            os.kill(os.getpid(), number)

        monkeypatch.setattr(module, "print", count, raising=False)
        teller = in_thread(tell)
        video = tmp_path / f"{pictures}.mp4"
        watch_until_stopped(WatchSettings(video=video), TwinClient(address))
        teller.join()
        with av.open(str(video)) as container:
            kept = len(list(container.decode(video=0)))
        assert kept == len(lines), "every picture that was reported is in it"


@pytest.mark.usefixtures("handlers")
def test_an_error_of_the_watch_is_raised_where_it_was_called(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(twin_client, "CONNECT_S", 0.05)
    with pytest.raises(RfedgeError, match="no server at"):
        watch_until_stopped(WatchSettings(), TwinClient(NOWHERE))


class OnePicture:
    """A source of one picture of 345,600 bytes, for which the vehicle sent 4,200."""

    def watch(
        self,
        subscription: Any,
        connected: Callable[[str], None],
        problem: Callable[[str], None],
    ) -> Generator[TwinPicture, None, None]:
        del subscription
        problem("refused")
        connected("")
        yield replace(grey(1), picture=bytes(345_600), payload_bytes=4_200)

    def stop(self) -> None:
        """Nothing is to be ended."""


def test_a_watcher_prints_what_was_sent_and_waits_for_a_picture_once_it_is_connected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    waited: list[str] = []

    @contextmanager
    def waiting(what: str, say: Any) -> Iterator[Callable[[str], None]]:
        del say
        waited.append(what)
        yield waited.append

    monkeypatch.setattr(module, "waiting", waiting)
    module.watch(WatchSettings(), OnePicture())
    assert waited == ["a connection", "a picture", "another picture"]
    out, said = capsys.readouterr()
    assert "4200 bytes" in out
    assert "345600" not in out
    age_ms = round(grey(1).age_ns / 1e6)
    assert f"1 pictures, 0 missed; age p50 {age_ms}, p95 {age_ms}, p99 {age_ms} ms" in said


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        try:
            yield running
        finally:
            running.kill()


def test_the_command_ends_while_it_watches(twin: EndlessTwin, address: str) -> None:
    twin.idle = True
    with process(*command_of("rfedge"), "watch", address) as watching:
        assert twin.watched.wait(STARTED_S)
        watching.send_signal(signal.SIGTERM)
        assert watching.wait(STARTED_S) == 0
        assert watching.stderr is not None
        lines = watching.stderr.read().splitlines()
        assert all(line.startswith(b"rfedge watch: ") for line in lines), "no traceback"


BLOCKED = """
import sys, threading
from rfcore.wire.twin_client import TwinClient
from rfedge import watch

def never(*values, **options):
    sys.stderr.write("printing\\n")
    sys.stderr.flush()
    threading.Event().wait()

watch.print, watch.FINISH_S = never, float(sys.argv[2])
watch.watch_until_stopped(watch.WatchSettings(), TwinClient(sys.argv[1]))
"""
"""A watcher that never gets a line printed, as when nobody reads its pipe."""


@pytest.mark.usefixtures("twin")
@pytest.mark.parametrize(
    ("finish_s", "signals"),
    [
        pytest.param(0.1, [signal.SIGTERM], id="it was given time"),
        pytest.param(3600.0, [signal.SIGTERM, signal.SIGINT], id="a second signal came"),
    ],
)
def test_a_watcher_that_cannot_finish_ends_all_the_same_and_says_so(
    address: str, finish_s: float, signals: list[signal.Signals]
) -> None:
    with process(sys.executable, "-c", BLOCKED, address, str(finish_s)) as watching:
        assert watching.stderr is not None
        while (line := watching.stderr.readline()) != b"printing\n":
            assert line.startswith(b"rfedge watch: ")
        for number in signals:
            watching.send_signal(number)
        assert watching.wait(STARTED_S) == 1
        assert watching.stderr.read().decode().endswith(module.UNFINISHED)
