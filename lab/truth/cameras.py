"""Cameras that lose, reorder and change: what a live source hands on of streams that are known.

Each stream is sent by RTP over the loopback device to the product's ``LiveSource``, whose reader is
a process of its own. A picture that it hands on is wrong if it is none of those sent.
"""

from __future__ import annotations

import socket
import subprocess
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from cav_agent.live.settings import ReaderSettings, parse_address
from cav_agent.live.source import LiveFrame, LiveSource, ReaderProcess
from lab.truth.stream import (
    SDP,
    CodedStream,
    Coder,
    Sending,
    coded,
    datagrams,
    digest,
    held,
    one_in,
    send,
    swapped,
    without_packet,
    without_pictures,
)
from rfcore.errors import RfedgeError

OPENING_S = 60.0
"""Longest time until the reader listens, which imports FFmpeg first, and gives a picture."""
AFTER_S = 0.6
"""So long after the last datagram pictures may still come."""
SENDER = Path(__file__).parents[2] / "deploy" / "live" / "gst_sender.py"
SETTLED_S = 1.0
"""FFmpeg gathers a stream's parameters for half a second: later pictures are timed."""


@dataclass(frozen=True)
class CameraCase:
    """A stream and how it is sent; ``then``: a stream of other parameters that follows it."""

    name: str
    coder: Coder = field(default_factory=Coder)
    sending: Sending = field(default_factory=Sending)
    then: Coder | None = None

    def stream(self) -> CodedStream:
        """Return the stream."""
        first = coded(self.coder)
        return first if self.then is None else first + coded(self.then)


def _coded(params: str = "", **more: Any) -> Coder:
    return Coder(params=params, **more)


B_FRAMES = (("bf", "2"), ("b-pyramid", "normal"))
MIDWAY = Sending(first=8)
CASES = (
    CameraCase("whole"),
    CameraCase("whole, without sender reports", sending=Sending(reports=False)),
    CameraCase("whole, 10 Hz, without reports", sending=Sending(rate_hz=10.0, reports=False)),
    CameraCase("whole, B pictures", _coded(options=B_FRAMES)),
    CameraCase("a packet lost", sending=Sending(change=without_packet(49))),
    CameraCase("a picture lost", sending=Sending(change=without_pictures(49))),
    CameraCase("a key frame lost", sending=Sending(change=without_pictures(45))),
    CameraCase("a key frame's packet lost", sending=Sending(change=without_packet(45))),
    CameraCase("a picture lost, B pictures", _coded(options=B_FRAMES),
               Sending(change=without_pictures(49))),
    CameraCase("a picture lost, gradual refresh", _coded("intra-refresh=1"),
               Sending(change=without_pictures(49))),
    CameraCase("1 % of the packets lost", sending=Sending(change=one_in(100, seed=5))),
    CameraCase("joined within a group", sending=MIDWAY),
    CameraCase("joined, gradual refresh", _coded("intra-refresh=1"), MIDWAY),
    CameraCase("joined, open groups", _coded("open-gop=1:bframes=2", options=()), MIDWAY),
    CameraCase("neighbours swapped", sending=Sending(change=swapped)),
    CameraCase("a burst after a pause of 0.8 s", sending=Sending(change=held(2.0, 2.8))),
    CameraCase("time stamps and numbers wrap",
               sending=Sending(stamp=(1 << 32) - 2 * 90_000, sequence=65_500)),
    CameraCase("reports step by 5 s", sending=Sending(step_at=45, step_s=5.0)),
    CameraCase("cropped to 250x138", _coded(size_px=(250, 138))),
    CameraCase("cropped by 8 px on the left",
               _coded("crop-rect=8,0,0,0:", size_px=(256, 144), crop_left_px=8)),
    CameraCase("fields of two instants", _coded("interlaced=1", is_read=False)),
    CameraCase("grey (4:0:0)", _coded(pix_fmt="gray")),
    CameraCase("4:4:4", _coded(pix_fmt="yuv444p")),
    CameraCase("YCgCo", _coded("colormatrix=YCgCo", pix_fmt="yuv444p", is_read=False)),
    CameraCase("other parameters, same size", _coded(count=45),
               then=_coded("ref=4:cabac=0:slices=3", count=45, seed=4)),
    CameraCase("other size", _coded(count=45), then=_coded(count=45, size_px=(320, 180), seed=4)),
)  # fmt: skip


RIG = "two streams of one rig"


@dataclass(frozen=True)
class ServedCase:
    """A stream that GStreamer's RTSP server sends, but for a share ``lost`` of its pictures."""

    name: str
    transport: str
    lost: float = 0.0


SERVED_CASES = (
    ServedCase("RTSP over TCP (GStreamer)", "tcp"),
    ServedCase("RTSP over UDP (GStreamer)", "udp"),
    ServedCase("RTSP, a tenth of the pictures lost (GStreamer)", "udp", 0.1),
)


@dataclass
class Heard:
    """Counts what a source says, as its observer."""

    damaged: int = 0
    dropped: int = 0
    problem: str = ""

    def source_open(self, *_: object) -> None:
        """Take no note."""

    def source_lost(self, camera_id: str, problem: str, text: str, begins: bool) -> None:  # noqa: ARG002
        """Note the first problem."""
        self.problem = self.problem or f"{problem}: {text}"

    def source_frames(self, taken: int, dropped: int) -> None:  # noqa: ARG002
        """Count what was left out for any other reason."""
        self.dropped += dropped

    def source_damaged(self, camera_id: str, count: int) -> None:  # noqa: ARG002
        """Count what was left out since it may be wrong."""
        self.damaged += count


@dataclass
class Watched:
    """The pictures that a source handed on until it is closed, and what it said."""

    address: str
    size_px: tuple[int, int]
    options: Mapping[str, str] = field(default_factory=dict)
    heard: Heard = field(default_factory=Heard)
    frames: list[tuple[bytes, LiveFrame]] = field(default_factory=list)

    def __post_init__(self) -> None:
        address = parse_address(self.address)
        address = replace(address, options={**address.options, **self.options})
        settings = ReaderSettings(address, OPENING_S, 1000.0)
        self._source = LiveSource(
            lambda: ReaderProcess(settings), "camera", self.size_px, self.heard, timeout_s=OPENING_S
        )
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def wait(self, limit_s: float) -> None:
        """Wait until the source has ended, or for so long."""
        self._thread.join(limit_s)

    def close(self) -> None:
        """End the source."""
        self._closing.set()
        self._thread.join(20.0)

    def _run(self) -> None:
        try:
            while not (self._closing.is_set() or self.heard.problem or self._source.is_over):
                self._source.step()
                if (frame := self._source.take()) is not None:
                    self.frames.append((digest(frame.rgb), frame))
        finally:
            self._source.close()


@dataclass(frozen=True)
class Sent:
    """A stream that was sent: the times of its pictures by the monotonic clock and Unix time."""

    stream: CodedStream
    sending: Sending
    sent_s: Mapping[int, float]
    began_unix_s: float

    def taken_unix_s(self, picture: int) -> float:
        """Return when a picture was taken."""
        return self.began_unix_s + (picture - self.sending.first) / self.sending.rate_hz


def run_camera(case: CameraCase) -> dict[str, Any]:
    """Send the stream of a case to a source; return its row."""
    ((sent, watched),) = _sent([(case.stream(), case.sending)])
    return row(sent, watched)


def run_rig() -> dict[str, Any]:
    """Send two streams of one rig at once; return the sums and worse figures of both.

    ``time_error_ms`` is how far apart the times are that are stated of pictures taken together.
    """
    made = (coded(Coder()), coded(Coder(seed=4)))
    both = _sent([(stream, Sending()) for stream in made])
    rows = [row(sent, watched) for sent, watched in both]
    a, b = (
        {sent.stream.right.get(key, -1): frame.time_ns for key, frame in watched.frames}
        for sent, watched in both
    )
    apart_ms = median(abs(a[n] - b[n]) / 1e6 for n in a.keys() & b.keys())
    sums = {key: sum(r[key] for r in rows) for key in ("pictures", "wrong_pictures", "left_out")}
    return {
        **rows[0],
        **sums,
        "delay_ms": max(r["delay_ms"] for r in rows),
        "time_error_ms": apart_ms,
    }


def run_served(case: ServedCase) -> dict[str, Any]:
    """Have GStreamer serve a stream by RTSP; return its row.

    When GStreamer sends a picture is not known: ``delay_ms`` is from the time that its sender
    reports state until the agent has it.
    """
    stream = coded(Coder())
    with TemporaryDirectory() as folder:
        file = Path(folder) / "stream.mkv"
        stream.write(file)
        words = ("/usr/bin/python3", str(SENDER), "file", str(file), "0", str(case.lost))
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                port = server.stdout.readline().strip()
                if not port:
                    raise RfedgeError("GStreamer is missing: run `make test-system-packages`")
                url = f"rtsp://127.0.0.1:{port}/camera"
                watched = Watched(url, stream.size_px, {"rtsp_transport": case.transport})
                watched.wait(OPENING_S)
                watched.close()
            finally:
                server.kill()
    right = [frame for key, frame in watched.frames if key in stream.right]
    unix_s = time.time() - time.monotonic()
    delays_s = [unix_s + each.received_s - each.time_ns / 1e9 for each in right]
    return {
        "pictures": len(watched.frames),
        "wrong_pictures": len(watched.frames) - len(right),
        "left_out": watched.heard.damaged,
        "delay_ms": 1e3 * median(delays_s) if delays_s else None,
        "refused": watched.heard.problem.partition(":")[0].replace("ended", ""),
    }


def row(sent: Sent, watched: Watched) -> dict[str, Any]:
    """Judge what a source handed on of a stream."""
    right, at = sent.stream.right, {n: i for i, n in enumerate(sent.stream.shown_at)}
    seen = [(right[key], frame) for key, frame in watched.frames if key in right]
    settled = [
        (number, frame)
        for number, frame in seen
        if number - sent.sending.first >= SETTLED_S * sent.sending.rate_hz
    ]
    delays_s = [frame.received_s - sent.sent_s[at[number]] for number, frame in settled]
    errors_s = [abs(frame.time_ns / 1e9 - sent.taken_unix_s(number)) for number, frame in settled]
    return {
        "pictures": len(watched.frames),
        "wrong_pictures": len(watched.frames) - len(seen),
        "left_out": watched.heard.damaged,
        "delay_ms": 1e3 * median(delays_s) if delays_s else None,
        "least_delay_ms": 1e3 * min(delays_s) if delays_s else None,
        "time_error_ms": 1e3 * median(errors_s) if errors_s else None,
        "refused": watched.heard.problem,
    }


def _sent(all_sent: list[tuple[CodedStream, Sending]]) -> list[tuple[Sent, Watched]]:
    """Send streams at once, each to a source of its own that listens already."""
    with TemporaryDirectory() as folder:
        watched, ports = list[Watched](), list[int]()
        for number, (stream, _) in enumerate(all_sent):
            ports.append(_free_port())
            sdp = Path(folder) / f"{number}.sdp"
            sdp.write_text(SDP.format(port=ports[-1]))
            watched.append(Watched(str(sdp), stream.size_px))
        try:
            for port in ports:
                _await_listener(port)
            began_s, began_unix_s = time.monotonic() + 0.2, time.time() + 0.2
            with ThreadPoolExecutor() as threads:
                sending = [
                    threads.submit(send, datagrams(stream, how, began_unix_s), port, began_s)
                    for (stream, how), port in zip(all_sent, ports, strict=True)
                ]
                sent_s = [each.result() for each in sending]
            time.sleep(AFTER_S)
        finally:
            for each in watched:
                each.close()
        made = [Sent(*a, b, began_unix_s) for a, b in zip(all_sent, sent_s, strict=True)]
        return list(zip(made, watched, strict=True))


def _free_port() -> int:
    """Return an even UDP port that is free, as the one after it is (RFC 3550, 11)."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:
            a.bind(("127.0.0.1", 0))
            port = int(a.getsockname()[1])
            if port % 2:
                continue
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as b, suppress(OSError):
                b.bind(("127.0.0.1", port + 1))
                return port


def _await_listener(port: int) -> None:
    """Wait until the RTCP socket is bound, which FFmpeg opens last."""
    end_s = time.monotonic() + OPENING_S
    while f":{port + 1:04X} " not in Path("/proc/net/udp").read_text():
        if time.monotonic() > end_s:
            raise RfedgeError(f"nobody listens at port {port} within {OPENING_S:g} s")
        time.sleep(0.01)
