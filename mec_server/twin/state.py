"""The twin: the newest picture of every camera and some before it, and a mailbox for each consumer.

Without asyncio or clock. ``show`` costs the same whether anybody reads or not: a mailbox holds at
most the newest picture of a camera and its departure, so a consumer that reads slowly misses
pictures, but never the last one, and delays nobody. A vehicle is one entry however many streams it
has: the newest capture wins.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from threading import Lock

from rfcore.camera import Intrinsics
from rfcore.field.quality import FULL
from rfcore.image import I420
from rfcore.perception.objects import CameraKey
from rfcore.views import View
from rfcore.wire.messages import Frame
from rfcore.wire.twin import Departure, Subscription
from rfcore.wire.twin_render import DEFAULT_AGE_S, MAX_AGE_S

__all__ = [
    "PAST_S",
    "Covers",
    "KeptRenders",
    "Mailbox",
    "PastPictures",
    "ReceivedPicture",
    "Twin",
]

MAX_DEPARTED = 32
"""Last pictures kept of cameras that left."""
RENDERS_BYTES = 96 * 2**20
"""Of renders that are kept: those of 21 cameras of 640x360."""

PAST_S = 5.0
"""How long ago a moment may be of which the pictures are still there."""
KEPT_S, KEPT_EVERY_S = PAST_S + DEFAULT_AGE_S, 0.2
"""How long pictures are kept, and how many of one camera: those that vouch for such a moment."""
MOST_PAST_BYTES = 128 << 20
"""Of all cameras together: 18 at 640 x 360, 2 at 1920 x 1080. With more the past is shorter."""

Covers = Callable[[str, str], bool]
"""Whether a consumer may see the pictures of a vehicle (id) against a field (id)."""


@dataclass(frozen=True, eq=False)
class ReceivedPicture:
    """One reconstructed picture, and how old it was at ``reconstructed_s`` (monotonic).

    ``opened_time_ns``: when its session's Hello came, Unix time of this server.
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

    @property
    def key(self) -> CameraKey:
        """Which camera it is of."""
        return (self.vehicle_id, self.frame.camera_id)

    @property
    def captured_s(self) -> float:
        """When it was captured, on the server's own clock: no vehicle can claim the future."""
        return self.reconstructed_s - self.latency_s

    @property
    def picture_bytes(self) -> int:
        """How much memory its picture takes."""
        return sum(plane.nbytes for plane in self.picture.planes)

    def age_s(self, now: float) -> float:
        """Return the seconds since capture; a clock that is set back makes it no younger."""
        return self.latency_s + max(0.0, now - self.reconstructed_s)


class Mailbox:
    """What one consumer has not taken yet; ``arrived`` is called for each new entry.

    ``missed``: pictures that were replaced before they were taken, of all cameras ever.
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
        self._covers = covers
        self._known: set[CameraKey] = set()
        self.skipped: Counter[CameraKey] = Counter()
        self.missed = 0
        self._arrived = arrived
        self._entries: OrderedDict[tuple[CameraKey, type], ReceivedPicture | Departure] = (
            OrderedDict()
        )

    def __len__(self) -> int:
        return len(self._entries)

    def put(self, key: CameraKey, entry: ReceivedPicture | Departure) -> bool:
        """Keep ``entry``: a picture in place of an older one of its camera, or of its departure; a
        departure behind its last picture. Return whether a picture was missed."""
        if not (self.subscription.includes(key[0]) and self._may_see(key, entry)):
            return False
        missed = isinstance(entry, ReceivedPicture) and (key, ReceivedPicture) in self._entries
        if isinstance(entry, ReceivedPicture):
            self._entries.pop((key, Departure), None)
        if missed:
            self.skipped[key] += 1
            self.missed += 1
        self._entries[key, type(entry)] = entry
        self._arrived()
        return missed

    def _may_see(self, key: CameraKey, entry: ReceivedPicture | Departure) -> bool:
        """Whether the consumer may know of ``entry``: a departure, if it has seen the camera."""
        if isinstance(entry, Departure):
            return key in self._known
        if not self._covers(entry.vehicle_id, entry.field_id):
            return False
        self._known.add(key)
        return True

    def take(self) -> ReceivedPicture | Departure | None:
        """Return what waits longest, or None."""
        if not self._entries:
            return None
        (key, _), entry = self._entries.popitem(last=False)
        if isinstance(entry, Departure):
            self.skipped.pop(key, None)
            self._known.discard(key)
        return entry


class PastPictures:
    """Pictures that newer ones replaced: of each camera at most one in ``KEPT_EVERY_S``, for
    ``KEPT_S``, of all together at most ``most_bytes``, of which the oldest go first."""

    def __init__(self, most_bytes: int = MOST_PAST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._order: deque[ReceivedPicture] = deque()
        self._cameras: dict[CameraKey, deque[ReceivedPicture]] = {}
        self.whole_from_s = -math.inf
        """Moments before this one lack pictures for want of memory."""

    def keep(self, view: ReceivedPicture, now: float) -> None:
        """Keep a picture that a newer one, of the moment ``now``, replaces."""
        kept = self._cameras.setdefault(view.key, deque())
        if not kept or view.captured_s - kept[-1].captured_s >= KEPT_EVERY_S:
            kept.append(view)
            self._order.append(view)
            self._bytes += view.picture_bytes
        while self._order and now - self._order[0].captured_s > KEPT_S:
            self._drop()
        while self._bytes > self._most_bytes:
            self.whole_from_s = max(self.whole_from_s, self._drop())

    def of(self, key: CameraKey) -> Iterable[ReceivedPicture]:
        """Return the pictures of a camera, the oldest first."""
        return tuple(self._cameras.get(key, ()))

    def cameras(self) -> Iterable[CameraKey]:
        """Return of which cameras there are any."""
        return tuple(self._cameras)

    def _drop(self) -> float:
        """Forget the oldest; return until when it was its camera's newest."""
        oldest = self._order.popleft()
        kept = self._cameras[oldest.key]
        kept.popleft()
        self._bytes -= oldest.picture_bytes
        if kept:
            return kept[0].captured_s
        del self._cameras[oldest.key]
        return oldest.captured_s + KEPT_EVERY_S


class KeptRenders:
    """What decoders rendered of fields for the newest pictures, at full quality, so that whoever
    looks at a picture does not render its pose again. Those that were kept longest make room.

    May be used by several threads.
    """

    def __init__(self, most_bytes: int = RENDERS_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._kept: OrderedDict[CameraKey, tuple[ReceivedPicture, View]] = OrderedDict()
        self._lock = Lock()

    def keep(self, picture: ReceivedPicture, render: View) -> None:
        """Keep ``render``, of the field and pose of ``picture``, in place of its camera's last."""
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
        """Forget that of a camera."""
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
        self._views: dict[CameraKey, ReceivedPicture] = {}
        self._departed: OrderedDict[CameraKey, ReceivedPicture] = OrderedDict()
        self._mailboxes: list[Mailbox] = []
        self.missed = 0

    def show(self, view: ReceivedPicture, render: View | None = None) -> None:
        """Take in a picture, unless another stream of its vehicle has sent a newer one.

        ``render``: what its field shows there, None where that is not known.
        """
        newest = self._views.get(view.key)
        if (
            newest is not None
            and newest.session_id != view.session_id
            and newest.captured_s > view.captured_s
        ):
            return
        replaced = newest or self._departed.get(view.key)
        if replaced is not None and replaced.captured_s < view.captured_s:
            self._past.keep(replaced, view.captured_s)
        self._views[view.key] = view
        self._departed.pop(view.key, None)
        self.renders.drop(view.key)
        if render is not None:
            self.renders.keep(view, render)
        self._tell(view.key, view)

    def leave(self, session_id: str) -> None:
        """Remove the cameras of a stream that ended, unless another stream took them over."""
        for key, view in tuple(self._views.items()):
            if view.session_id == session_id:
                del self._views[key]
                self._departed[key] = view
                self.renders.drop(key)
                if len(self._departed) > MAX_DEPARTED:
                    self._departed.popitem(last=False)
                self._tell(key, Departure(*key))

    def cameras_of(self, session_id: str) -> list[list[ReceivedPicture]]:
        """Return the kept pictures of each camera that a stream has now, the oldest first."""
        return [
            [*(past for past in self._past.of(key) if past.session_id == session_id), view]
            for key, view in self._views.items()
            if view.session_id == session_id
        ]

    def reach_s(self, now: float) -> float:
        """Return how long ago a moment may be, of those that ``at`` knows all pictures of."""
        return max(0.0, min(PAST_S, now - self._past.whole_from_s))

    def at(self, moment_s: float, max_age_s: float) -> list[ReceivedPicture]:
        """Return the picture of every camera that it had captured last at a moment (monotonic), if
        it was no older than ``max_age_s`` then."""
        views = []
        for key in {**self._views, **self._departed, **dict.fromkeys(self._past.cameras())}:
            newest = (views_of.get(key) for views_of in (self._departed, self._views))
            known = (*self._past.of(key), *(view for view in newest if view is not None))
            before = [v for v in known if 0 <= moment_s - v.captured_s <= max_age_s]
            views += sorted(before, key=lambda view: view.captured_s)[-1:]
        return views

    def recent(self, now: float, max_age_s: float) -> list[ReceivedPicture]:
        """Return the newest picture of every camera that is no older than ``max_age_s``, also of
        cameras that left; those of them that are older than ``MAX_AGE_S`` are forgotten."""
        for key, view in tuple(self._departed.items()):
            if view.age_s(now) > MAX_AGE_S:
                del self._departed[key]
        views = (*self._views.values(), *self._departed.values())
        return [view for view in views if view.age_s(now) <= max_age_s]

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
        for key, view in self._views.items():
            mailbox.put(key, view)
        self._mailboxes.append(mailbox)
        return mailbox

    def unwatch(self, mailbox: Mailbox) -> None:
        """Forget a consumer."""
        self._mailboxes.remove(mailbox)

    def ages_s(self, now: float) -> Mapping[str, float]:
        """Return, for each vehicle, the age of the oldest of its cameras' newest pictures."""
        ages: dict[str, float] = {}
        for view in tuple(self._views.values()):
            ages[view.vehicle_id] = max(ages.get(view.vehicle_id, 0.0), view.age_s(now))
        return ages

    def _tell(self, key: CameraKey, entry: ReceivedPicture | Departure) -> None:
        for mailbox in self._mailboxes:
            self.missed += mailbox.put(key, entry) and mailbox.counts_misses
