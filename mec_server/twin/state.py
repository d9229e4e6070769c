"""The twin: the newest picture of every camera and some before it, and a mailbox for each consumer.

Without asyncio or clock. ``show`` costs the same whether anybody reads or not: a mailbox holds at
most the newest picture of a camera and its departure, so a consumer that reads slowly misses
pictures, but never the last one, and delays nobody. A camera has one entry however many streams of
its vehicle send it: the newest capture wins.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from threading import Lock

from rfcore.camera import Camera, Intrinsics
from rfcore.field.quality import FULL
from rfcore.image import I420
from rfcore.perception.objects import CameraKey
from rfcore.views import View
from rfcore.wire.messages import Frame
from rfcore.wire.twin import Departure, NewestQueue, Subscription
from rfcore.wire.twin_render import DEFAULT_AGE_S, MAX_AGE_S

MAX_DEPARTED = 32
"""Last pictures kept of cameras that left."""
RENDERS_BYTES = 96 * 2**20
"""Memory for renders that are kept: enough for 21 cameras of 640x360."""

PAST_S = 5.0
"""Greatest age of the moment of a view."""
KEPT_S, KEPT_EVERY_S = PAST_S + DEFAULT_AGE_S, 0.2
"""Time for which pictures are kept for such views, and the least time between two of one camera."""
MOST_PAST_BYTES = 128 << 20
"""Memory for past pictures: 18 cameras of 640 x 360, or 2 of 1920 x 1080; with more cameras the
past is shorter."""

Covers = Callable[[str, str], bool]
"""Decides whether a consumer may see the pictures of a vehicle (id) against a field (id)."""


@dataclass(frozen=True, eq=False)
class ReceivedPicture:
    """A reconstructed picture, ``latency_s`` old at ``reconstructed_s`` (monotonic).

    ``decoding_s``: from the last byte of its frame.
    ``opened_time_ns``: when its session's Hello arrived, Unix time of this server.
    """

    vehicle_id: str
    session_id: str
    frame: Frame
    intrinsics: Intrinsics
    field_id: str
    picture: I420
    digest: bytes
    reconstructed_s: float
    latency_s: float
    opened_time_ns: int = 0
    decoding_s: float = 0.0

    @property
    def key(self) -> CameraKey:
        """The vehicle and camera that it is of."""
        return (self.vehicle_id, self.frame.camera_id)

    @property
    def captured_s(self) -> float:
        """The time of its capture by the server's own clock: no vehicle can claim the future."""
        return self.reconstructed_s - self.latency_s

    @property
    def picture_bytes(self) -> int:
        """The memory that its picture takes."""
        return sum(plane.nbytes for plane in self.picture.planes)

    def age_s(self, now: float) -> float:
        """Return the seconds since capture; a clock that is set back makes it no younger."""
        return self.latency_s + max(0.0, now - self.reconstructed_s)


Entry = ReceivedPicture | Departure


class Mailbox:
    """The entries that one consumer has not taken yet; ``arrived`` is called for each new one.

    ``missed``: pictures that were replaced before they were taken; ``skipped``: the same for each
    camera that is there now.
    """

    def __init__(
        self,
        subscription: Subscription,
        arrived: Callable[[], None],
        covers: Covers = lambda _vehicle_id, _field_id: True,
        *,
        counts_misses: bool = True,
    ) -> None:
        self.subscription = subscription
        self.counts_misses = counts_misses
        self.skipped: Counter[CameraKey] = Counter()
        self._covers = covers
        self._known: set[CameraKey] = set()
        self._entries: NewestQueue[tuple[CameraKey, type], Entry] = NewestQueue(arrived)

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def missed(self) -> int:
        """The number of pictures that were replaced before they were taken, of all cameras ever."""
        return self._entries.missed

    def put(self, entry: Entry) -> bool:
        """Add a picture in place of an older one of its camera, or of its departure; a departure
        behind the camera's last picture. Return whether a picture was missed."""
        key = entry.key
        if not (self.subscription.includes(key[0]) and self._may_see(entry)):
            return False
        if isinstance(entry, ReceivedPicture):
            self._entries.discard((key, Departure))
        missed = self._entries.put((key, type(entry)), entry)
        self.skipped[key] += missed
        return missed

    def _may_see(self, entry: Entry) -> bool:
        """Return whether the consumer may see a picture; a departure, if it knows the camera."""
        if isinstance(entry, Departure):
            return entry.key in self._known
        if not self._covers(entry.vehicle_id, entry.field_id):
            return False
        self._known.add(entry.key)
        return True

    def take(self) -> Entry | None:
        """Remove and return the entry that waits longest; None if there is none."""
        entry = self._entries.take()
        if isinstance(entry, Departure):
            self.skipped.pop(entry.key, None)
            self._known.discard(entry.key)
        return entry


class PastPictures:
    """Keeps pictures that newer ones replaced, for ``KEPT_S``.

    Of each camera it keeps at most one in ``KEPT_EVERY_S``, and of all together ``most_bytes``;
    where that is not enough the oldest are dropped.
    """

    def __init__(self, most_bytes: int = MOST_PAST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._order: deque[ReceivedPicture] = deque()
        self._cameras: dict[CameraKey, deque[ReceivedPicture]] = {}
        self.whole_from_s = -math.inf
        """History before this moment is incomplete (memory limit)."""

    def keep(self, picture: ReceivedPicture, now: float) -> None:
        """Keep a picture that a newer one, captured at ``now``, replaces."""
        kept = self._cameras.setdefault(picture.key, deque())
        if not kept or picture.captured_s - kept[-1].captured_s >= KEPT_EVERY_S:
            kept.append(picture)
            self._order.append(picture)
            self._bytes += picture.picture_bytes
        while self._order and now - self._order[0].captured_s > KEPT_S:
            self._drop()
        while self._bytes > self._most_bytes:
            self.whole_from_s = max(self.whole_from_s, self._drop())

    def of(self, key: CameraKey) -> Iterable[ReceivedPicture]:
        """Return the kept pictures of a camera, the oldest first."""
        return tuple(self._cameras.get(key, ()))

    def cameras(self) -> Iterable[CameraKey]:
        """Return the cameras of which pictures are kept."""
        return tuple(self._cameras)

    def _drop(self) -> float:
        """Drop the oldest; return the time until which it was its camera's newest."""
        oldest = self._order.popleft()
        kept = self._cameras[oldest.key]
        kept.popleft()
        self._bytes -= oldest.picture_bytes
        if kept:
            return kept[0].captured_s
        del self._cameras[oldest.key]
        return oldest.captured_s + KEPT_EVERY_S


class KeptRenders:
    """Keeps the decoders' renders for the newest pictures, so that no pose is rendered twice.

    Only renders at full quality are kept; where memory is short the oldest are dropped. May be
    used by several threads.
    """

    def __init__(self, most_bytes: int = RENDERS_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._kept: OrderedDict[CameraKey, tuple[ReceivedPicture, View]] = OrderedDict()
        self._lock = Lock()

    def keep(self, picture: ReceivedPicture, render: View) -> None:
        """Keep ``render``, of the field and pose of ``picture``, instead of its camera's last."""
        with self._lock:
            self._drop(picture.key)
            if picture.frame.quality == FULL:
                self._kept[picture.key] = picture, render
                self._bytes += _bytes_of(render)
            while self._bytes > self._most_bytes:
                self._drop(next(iter(self._kept)))

    def of(self, picture: ReceivedPicture) -> View | None:
        """Return the render of ``picture``, None if it is not kept."""
        with self._lock:
            kept = self._kept.get(picture.key)
        return kept[1] if kept is not None and kept[0] is picture else None

    def drop(self, key: CameraKey) -> None:
        """Drop the render of a camera."""
        with self._lock:
            self._drop(key)

    def _drop(self, key: CameraKey) -> None:
        kept = self._kept.pop(key, None)
        if kept is not None:
            self._bytes -= _bytes_of(kept[1])


def _bytes_of(render: View) -> int:
    return render.colour.nbytes + render.depth.nbytes + render.opacity.nbytes


class Twin:
    """The newest picture of every camera of every vehicle, and some before it."""

    def __init__(self) -> None:
        self._past = PastPictures()
        self.renders = KeptRenders()
        self._newest: dict[CameraKey, ReceivedPicture] = {}
        self._departed: OrderedDict[CameraKey, ReceivedPicture] = OrderedDict()
        self._mailboxes: list[Mailbox] = []
        self.missed = 0
        self.expect: Callable[[str, Camera], None] = _nobody_expects
        """Called with field id and camera when the decoding of a picture with a pose begins."""

    def show(self, picture: ReceivedPicture, render: View | None = None) -> None:
        """Show a picture, unless another stream of its vehicle has sent a newer one.

        ``render``: the view of its field there, None where that is not known.
        """
        newest = self._newest.get(picture.key)
        if (
            newest is not None
            and newest.session_id != picture.session_id
            and newest.captured_s > picture.captured_s
        ):
            return
        replaced = newest or self._departed.get(picture.key)
        if replaced is not None and replaced.captured_s < picture.captured_s:
            self._past.keep(replaced, picture.captured_s)
        self._newest[picture.key] = picture
        self._departed.pop(picture.key, None)
        self.renders.drop(picture.key)
        if render is not None:
            self.renders.keep(picture, render)
        self._deliver(picture)

    def leave(self, session_id: str) -> None:
        """Remove the cameras of a stream that ended, unless another stream took them over."""
        for key, picture in tuple(self._newest.items()):
            if picture.session_id == session_id:
                del self._newest[key]
                self._departed[key] = picture
                self.renders.drop(key)
                if len(self._departed) > MAX_DEPARTED:
                    self._departed.popitem(last=False)
                self._deliver(Departure(*key))

    def cameras_of(self, session_id: str) -> list[list[ReceivedPicture]]:
        """Return the kept pictures of each camera that a stream has now, the oldest first."""
        return [
            [*(past for past in self._past.of(key) if past.session_id == session_id), picture]
            for key, picture in self._newest.items()
            if picture.session_id == session_id
        ]

    def reach_s(self, now: float) -> float:
        """Return how far back ``at`` knows all pictures."""
        return max(0.0, min(PAST_S, now - self._past.whole_from_s))

    def at(self, moment_s: float, max_age_s: float) -> list[ReceivedPicture]:
        """Return the last picture that each camera had captured at a moment (monotonic), unless it
        was older than ``max_age_s`` then."""
        pictures = []
        for key in {**self._newest, **self._departed, **dict.fromkeys(self._past.cameras())}:
            known = (*self._past.of(key), self._departed.get(key), self._newest.get(key))
            before = [
                picture
                for picture in known
                if picture is not None and 0 <= moment_s - picture.captured_s <= max_age_s
            ]
            pictures += sorted(before, key=lambda picture: picture.captured_s)[-1:]
        return pictures

    def recent(self, now: float, max_age_s: float) -> list[ReceivedPicture]:
        """Return the newest picture of every camera, if it is no older than ``max_age_s``.

        Cameras that left count, too; their pictures are forgotten after ``MAX_AGE_S``.
        """
        for key, picture in tuple(self._departed.items()):
            if picture.age_s(now) > MAX_AGE_S:
                del self._departed[key]
        pictures = (*self._newest.values(), *self._departed.values())
        return [picture for picture in pictures if picture.age_s(now) <= max_age_s]

    def watch(
        self,
        subscription: Subscription,
        arrived: Callable[[], None],
        covers: Covers = lambda _vehicle_id, _field_id: True,
        *,
        counts_misses: bool = True,
    ) -> Mailbox:
        """Return a new consumer's mailbox, filled with the newest picture of each camera that it
        asks for and ``covers``."""
        mailbox = Mailbox(subscription, arrived, covers, counts_misses=counts_misses)
        for picture in self._newest.values():
            mailbox.put(picture)
        self._mailboxes.append(mailbox)
        return mailbox

    def unwatch(self, mailbox: Mailbox) -> None:
        """Remove a consumer's mailbox."""
        self._mailboxes.remove(mailbox)

    def ignore_expected(self) -> None:
        """Stop calling ``expect`` when decoding begins."""
        self.expect = _nobody_expects

    def ages_s(self, now: float) -> Mapping[str, float]:
        """Return, for each vehicle, the age of the oldest of its cameras' newest pictures."""
        ages: dict[str, float] = {}
        for picture in tuple(self._newest.values()):
            ages[picture.vehicle_id] = max(ages.get(picture.vehicle_id, 0.0), picture.age_s(now))
        return ages

    def _deliver(self, entry: Entry) -> None:
        for mailbox in self._mailboxes:
            self.missed += mailbox.put(entry) and mailbox.counts_misses


def _nobody_expects(_field_id: str, _camera: Camera) -> None:
    return
