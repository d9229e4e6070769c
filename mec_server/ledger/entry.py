"""Admission of vehicles: decides what a stream may have, and keeps account of it.

Sans-IO: ``now`` is an argument. ``StreamAccount`` is one stream's side of the ledger: made when the
stream opens, charged with every message, and closed with it. ``ActiveCameras`` knows which streams
send which cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from mec_server.config import AdmissionLimits
from mec_server.ledger.budgets import Budget, Limit, Resource, decoders_of
from mec_server.ledger.ledger import Hold, Ledger, TokenBucket
from mec_server.ledger.promises import ASSUMED_HZ, Promises
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Frame, Hello, PoseAhead

CAMERA_SILENT_S = 3.0
"""Silence after which another agent may take a camera over: by then the stream's own keepalive (2 s
and 1 s) has noticed a dead connection. Cameras slower than 1 Hz get two of their periods more."""


class CameraSender(Protocol):
    """A stream, as ``ActiveCameras`` sees it."""

    @property
    def agent(self) -> str:
        """The agent process that opened the stream; an agent may open several."""

    def silent_s(self, now: float) -> float:
        """Return how long it has sent nothing; 0 while it waits for an answer."""

    def displace(self, error: LimitExceeded) -> None:
        """End it: another agent sends its cameras from now on."""


class ActiveCameras:
    """Knows which streams send which cameras, so that two agents never send the same one.

    Streams of one agent may share a camera: during a handover between tiles, or when its stream
    broke and is opened again. Another agent is refused while a stream of the first one is alive;
    one that has fallen silent is ended, and the other agent takes its cameras over.
    """

    def __init__(self) -> None:
        self._senders: dict[tuple[str, str], dict[CameraSender, float]] = {}

    def enter(self, hello: Hello, sender: CameraSender, now: float) -> None:
        """Note that ``sender`` sends the cameras of ``hello``; raise ``LimitExceeded``."""
        cameras = {(hello.vehicle_id, c.camera_id): c.rate_hz for c in hello.cameras}
        displaced: dict[CameraSender, str] = {}
        for key in cameras:
            for other, silent_after_s in self._senders.get(key, {}).items():
                if other.agent == sender.agent:
                    continue
                if other.silent_s(now) < silent_after_s:
                    raise _taken(key, silent_after_s)
                displaced[other] = "/".join(key)
        for other, camera in displaced.items():
            self.leave(other)
            other.displace(_displaced(camera, other.silent_s(now)))
        for key, rate_hz in cameras.items():
            slower_s = 2.0 / rate_hz if 0 < rate_hz < 1 else 0.0
            self._senders.setdefault(key, {})[sender] = CAMERA_SILENT_S + slower_s

    def leave(self, sender: CameraSender) -> None:
        """Forget a stream; does nothing for one that was refused or displaced."""
        for key in [key for key, senders in self._senders.items() if sender in senders]:
            del self._senders[key][sender]
            if not self._senders[key]:
                del self._senders[key]


def _taken(key: tuple[str, str], silent_after_s: float) -> LimitExceeded:
    vehicle_id, camera_id = key
    return LimitExceeded(
        Limit.CAMERA_TAKEN,
        f"another agent sends camera {camera_id} of vehicle {vehicle_id}; stop it, or give this "
        f"one another --vehicle or --camera (an agent that sends nothing for {silent_after_s:g} s "
        "may be replaced)",
        silent_after_s,
    )


def _displaced(camera: str, silent_s: float) -> LimitExceeded:
    return LimitExceeded(
        Limit.CAMERA_TAKEN,
        f"nothing came for {silent_s:.1f} s, and another agent sends {camera} now",
        CAMERA_SILENT_S,
    )


RATE_MARGIN = 1.25
"""A camera may exceed its granted rate by a quarter: its clock and its link are not the server's.
"""

LEAST_BURST_FRAMES = 8
"""Burst of frames that a camera may send: those in flight, each captured anew after a Nack."""

UNSTATED_HZ = 30 * ASSUMED_HZ
"""Rate limit of a camera that stated no rate and was granted none: more than any films, and a
quarter of what its identity may send."""

RAW_BYTES_PER_PIXEL = 1.5
"""Size of an I420 picture; a coded one that is larger would be useless."""


class CameraMeter:
    """Frames and bytes that one camera may send: its granted rate, with some margin.

    ``rate_hz`` 0: ``UNSTATED_HZ``.
    """

    def __init__(self, pixels: int, rate_hz: float, now: float) -> None:
        self._raw_bytes = RAW_BYTES_PER_PIXEL * pixels
        self._rate_hz = rate_hz or UNSTATED_HZ
        rate, burst = self._rate_and_burst()
        raw = self._raw_bytes
        self._frames = TokenBucket(rate, now, burst)
        self._sizes = TokenBucket(rate * raw, now, burst * raw)

    def grant(self, rate_hz: float, now: float) -> None:
        """Let it send ``rate_hz`` pictures per second from now on."""
        self._rate_hz = rate_hz or UNSTATED_HZ
        rate, burst = self._rate_and_burst()
        self._frames.set_rate(rate, now, burst)
        self._sizes.set_rate(rate * self._raw_bytes, now, burst * self._raw_bytes)

    def _rate_and_burst(self) -> tuple[float, float]:
        rate = RATE_MARGIN * self._rate_hz
        return rate, max(rate, float(LEAST_BURST_FRAMES))

    def spend(self, message_bytes: int, now: float) -> None:
        """Count a frame; raise ``LimitExceeded`` if it is one too many."""
        if not self._frames.take(1, now):
            wait_s = self._frames.wait_s(now)
            raise LimitExceeded(
                Limit.CAMERA_FRAMES,
                f"this camera may send {self._rate_hz:g} pictures a second; "
                f"come again in {wait_s:.3g} s",
                wait_s,
            )
        if not self._sizes.take(message_bytes, now):
            wait_s = self._sizes.wait_s(now)
            raise LimitExceeded(
                Limit.CAMERA_BYTES,
                f"more bytes than {self._rate_hz:g} pictures a second have uncoded; "
                f"come again in {wait_s:.3g} s",
                wait_s,
            )


class StreamAccount:
    """The resources that one stream holds and is charged for; ``close`` gives everything back.

    ``identity`` is charged. Without certificates (``named`` false) that is the connection until a
    Hello names a vehicle.
    """

    def __init__(
        self, entry: EntryControl, session_id: str, identity: str, named: bool, now: float
    ) -> None:
        self.identity = identity
        self._entry = entry
        self._session_id = session_id
        self._named = named
        self._cameras: dict[str, CameraMeter] = {}
        self._aheads: dict[str, CameraMeter] = {}
        self._unclaimed_s: dict[str, float] = {}
        self._granted: list[Callable[[], None]] = []
        self._decoders: Hold | None = None
        self._is_unpaid = False
        self._stream = entry.ledger.hold(identity, Resource.STREAMS, now)

    def enter(self, hello: Hello, sender: CameraSender, now: float) -> float:
        """Let the stream in with the cameras of ``hello``; return the rate of each (0: any).

        What an earlier Hello was granted is given back first. Raises ``LimitExceeded``, after
        which nothing but the stream itself is held.
        """
        self.leave()
        entry, ledger = self._entry, self._entry.ledger
        identity = self.identity if self._named else hello.vehicle_id
        ledger.check_decoders(identity, now)
        ledger.check_opening(identity, now)
        self._stream.transfer(identity, now)
        self.identity = identity
        try:
            self._decoders = ledger.hold(identity, Resource.DECODERS, now, decoders_of(hello))
            self._granted.append(self._release_decoders)
            self._granted.append(lambda: entry.promises.leave(self._session_id))
            doubtful = ledger.is_doubtful(identity, now)
            rate_hz = entry.promises.enter(
                self._session_id, identity, hello, now, is_doubtful=doubtful
            )
            self._granted.append(lambda: entry.cameras.leave(sender))
            entry.cameras.enter(hello, sender, now)
        except LimitExceeded:
            self.leave()
            raise
        self._cameras, self._aheads = (
            {
                camera.camera_id: CameraMeter(
                    camera.intrinsics.width_px * camera.intrinsics.height_px,
                    rate_hz or max(UNSTATED_HZ, camera.rate_hz),
                    now,
                )
                for camera in hello.cameras
            }
            for _ in range(2)
        )
        return rate_hz

    def grant(self, rate_hz: float, now: float) -> None:
        """Let each camera send ``rate_hz`` pictures per second from now on."""
        for camera in (*self._cameras.values(), *self._aheads.values()):
            camera.grant(rate_hz, now)

    def spend_message(self, message_bytes: int, now: float) -> None:
        """Count a message, whatever it is; raise ``LimitExceeded`` if it is one too many."""
        ledger = self._entry.ledger
        ledger.spend(self.identity, Resource.MESSAGES, 1, now)
        ledger.spend(self.identity, Resource.BYTES, message_bytes, now)

    def spend_frame(self, frame: Frame, message_bytes: int, now: float) -> None:
        """Count a frame of a camera; raise ``LimitExceeded`` if it is one too many.

        An identity that kept workers busy for longer than its share, or for long with frames that
        were rejected, waits until that is made up for, unless it is alone.
        """
        self._spend(self._cameras.get(frame.camera_id), message_bytes, now)

    def spend_ahead(self, ahead: PoseAhead, message_bytes: int, now: float) -> None:
        """Count a pose ahead of its frame, as often as frames may come; raise ``LimitExceeded``."""
        self._spend(self._aheads.get(ahead.camera_id), message_bytes, now)

    def _spend(self, camera: CameraMeter | None, message_bytes: int, now: float) -> None:
        if camera is not None:
            camera.spend(message_bytes, now)
        if self._entry.promises.is_crowded:
            for resource in (Resource.WORKER_SECONDS, Resource.REJECTED_SECONDS):
                self._entry.ledger.check(self.identity, resource, now)

    def is_doubtful(self, now: float) -> bool:
        """Return whether work for this identity came to nothing lately (``Ledger.is_doubtful``)."""
        return self._entry.ledger.is_doubtful(self.identity, now)

    def expected_s(self, camera_id: str) -> float:
        """Return how long the next frame of a camera will keep a worker busy."""
        expected_s = self._entry.promises.expected_s(self._session_id)
        return max(0.0, expected_s - self._unclaimed_s.get(camera_id, 0.0))

    def prepared(self, camera_id: str, worker_s: float, now: float) -> None:
        """Charge the time for which a frame that is to come kept a worker busy.

        What was done before for a frame that did not come counts as rejected.
        """
        self.rejected(self._unclaimed_s.get(camera_id, 0.0), now)
        self._unclaimed_s[camera_id] = worker_s
        self._charge_work(worker_s, now)

    def worked(
        self,
        camera_id: str,
        field_id: str,
        worker_s: float,
        now: float,
        *,
        complete: bool = True,
    ) -> float:
        """Charge the time for which a frame kept a worker busy; ``complete``: it was not rejected.

        Returns that time with what was done before it came.
        """
        whole_s = worker_s + self._unclaimed_s.pop(camera_id, 0.0)
        self._entry.promises.worked(self._session_id, field_id, whole_s, complete=complete)
        self._charge_work(worker_s, now)
        if complete:
            self._is_unpaid = False
            self._entry.ledger.opening_paid(self.identity, now)
        return whole_s

    def _charge_work(self, worker_s: float, now: float) -> None:
        lent = not self._entry.promises.is_crowded
        self._entry.ledger.charge(self.identity, Resource.WORKER_SECONDS, worker_s, now, lent=lent)

    def rejected(self, worker_s: float, now: float) -> None:
        """Charge the time for which a frame kept a worker busy that is itself to blame for its
        rejection."""
        self._entry.ledger.charge(self.identity, Resource.REJECTED_SECONDS, worker_s, now)

    def opening_failed(self, now: float) -> None:
        """Count an opening that came to nothing: decoders that could not be opened, or a stream
        that ended because its frames could not be used."""
        self._is_unpaid = False
        self._entry.ledger.opening_failed(self.identity, now)

    def ended(self, now: float) -> None:
        """Note that the stream is over; decoders that never gave a picture were for nothing."""
        self.rejected(sum(self._unclaimed_s.values()), now)
        self._unclaimed_s.clear()
        if self._is_unpaid:
            self.opening_failed(now)

    def take_decoders(self) -> Hold:
        """Hand over the hold on decoders to the caller, who releases it once they are closed: later
        than the stream, if a decoder hangs."""
        decoders, self._decoders = self._decoders, None
        self._is_unpaid = True
        if decoders is None:
            raise AssertionError("no Hello was let in")
        return decoders

    def lost_decoder(self, now: float) -> None:
        """Count a decoder that a packet cost; raise ``LimitExceeded`` if that bars the vehicle."""
        self._entry.ledger.lost_decoder(self.identity, now)

    def leave(self) -> None:
        """Give back what Hello was granted: decoders, promised time, cameras."""
        granted, self._granted = self._granted, []
        self._cameras, self._aheads = {}, {}
        for give_back in reversed(granted):
            give_back()

    def close(self) -> None:
        """Give back everything."""
        self.leave()
        self._stream.release()

    def _release_decoders(self) -> None:
        if self._decoders is not None:
            self._decoders.release()


class EntryControl:
    """The ledger, the promises of worker time and the cameras that are sent, of one server."""

    def __init__(
        self,
        budgets: Mapping[Resource, Budget],
        limits: AdmissionLimits,
        workers: int,
        share: float,
        now: float,
    ) -> None:
        self.ledger = Ledger(budgets, now)
        self.promises = Promises(limits, workers, share)
        self.cameras = ActiveCameras()

    def open(self, session_id: str, identity: str, named: bool, now: float) -> StreamAccount:
        """Return the account of a new stream; raise ``LimitExceeded`` if it is one too many."""
        return StreamAccount(self, session_id, identity, named, now)

    def reallocate_rates(self, now: float) -> dict[str, float]:
        """Return the new rates of the sessions whose rate changes.

        An identity that is lent more than its share of the workers may also spend it.
        """
        changed = self.promises.reallocate_rates(now)
        if changed:
            share = self.ledger.budget(Resource.WORKER_SECONDS).identity
            for identity in self.promises.identities():
                rate = max(share, RATE_MARGIN * self.promises.promised_to(identity))
                self.ledger.refill(identity, Resource.WORKER_SECONDS, rate, now)
        return changed
