"""``rfedge watch``: prints a line per picture, and keeps pictures in folders or as a video.

One thread receives and keeps pictures, one after the other: where the disk is slow it misses
pictures, and says how many. The main thread only waits for signals: ``watch_until_stopped``. A
signal must not raise an exception wherever the receiving thread happens to be: in gRPC's Python
code that may leave a lock taken for ever, and the process then hangs in ``channel.close``.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, wait
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import av
import numpy as np

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.files import write_whole
from rfcore.image import png_bytes
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
)
from rfcore.wire.twin_render import ObjectsRequest, ObjectsSeen
from rfcore.wire.values import check_name
from rfcore.wire.waits import waiting
from rfedge.video import bt709_stream, even_frame

if TYPE_CHECKING:
    from rfcore.field import RadianceField
    from rfedge.cpm import CpmFile
    from rfedge.mcap_file import McapFile

AGES = 10_000
"""Pictures whose ages are kept: more would grow for as long as somebody watches."""
TICKS_PER_S = 90_000
"""Resolution of a video's times, as in MPEG systems."""


class PictureFolder:
    """Keeps pictures as FOLDER/VEHICLE/CAMERA/SESSION-EPOCH-SEQUENCE.png or .jpg.

    Beside them, index.jsonl has a line for each.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def keep(self, picture: TwinPicture) -> None:
        """Write a picture; one that travelled as I420 becomes PNG."""
        folder = self._folder / picture.vehicle_id / picture.camera_id
        folder.mkdir(parents=True, exist_ok=True)
        is_jpeg = picture.encoding is PictureEncoding.JPEG
        name = f"{picture.session_id}-e{picture.epoch:04}-{picture.sequence:06}"
        name += ".jpg" if is_jpeg else ".png"
        data = picture.picture
        if picture.encoding is PictureEncoding.I420:
            data = png_bytes(picture.rgb)
        write_whole(folder / name, data)
        line = {
            "file": name,
            "session": picture.session_id,
            "epoch": picture.epoch,
            "sequence": picture.sequence,
            "capture_time_ns": picture.capture_time_ns,
            "instant": picture.instant or None,
            "age_ms": picture.age_ns / 1e6,
            "decoding_ms": picture.decoding_ns / 1e6,
            "translation_m": None if picture.pose is None else picture.pose.translation_m,
            "rotation_wxyz": None if picture.pose is None else picture.pose.rotation,
            "field": picture.field_id,
            "digest": picture.reconstruction_digest.hex(),
            "missed": picture.skipped,
        }
        with (folder / "index.jsonl").open("a") as index:
            index.write(json.dumps(line) + "\n")


class PictureVideo:
    """Keeps one camera as H.264 in MP4; leaves out pictures of others and of another size.

    A picture's time is its capture, so a gap in the stream is a still in the video.
    """

    def __init__(self, path: Path) -> None:
        self._container = av.open(str(path), "w", format="mp4")
        self._stream: av.VideoStream | None = None
        self._first: TwinPicture | None = None
        self._last_tick = -1

    def __enter__(self) -> PictureVideo:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def keep(self, picture: TwinPicture) -> None:
        """Append a picture, unless it is of another camera or not later than the last one."""
        first = self._first = self._first or picture
        if _camera(picture) != _camera(first):
            return
        tick = (picture.capture_time_ns - first.capture_time_ns) * TICKS_PER_S // 10**9
        if tick <= self._last_tick:
            return
        self._last_tick = tick
        stream = self._stream = self._stream or self._open(picture)
        frame = even_frame(picture.planes, tick)
        frame.time_base = Fraction(1, TICKS_PER_S)
        self._container.mux(stream.encode(frame))

    def _open(self, picture: TwinPicture) -> av.VideoStream:
        options = {"crf": "18", "preset": "veryfast", "bf": "0"}
        k = picture.intrinsics
        stream = bt709_stream(self._container, None, options)
        stream.width, stream.height = k.width_px // 2 * 2, k.height_px // 2 * 2
        stream.codec_context.time_base = Fraction(1, TICKS_PER_S)
        return stream


def _camera(picture: TwinPicture) -> tuple[str, str, int, int]:
    k = picture.intrinsics
    return (picture.vehicle_id, picture.camera_id, k.width_px, k.height_px)


LOOK_EVERY_S = 0.05
"""Period at which the main thread checks for a signal and for the end of the watcher."""

FINISH_S = 5.0
"""Longest time to complete the files after a stop."""

UNFINISHED = "rfedge watch: ended before its files were complete\n"


class PictureSource(Protocol):
    """A source of pictures: a ``TwinClient``, or the servers of one NATS."""

    def watch(
        self,
        subscription: Subscription,
        connected: Callable[[str], None] = ...,
        problem: Callable[[str], None] = ...,
    ) -> Generator[TwinPicture | Departure, None, None]:
        """Yield what arrives until ``stop``; raise ``RfedgeError`` if the source is not there.

        ``connected`` is called with what may be seen, "" for everything; ``problem`` with why there
        is no connection.
        """

    def stop(self) -> None:
        """End ``watch``, from any thread."""


@dataclass(frozen=True)
class WatchSettings:
    """Settings of ``rfedge watch``; see its ``--help``."""

    vehicle_ids: frozenset[str] = frozenset()
    folder: Path | None = None
    video: Path | None = None
    mcap: Path | None = None
    cpm: Path | None = None
    station: int = 0
    encoding: str | None = None
    pictures: int | None = None

    def __post_init__(self) -> None:
        for name in self.vehicle_ids:
            check_name("vehicle", name)
        if self.pictures is not None and self.pictures < 1:
            raise InvalidInput("pictures", f"{self.pictures} must be at least 1")
        shown = self.video or self.mcap
        if shown is not None and self.subscription.encoding is not PictureEncoding.I420:
            raise InvalidInput("encoding", f"{self.encoding} makes no video; leave it out")
        if self.folder is not None and self.subscription.encoding is PictureEncoding.NONE:
            raise InvalidInput("encoding", "none leaves nothing to keep; leave it out")

    @property
    def subscription(self) -> Subscription:
        """The subscription for the source."""
        encoding = PictureEncoding.NONE
        if self.encoding is not None:
            encoding = PictureEncoding(self.encoding)
        elif self.video is not None or self.mcap is not None:
            encoding = PictureEncoding.I420
        elif self.folder is not None:
            encoding = PictureEncoding.JPEG
        return Subscription(self.vehicle_ids, encoding)


class Summary:
    """Counts pictures and keeps the last ones' ages, for one line at the end."""

    def __init__(self) -> None:
        self._pictures = self._missed = 0
        self._age_ms: deque[float] = deque(maxlen=AGES)

    def add(self, picture: TwinPicture) -> None:
        """Count a picture, and those missed before it."""
        self._pictures += 1
        self._age_ms.append(picture.age_ns / 1e6)
        self._missed += picture.skipped

    def say(self) -> None:
        """Say how many there were and how old, if there were any."""
        if self._age_ms:
            p50, p95, p99 = np.percentile(self._age_ms, (50, 95, 99))
            _say(
                f"{self._pictures} pictures, {self._missed} missed; "
                f"age p50 {p50:.0f}, p95 {p95:.0f}, p99 {p99:.0f} ms"
            )


ObjectsOf = Callable[[ObjectsRequest], Iterator[ObjectsSeen]]
"""Yields a server's objects on the ground of one field."""


class TwinMcap:
    """Keeps pictures and objects in an MCAP file (``rfedge.mcap_file``)."""

    def __init__(self, file: McapFile, objects: ObjectsOf | None) -> None:
        self._file, self._objects = file, objects
        self._fields: set[str] = set()

    def keep(self, picture: TwinPicture) -> None:
        """Add a picture, and from then on the objects of its field."""
        from rfedge.mcap_file import ShownPicture

        metrics = {
            "age_ms": picture.age_ns / 1e6,
            "decoding_ms": picture.decoding_ns / 1e6,
            "payload_bytes": picture.payload_bytes,
            "missed": picture.skipped,
            "sequence": picture.sequence,
        }
        shown = ShownPicture(
            *(picture.vehicle_id, picture.camera_id, picture.capture_time_ns, picture.planes),
            *(picture.intrinsics, picture.pose, picture.field_id, metrics),
        )
        self._file.show(shown, time.time_ns())
        if self._objects is not None and picture.field_id not in self._fields:
            self._fields.add(picture.field_id)
            _follow(self._objects, picture.field_id, self._show)

    def _show(self, seen: ObjectsSeen) -> None:
        self._file.show_objects(seen.field_id, seen.objects, seen.time_ns, time.time_ns())


class TwinCpm:
    """Keeps the objects on one field as Collective Perception Messages (``rfedge.cpm``)."""

    def __init__(self, file: CpmFile, objects: ObjectsOf, field_id: str) -> None:
        self._file, self._objects, self._field_id = file, objects, field_id
        self._fields: set[str] = set()

    def keep(self, picture: TwinPicture) -> None:
        """Follow the objects from the first picture on; say which fields are other ones."""
        if not self._fields:
            _follow(self._objects, self._field_id, self._show)
        if picture.field_id not in self._fields and picture.field_id != self._field_id:
            _say(
                f"a picture is of field {picture.field_id[:12]}, --field is {self._field_id[:12]}: "
                "objects are told of if both are versions of one tile"
            )
        self._fields.add(picture.field_id)

    def _show(self, seen: ObjectsSeen) -> None:
        self._file.show_objects(seen.objects, seen.time_ns)


def _follow(objects: ObjectsOf, field_id: str, show: Callable[[ObjectsSeen], None]) -> None:
    """Show a field's objects from a thread of their own, until the source ends."""

    def run() -> None:
        try:
            for seen in objects(ObjectsRequest(field_id=field_id)):
                show(seen)
        except RfedgeError as error:
            _say(f"no objects: {error}")

    threading.Thread(target=run, daemon=True).start()


@contextmanager
def _opened_mcap(
    path: Path, objects: ObjectsOf | None, field: RadianceField | None
) -> Iterator[TwinMcap]:
    from rfedge.mcap_file import McapFile

    with McapFile(path, field) as file:
        yield TwinMcap(file, objects)
    if file.late:
        _say(f"{path}: {file.late} pictures left out, not taken later than the ones before them")


@contextmanager
def _opened_cpm(
    settings: WatchSettings, path: Path, objects: ObjectsOf | None, field: RadianceField | None
) -> Iterator[TwinCpm]:
    from rfedge.cpm import CpmFile

    if objects is None:
        raise InvalidInput("cpm", "servers' objects do not come by NATS: name one, HOST:PORT")
    if field is None:
        raise InvalidInput("cpm", "needs --field, which says where on the Earth the objects are")
    with CpmFile(path, field.metadata, settings.station) as file:
        yield TwinCpm(file, objects, field.field_id)


def watch(
    settings: WatchSettings,
    source: PictureSource,
    objects: ObjectsOf | None = None,
    field: RadianceField | None = None,
) -> None:
    """Print and keep what ``source`` shows, until it ends, is stopped, or enough was seen.

    An MCAP file has ``objects``, too, and shows ``field`` as points. Collective Perception Messages
    tell of the ``objects`` on ``field``, where its anchor says.
    Files are whole when it returns or raises. Raises ``RfedgeError`` if the source is not there or
    refuses.
    """
    pictures, summary = 0, Summary()
    with ExitStack() as stack:
        stack.callback(summary.say)
        folder = PictureFolder(settings.folder) if settings.folder else None
        video = stack.enter_context(PictureVideo(settings.video)) if settings.video else None
        mcap = None
        if settings.mcap is not None:
            mcap = stack.enter_context(_opened_mcap(settings.mcap, objects, field))
        cpm = None
        if settings.cpm is not None:
            cpm = stack.enter_context(_opened_cpm(settings, settings.cpm, objects, field))
        wait_for = stack.enter_context(waiting("a connection", _say_wait))

        def connected(may_see: str) -> None:
            _say("connected" + (f"; this certificate may see: {may_see}" if may_see else ""))
            wait_for("a picture")

        messages = stack.enter_context(
            closing(source.watch(settings.subscription, connected, _say))
        )
        for message in messages:
            wait_for("another picture")
            print(_line(message), flush=True)
            if isinstance(message, Departure):
                continue
            summary.add(message)
            if folder is not None:
                folder.keep(message)
            if video is not None:
                video.keep(message)
            if mcap is not None:
                mcap.keep(message)
            if cpm is not None:
                cpm.keep(message)
            pictures += 1
            if pictures == settings.pictures:
                return


def _say(text: str) -> None:
    sys.stderr.write(f"rfedge watch: {text}\n")
    sys.stderr.flush()


def _say_wait(what: str, waited_s: float) -> None:
    _say(f"waiting for {what} for {waited_s:.0f} s")


def watch_until_stopped(
    settings: WatchSettings,
    source: PictureSource,
    objects: ObjectsOf | None = None,
    field: RadianceField | None = None,
) -> None:
    """Watch to the end, or until SIGINT or SIGTERM; to be called from the main thread.

    After the first signal files are completed. If that takes longer than ``FINISH_S``, because
    nobody reads standard output or the disk does not answer, or at a second signal, the process
    ends at once, with status 1. Raises what ``watch`` raises.
    """
    signals: list[int] = []

    def note(number: int, _: object) -> None:
        signals.append(number)  # and nothing else: a handler runs between any two instructions

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        ended = _started(partial(watch, settings, source, objects, field))
        while not ended.done() and not signals:
            wait([ended], timeout=LOOK_EVERY_S)
        source.stop()
        finish_until_s = time.monotonic() + FINISH_S
        while not ended.done():
            if len(signals) > 1 or time.monotonic() > finish_until_s:
                os.write(sys.stderr.fileno(), UNFINISHED.encode())
                os._exit(1)  # the thread may hold the lock of standard output for ever
            wait([ended], timeout=LOOK_EVERY_S)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    ended.result()


def _started(watching: Callable[[], None]) -> Future[None]:
    """Watch on a thread of its own; return its outcome."""
    ended = Future[None]()

    def run() -> None:
        try:
            watching()
        except BaseException as error:
            ended.set_exception(error)
        else:
            ended.set_result(None)

    threading.Thread(target=run, name="watch", daemon=True).start()
    return ended


def _line(message: TwinPicture | Departure) -> str:
    if isinstance(message, Departure):
        return f"{message.vehicle_id}/{message.camera_id} left"
    where = "lost"
    if message.pose is not None:
        where = "at {:.2f} {:.2f} {:.2f} m".format(*message.pose.translation_m)
    instant = f"instant {message.instant}  " if message.instant else ""
    return (
        f"{message.vehicle_id}/{message.camera_id} {message.epoch}:{message.sequence:<6} {instant}"
        f"age {message.age_ns / 1e6:6.1f} ms, {message.decoding_ns / 1e6:.1f} since its last "
        f"byte  {where}  sent as {message.payload_bytes} bytes  missed {message.skipped}"
    )
