"""Metrics of the server. Names begin with ``rfedge_server_``; those of the twin are in ``twin``.

The values of every label are a closed set that no peer can add to, since each value is a time
series for ever. So no metric tells vehicles apart unless ``per_vehicle`` is set; then a vehicle's
series are removed when its last stream ends.
"""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from enum import StrEnum
from functools import cached_property, partial

import structlog
from prometheus_client import CollectorRegistry, Counter, Histogram

from mec_server.config import DecoderKind
from mec_server.decoding.process import LossCause
from mec_server.ledger.budgets import HELD, SPENT, Limit
from mec_server.ledger.entry import EntryControl
from mec_server.ledger.peer_log import LogLimiter
from mec_server.tile_history import TileHistory
from rfcore.codec.references import references_name
from rfcore.errors import RejectReason
from rfcore.field import RadianceField
from rfcore.wire.instruments import Instruments, Readings
from rfcore.wire.messages import Ack, Frame, Nack, ServerMessage, StageTimes
from rfcore.wire.tiles import Tile

log = structlog.get_logger()


class BackgroundTask(StrEnum):
    """A task that runs beside the event loop's callbacks, and the effect of an exception in it."""

    PUBLICATIONS = "publications"
    """Looks for newly published fields; goes on with its next look."""
    FIELDS = "fields"
    """Looks for archives in the folder of fields; goes on with its next look."""
    OPENING = "opening"
    """Opens a stream's fields and decoders; a failure ends that stream, if it still lives."""
    OUTCOME = "outcome"
    """Hands the outcome of a worker to its stream; the others are still handed over."""
    CLOSING = "closing"
    """Closes a decoder of a stream that is over."""
    DECODER_START = "decoder_start"
    """Starts the spare decoder process; another one is started when one is needed."""
    STREAM = "stream"
    """Serves one stream of a vehicle, which ends; the vehicle may open another."""
    ACCESS = "access"
    """Follows the access file and ends calls that are not permitted any more; goes on."""
    CONNECTIONS = "connections"
    """Closes connections of addresses that hold too many; goes on with its next look."""
    CONSUMER = "consumer"
    """Serves one consumer of the twin, whose stream ends."""
    NOTICES = "notices"
    """Looks at pictures for vehicles that take notices; goes on with the next picture."""
    RECORDING = "recording"
    """Writes pictures to disk; recording ends for good, streaming goes on."""
    NATS_TWIN = "nats_twin"
    """Publishes pictures over NATS; begins anew, with a connection of its own."""
    NATS_FIELDS = "nats_fields"
    """Exchanges fields with other servers over NATS; begins anew."""
    LEARNING = "learning"
    """Keeps the learning process running and reads its results; continues at the next look."""


class OpeningResult(StrEnum):
    """The result of opening a stream's decoders."""

    OPENED = "opened"
    FAILED = "failed"
    CANCELLED = "cancelled"
    """The stream was over before its decoders were open."""


MAX_AHEAD_S, MAX_BEHIND_S = 1.0, 60.0
"""A capture time further ahead of the server's clock, or further behind it, is implausible: clocks
kept by NTP differ by milliseconds, and no frame is delivered after a minute."""

STAGES = tuple(f.name.removesuffix("_ns") for f in fields(StageTimes) if f.name != "total_ns")


class ServerMetrics:
    """Counters and histograms on a registry of their own."""

    def __init__(self, registry: CollectorRegistry, *, per_vehicle: bool = False) -> None:
        self.per_vehicle = per_vehicle
        self.instruments = make = Instruments(registry)
        make.process()
        make.devices()
        vehicle = ("vehicle",) if per_vehicle else ()
        self.sessions = make.gauge("rfedge_server_sessions", "Streams that are open.")
        self.workers = make.gauge("rfedge_server_workers", "Frames that may be in work at once.")
        self.frames = make.counter(
            "rfedge_server_frames",
            "Frames by result (acked, nacked) and reject reason.",
            (*vehicle, "result", "reason"),
        )
        self.received = make.counter(
            "rfedge_server_received_bytes",
            "Bytes of coded frames received: pose, header and payload, and of poses ahead of them.",
            vehicle,
        )
        self.poses_ahead = make.counter(
            "rfedge_server_poses_ahead",
            "Poses that came ahead of their frames: taken, or refused as damaged or repeated.",
            ("result",),
        )
        self.poses_prepared = make.counter(
            "rfedge_server_poses_prepared",
            "Poses that were rendered before their frames came; the others found no worker free.",
        )
        self.payload = make.counter(
            "rfedge_server_payload_bytes",
            "Bytes of P slices received, by the reference pictures they predict from.",
            (*vehicle, "references"),
        )
        self.coded = make.counter(
            "rfedge_server_coded_frames",
            "Frames received, by the reference pictures they predict from.",
            (*vehicle, "references"),
        )
        self.stages = make.seconds(
            "rfedge_server_stage_seconds",
            "Time of a frame by stage: queue (waiting), render, splice, decode; ahead: the work "
            "done before the frame came, of those with any.",
            ("stage",),
        )
        self._stages = [(f"{stage}_ns", self.stages.labels(stage)) for stage in STAGES]
        self.answer = make.seconds(
            "rfedge_server_frame_seconds", "From the last byte of a frame to its Ack."
        )
        self.latency = make.seconds(
            "rfedge_server_capture_to_picture_seconds",
            "From the vehicle's capture to the reconstructed picture; needs synchronised clocks.",
            vehicle,
        )
        self.inexact = make.counter(
            "rfedge_server_inexact_frames",
            "Frames decoded against a render that differs from the vehicle's by rounding.",
        )
        self.limited = make.counter(
            "rfedge_server_limited",
            "Calls and streams refused or ended, and frames refused, because of a limit.",
            ("limit",),
        )
        self.refused_certificates = make.counter(
            "rfedge_server_refused_certificates",
            "Calls refused or ended for their certificate: revoked, expired, or other grants.",
        )
        self.implausible_captures = make.counter(
            "rfedge_server_implausible_captures",
            "Frames captured far from the server's clock; no age or latency is made of them.",
        )
        self._promised = make.gauge(
            "rfedge_server_promised_ratio",
            "Worker time that vehicles were promised, of what may be; above 1: frames take longer.",
        )
        self._reduced = make.gauge(
            "rfedge_server_reduced_vehicles",
            "Vehicles that were granted a lower rate than they asked for.",
        )
        self._identities = make.gauge(
            "rfedge_server_identities", "Identities that hold something, or did lately."
        )
        self._held = make.gauge(
            "rfedge_server_held", "What all identities together hold, by resource.", ("resource",)
        )
        self._most_held = make.gauge(
            "rfedge_server_most_held", "What the identity holds that holds most.", ("resource",)
        )
        self._budget = make.gauge(
            "rfedge_server_budget", "What all identities together may hold.", ("resource",)
        )
        self._identity_budget = make.gauge(
            "rfedge_server_identity_budget", "What one identity may hold.", ("resource",)
        )
        self._spent: Callable[[], Readings] = dict
        make.read(
            "rfedge_server_spent_total",
            "What identities spent: calls, messages, bytes, worker_seconds, rejected_seconds.",
            ("resource",),
            lambda: self._spent(),
        )
        self._suppressed: Callable[[], float] = float
        make.read(
            "rfedge_server_log_lines_suppressed_total",
            "Log lines about peers that were not written, since their identity caused too many.",
            (),
            lambda: {(): self._suppressed()},
        )
        self.decoders_lost = make.counter(
            "rfedge_server_decoders_lost",
            "Decoder processes that died in use: by a signal, by themselves, or for being slow.",
            ("cause",),
        )
        self._decoder = make.gauge(
            "rfedge_server_decoder",
            "Where packets are decoded: 1 for the kind in force, 0 for the others.",
            ("kind",),
        )
        self._task_failures = make.counter(
            "rfedge_server_task_failures",
            "Unexpected exceptions by background task; each is logged, and the server goes on.",
            ("task",),
        )
        self._openings = make.counter(
            "rfedge_server_openings",
            "Streams whose fields and decoders were to be opened, by result.",
            ("result",),
        )
        self.recording = make.gauge(
            "rfedge_server_recording",
            "1 while pictures are recorded, 0 when none are asked for or the disk refused.",
        )
        self.recording_dropped = make.counter(
            "rfedge_server_recording_dropped_pictures",
            "Pictures that were not recorded, since the disk was too slow.",
        )
        self._tile_payload = make.counter(
            "rfedge_server_tile_payload_bytes",
            "Bytes of P slices that became pictures, by the tile of their field; empty: of none.",
            ("tile",),
        )
        self._tile_pictures = make.counter(
            "rfedge_server_tile_pictures",
            "Pictures reconstructed, by the tile of their field; empty: of none.",
            ("tile",),
        )
        self._tile_of: dict[str, str] = {}
        self._published_tile_of: dict[str, str] = {}
        self._lights = make.gauge(
            "rfedge_server_tile_lights", "Fields of other lights that a tile publishes.", ("tile",)
        )
        self._passes = make.gauge(
            "rfedge_server_tile_passes",
            "Passes that the current lights of a tile were learnt from.",
            ("tile",),
        )
        self._learnt = make.gauge(
            "rfedge_server_tile_learnt_timestamp_seconds",
            "When the learning process last published a field of a tile: Unix time.",
            ("tile",),
        )
        self._saved = make.gauge(
            "rfedge_server_tile_saved_ratio",
            "Share of bits that the last learnt field saved on frames held back; 0 if withdrawn.",
            ("tile",),
        )
        self._withdrawals: dict[tuple[str, ...], float] = {}
        make.read(
            "rfedge_server_tile_withdrawals_total",
            "Learnt fields of a tile that were withdrawn, since they made somebody's bits more.",
            ("tile",),
            lambda: self._withdrawals,
        )
        self._fields = make.gauge(
            "rfedge_server_field_info",
            "1 for each open radiance field: the first 16 digits of its id, and its kind.",
            ("field", "kind"),
        )
        self._streams: Tally[str] = Tally()
        if not per_vehicle:
            self._begin_at_zero()

    def _begin_at_zero(self) -> None:
        """Make each reason's series before its first frame: a rate needs two samples."""
        self.frames.labels("acked", "")
        for reason in RejectReason:
            self.frames.labels("nacked", reason)
        for taken in ("taken", "refused"):
            self.poses_ahead.labels(taken)
        for limit in Limit:
            self.limited.labels(limit)
        for cause in LossCause:
            self.decoders_lost.labels(cause)
        for task in BackgroundTask:
            self._task_failures.labels(task)
        for result in OpeningResult:
            self._openings.labels(result)

    def observe_stages(self, times: StageTimes) -> None:
        """Observe the time of a frame, stage by stage."""
        for name, stage in self._stages:
            if times.ahead_ns or name != "ahead_ns":
                stage.observe(getattr(times, name) / 1e9)
        self.answer.observe(times.total_ns / 1e9)

    def observe_ledger(self, entry: EntryControl, limiter: LogLimiter) -> None:
        """Have each scrape read the ledger: worker time promised, resources held and spent."""
        ledger, promises = entry.ledger, entry.promises
        self._promised.set_function(lambda: promises.promised_share)
        self._reduced.set_function(lambda: promises.reduced)
        self._identities.set_function(lambda: ledger.identities)
        for resource in HELD:
            self._held.labels(resource).set_function(partial(ledger.held, resource))
            self._most_held.labels(resource).set_function(partial(ledger.most_held, resource))
            self._budget.labels(resource).set(ledger.budget(resource).total)
            self._identity_budget.labels(resource).set(ledger.budget(resource).identity)
        self._spent = lambda: {(name,): ledger.spent(name) for name in SPENT}
        self._suppressed = lambda: limiter.suppressed

    def field_opened(self, field: RadianceField) -> None:
        """Publish which field was opened."""
        self._fields.labels(field.field_id[:16], field.metadata.kind).set(1)

    def show_tiles(self, tiles: Iterable[Tile]) -> None:
        """Publish which lights the tiles have, and count pictures of their fields from now on.

        Those of the fields that were published before are counted, too: vehicles follow later.
        """
        tiles = tuple(tiles)
        before = self._published_tile_of
        self._published_tile_of = {
            field_id: tile.name for tile in reversed(tiles) for field_id in tile.renderable_ids
        }
        self._tile_of = before | self._published_tile_of
        for tile in tiles:
            self._lights.labels(tile.name).set(len(tile.lights))
            self._passes.labels(tile.name).set(sum(light.passes for light in tile.lights))

    def show_learnt(self, histories: Mapping[str, TileHistory]) -> None:
        """Publish the histories of learning, by tile."""
        for name, history in histories.items():
            self._withdrawals[(name,)] = history.withdrawals
            if history.learnt:
                last = history.learnt[-1]
                self._learnt.labels(name).set(last.time_ms / 1e3)
                self._saved.labels(name).set(0 if last.withdrawn else last.saved_percent / 100)

    def count_limited(self, limit: str, count: int = 1) -> None:
        """Count refusals and endings because of ``limit``."""
        self.limited.labels(limit).inc(count)

    def count_picture(self, field_id: str, payload_bytes: int) -> None:
        """Count a reconstructed picture for the tile that publishes its field."""
        tile = self._tile_of.get(field_id, "")
        self._tile_payload.labels(tile).inc(payload_bytes)
        self._tile_pictures.labels(tile).inc()

    def count_lost_decoder(self, cause: LossCause) -> None:
        """Count a decoder process that died in use."""
        self.decoders_lost.labels(cause).inc()

    def decoder_started(self, kind: DecoderKind) -> None:
        """Say where packets are decoded."""
        for known in DecoderKind:
            if known is not DecoderKind.AUTO:
                self._decoder.labels(known).set(known is kind)

    def task_failed(self, task: BackgroundTask, error: Exception) -> None:
        """Log and count an exception that a background task did not expect; from any thread."""
        self._task_failures.labels(task).inc()
        log.error("background task failed", task=str(task), problem=repr(error), exc_info=error)

    def count_opening(self, result: OpeningResult) -> None:
        """Count an opening that ended."""
        self._openings.labels(result).inc()

    def of(self, vehicle_id: str) -> VehicleMetrics:
        """Return the metrics for a stream of ``vehicle_id``; ``forget`` them when it ends."""
        self._streams[vehicle_id] += 1
        return VehicleMetrics(self, vehicle_id)

    def forget(self, vehicle_id: str) -> None:
        """Drop the series of a vehicle whose last stream ended."""
        self._streams[vehicle_id] -= 1
        if self._streams[vehicle_id] > 0:
            return
        del self._streams[vehicle_id]
        if self.per_vehicle:
            for metric in (self.frames, self.received, self.payload, self.coded, self.latency):
                metric.remove_by_labels({"vehicle": vehicle_id})


class VehicleMetrics:
    """The server's metrics with the labels of one stream filled in."""

    def __init__(self, metrics: ServerMetrics, vehicle_id: str) -> None:
        self._metrics = metrics
        self._vehicle_id = vehicle_id
        self._label = (vehicle_id,) if metrics.per_vehicle else ()

    def received(self, frame: Frame, packet_bytes: int) -> None:
        """Count a frame that could be parsed."""
        packet = frame.packet
        labels = (*self._label, references_name(packet.references))
        self._received.inc(packet_bytes)
        self._metrics.payload.labels(*labels).inc(len(packet.payload))
        self._metrics.coded.labels(*labels).inc()

    def received_ahead(self, message_bytes: int) -> None:
        """Count a pose ahead of its frame."""
        self._received.inc(message_bytes)
        self._metrics.poses_ahead.labels("taken").inc()

    def answered(self, messages: Iterable[ServerMessage]) -> None:
        """Count the frames that ``messages`` answer."""
        for message in messages:
            if isinstance(message, Ack):
                self._metrics.frames.labels(*self._label, "acked", "").inc()
                self._metrics.observe_stages(message.times)
            elif isinstance(message, Nack):
                labels = (*self._label, "nacked", message.reason)
                self._metrics.frames.labels(*labels).inc(message.count)

    def reconstructed(self, captured_ns: int, now_ns: int, since_arrival_s: float) -> float:
        """Observe the age of a picture when it was reconstructed, and return it.

        Where the time of capture that the frame states is not plausible, that is the time since
        its arrival: a wrong clock makes no age or sum wrong.
        """
        claimed_s = (now_ns - captured_ns) / 1e9
        if not -MAX_AHEAD_S <= claimed_s <= MAX_BEHIND_S:
            self._metrics.implausible_captures.inc()
            return since_arrival_s
        latency_s = max(0.0, claimed_s)
        self._latency.observe(latency_s)
        return latency_s

    def forget(self) -> None:
        """Note that the stream is over."""
        self._metrics.forget(self._vehicle_id)

    @cached_property
    def _received(self) -> Counter:
        received = self._metrics.received
        return received.labels(*self._label) if self._label else received

    @cached_property
    def _latency(self) -> Histogram:
        latency = self._metrics.latency
        return latency.labels(*self._label) if self._label else latency
