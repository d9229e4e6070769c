"""Keeps the reader's process of a live source running, and the newest frame of it.

``LiveSource.step`` is a state machine that reads one record, or opens the source when it is due;
its clocks and its reader are arguments. ``SourceThread`` is the thread that steps it. A source
without a frame for ``timeout_s`` is closed, which kills its process, and opened again after a pause
that grows up to ``LONGEST_PAUSE_S``. There is one process and one thread at any time.
``ReaderProcess`` starts the process, reads it with a time limit, and kills it.

``CaptureClock`` finds when a frame was taken: by its sender's reports, or by its arrival less the
jitter. RTCP sender reports (RFC 3550, 6.4.1) say which wall-clock time belongs to which time stamp,
so a frame's capture is known as well as both machines' clocks agree. Without them it was taken at
the latest when it arrived: its time is its stamp plus the least (arrival - stamp) of the last
frames, which takes the jitter out but leaves the camera's own, constant delay in. That is stated as
``arrival``.

Times of capture increase; a frame whose time does not is left out. When that lasts longer than
``PATIENCE_NS``, times begin anew from the arrival: this machine's clock was set back, or the
sender's is wrong, as it also is when it is further than ``MAX_APART_NS`` from the arrival.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from threading import Event, Lock, Thread
from typing import Protocol

from cav_agent.backoff import Backoff
from cav_agent.live.reader import HEADER_BYTES, EndRecord, FrameRecord, Header, Record, record_of
from cav_agent.live.settings import ReaderSettings
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.image import Rgb
from rfcore.wire.values import ClockKind

NS = 1_000_000_000
MAX_APART_NS = 10 * NS
PATIENCE_NS = 1 * NS
WINDOW_FRAMES = 300


@dataclass(frozen=True)
class Stamp:
    """The time at which a frame was taken, Unix time, and the clock that gave it."""

    time_ns: int
    clock: ClockKind


class CaptureClock:
    """Finds the times of the frames of one connection; all are later than ``after_ns``."""

    def __init__(self, after_ns: int = 0) -> None:
        self.last_ns = after_ns
        self._delays: deque[int] = deque(maxlen=WINDOW_FRAMES)
        self._last_pts_ns: int | None = None
        self._distrusts_sender = False
        self._backwards_since_ns: int | None = None

    def stamp(self, pts_ns: int | None, received_ns: int, sender_ns: int | None) -> Stamp | None:
        """Return a frame's time; ``None`` for one that is not later than the one before it."""
        arrival_ns = self._arrival_ns(pts_ns, received_ns)
        stamp = Stamp(arrival_ns, ClockKind.ARRIVAL)
        if sender_ns is not None and not self._distrusts_sender:
            if abs(received_ns - sender_ns) > MAX_APART_NS:
                self._distrusts_sender = True
            else:
                stamp = Stamp(min(sender_ns, received_ns), ClockKind.SENDER_REPORT)
        if stamp.time_ns > self.last_ns:
            self._backwards_since_ns = None
            self.last_ns = stamp.time_ns
            return stamp
        return self._backwards(received_ns)

    def _backwards(self, received_ns: int) -> Stamp | None:
        """Drop frames that go back; after a while begin anew with their arrival."""
        since = self._backwards_since_ns
        if since is None:
            self._backwards_since_ns = received_ns
            return None
        if abs(received_ns - since) < PATIENCE_NS:
            return None
        self._distrusts_sender = True
        self._delays.clear()
        self._backwards_since_ns = None
        self.last_ns = received_ns
        return Stamp(received_ns, ClockKind.ARRIVAL)

    def _arrival_ns(self, pts_ns: int | None, received_ns: int) -> int:
        if pts_ns is None:
            return received_ns
        delay_ns = received_ns - pts_ns
        if self._last_pts_ns is not None and pts_ns < self._last_pts_ns:
            self._delays.clear()  # the sender began anew
        self._last_pts_ns = pts_ns
        self._delays.append(delay_ns)
        return pts_ns + min(self._delays)


BODY_TIMEOUT_S = 5.0
"""Longest time for the rest of a record that has begun: the other end has it in memory."""


class ReaderProcess:
    """``cav_agent.live.reader`` on one source; ``close`` kills it."""

    def __init__(self, settings: ReaderSettings) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cav_agent.live.reader", settings.to_json()],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        if self._process.stdout is None:
            raise RfedgeError("the camera's reader has no output")
        self._output = self._process.stdout.fileno()

    def read(self, timeout_s: float) -> Record | None:
        """Return the next record, or None if none begins in time; raise ``RfedgeError``."""
        if not self._is_readable(timeout_s):
            return None
        header_bytes = self._exactly(HEADER_BYTES)
        if header_bytes is None:
            return EndRecord("the camera's reader died")
        header = Header.parsed(bytes(header_bytes))
        body = self._exactly(header.length)
        return EndRecord("the camera's reader died") if body is None else record_of(header, body)

    def close(self) -> None:
        """Kill the process and wait for its end."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait(10.0)

    def _is_readable(self, timeout_s: float) -> bool:
        return bool(select.select([self._output], [], [], timeout_s)[0])

    def _exactly(self, count: int) -> bytearray | None:
        """Read so many bytes; ``None`` if the output ends before."""
        data = bytearray(count)
        view, have = memoryview(data), 0
        while have < count:
            if not self._is_readable(BODY_TIMEOUT_S):
                raise RfedgeError("the camera's reader stopped within a frame")
            got = os.readv(self._output, [view[have:]])
            if not got:
                return None
            have += got
        return data


FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
OPENING_S = 10.0
"""Longest time from opening to the first frame: a process starts, a key frame arrives."""
POLL_S = 0.25
"""A thread that is to stop notices it within this time."""


class SourceProblem(StrEnum):
    """The reason why a source was lost: a closed set, fit for a metric's label."""

    ENDED = "ended"
    """The connection was closed, refused or broken, or what came could not be decoded."""
    SILENT = "silent"
    """No frame came in time; the camera may hang."""
    WRONG_SIZE = "wrong_size"
    """Frames are not of the size that camera.toml says."""


@dataclass(frozen=True)
class LiveFrame:
    """A frame of the source: ``rgb`` uint8 [H, W, 3], taken at ``time_ns`` of Unix time.

    ``taken_s`` is the same on the agent's monotonic clock, ``received_s`` when the agent had it.
    ``pts_ns`` is its presentation time.
    """

    rgb: Rgb
    time_ns: int
    taken_s: float
    received_s: float
    clock: ClockKind
    pts_ns: int | None


class Reader(Protocol):
    """Reads a source, as ``ReaderProcess`` does."""

    def read(self, timeout_s: float) -> Record | None:
        """Return the next record, or None if none came in time; raise ``RfedgeError``."""

    def close(self) -> None:
        """End the reader, even if it hangs."""


class SourceObserver(Protocol):
    """Is called with the events of cameras' sources, on the sources' threads."""

    def source_open(self, camera_id: str, clock: ClockKind) -> None:
        """Frames come, and their times rest on ``clock``; called again when that changes."""

    def source_lost(self, camera_id: str, problem: SourceProblem, text: str, begins: bool) -> None:
        """The source was lost, or could not be opened; ``begins``: it was not lost before."""

    def source_frames(self, taken: int, dropped: int) -> None:
        """Count frames that were taken over, or dropped before they were coded."""

    def source_damaged(self, camera_id: str, count: int) -> None:
        """Count frames that were left out since they were damaged or rest on lost ones."""


@dataclass(frozen=True)
class Clocks:
    """A monotonic clock, Unix time in nanoseconds, and a way to wait."""

    monotonic_s: Callable[[], float] = time.monotonic
    unix_ns: Callable[[], int] = time.time_ns
    wait: Callable[[float], object] = time.sleep


class LiveSource:
    """Opens a source by ``open_reader`` and keeps its newest frame.

    One thread calls ``step``, any thread ``take`` and ``newest``. ``repeats``: a file begins again.
    """

    def __init__(
        self,
        open_reader: Callable[[], Reader],
        camera_id: str,
        size_px: tuple[int, int],
        observer: SourceObserver,
        *,
        timeout_s: float = 5.0,
        repeats: bool = False,
        clocks: Clocks | None = None,
        arrived: Callable[[], None] = lambda: None,
    ) -> None:
        self._open_reader, self._size_px = open_reader, size_px
        self._camera_id = camera_id
        self._observer, self._arrived = observer, arrived
        self._timeout_s, self._repeats = timeout_s, repeats
        self._clocks = clocks or Clocks()
        self._backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._lock = Lock()
        self._newest: LiveFrame | None = None
        self._reader: Reader | None = None
        self._clock = CaptureClock()
        self._kind: ClockKind | None = None
        self._heard_s = self._retry_at_s = self._clocks.monotonic_s()
        self._dropped = self._damaged = 0
        self._is_lost = False
        self.is_over = False
        """Whether a file came to its end, once its last frame was taken."""

    @property
    def newest(self) -> LiveFrame | None:
        """The frame that ``take`` would return."""
        return self._newest

    def take(self) -> LiveFrame | None:
        """Return the newest frame, once."""
        with self._lock:
            frame, self._newest = self._newest, None
            return frame

    def close(self) -> None:
        """End the reader."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def step(self) -> None:
        """Read a record or wait a moment; open the source where it is due."""
        now = self._clocks.monotonic_s()
        if self._reader is None:
            if now < self._retry_at_s:
                self._clocks.wait(min(POLL_S, self._retry_at_s - now))
                return
            self._open(now)
            return
        try:
            record = self._reader.read(POLL_S)
        except RfedgeError as error:
            record = EndRecord(str(error))
        self._take(record)

    def _open(self, now: float) -> None:
        self._clock = CaptureClock(self._clock.last_ns)
        self._kind = None
        self._dropped = self._damaged = 0
        self._heard_s = now
        try:
            self._reader = self._open_reader()
        except OSError as error:
            self._lose(SourceProblem.ENDED, f"the reader does not start: {error}")

    def _take(self, record: Record | None) -> None:
        now = self._clocks.monotonic_s()
        if isinstance(record, FrameRecord):
            self._take_frame(record, now)
        elif isinstance(record, EndRecord):
            self._end(record)
        else:
            limit_s = max(self._timeout_s, OPENING_S) if self._kind is None else self._timeout_s
            if now - self._heard_s >= limit_s:
                self._lose(SourceProblem.SILENT, f"no frame within {limit_s:g} s")

    def _end(self, record: EndRecord) -> None:
        if not record.is_whole:
            self._lose(SourceProblem.ENDED, record.problem)
            return
        self.close()
        self.is_over = not self._repeats
        self._arrived()

    def _take_frame(self, record: FrameRecord, now: float) -> None:
        height, width, _ = record.rgb.shape
        if (width, height) != self._size_px:
            wanted = f"{self._size_px[0]}x{self._size_px[1]}"
            text = f"frames are {width}x{height} px, camera.toml says {wanted}"
            self._lose(SourceProblem.WRONG_SIZE, text)
            return
        self._heard_s = now
        damaged, self._damaged = record.damaged - self._damaged, record.damaged
        dropped, self._dropped = record.dropped - self._dropped - damaged, record.dropped
        if damaged:
            self._observer.source_damaged(self._camera_id, damaged)
        stamp = self._clock.stamp(record.pts_ns, record.received_ns, record.sender_ns)
        if stamp is None:
            self._observer.source_frames(0, dropped + 1)
            return
        age_s = (self._clocks.unix_ns() - stamp.time_ns) / NS
        frame = LiveFrame(
            record.rgb, stamp.time_ns, now - max(0.0, age_s), now, stamp.clock, record.pts_ns
        )
        with self._lock:
            superseded = self._newest is not None
            self._newest = frame
        if stamp.clock is not self._kind or self._is_lost:
            self._kind, self._is_lost = stamp.clock, False
            self._observer.source_open(self._camera_id, stamp.clock)
        self._backoff.reset()
        self._observer.source_frames(1, dropped + superseded)
        self._arrived()

    def _lose(self, problem: SourceProblem, text: str) -> None:
        self.close()
        begins, self._is_lost = not self._is_lost, True
        self._retry_at_s = self._clocks.monotonic_s() + self._backoff.next_s()
        self._observer.source_lost(self._camera_id, problem, text, begins)


class SourceThread:
    """Steps a source on a thread of its own until ``close``."""

    def __init__(self, source: LiveSource) -> None:
        self._source = source
        self._closing = Event()
        self._thread = Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and the reader's process; returns within a moment."""
        self._closing.set()
        self._thread.join(10.0)
        if self._thread.is_alive():
            raise InvalidInput("source", "its thread does not end")

    def _run(self) -> None:
        try:
            while not self._closing.is_set() and not self._source.is_over:
                self._source.step()
        finally:
            self._source.close()
