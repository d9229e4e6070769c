"""Metrics of the twin and its consumers. Names begin with ``rfedge_twin_``."""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import StrEnum

from mec_server.twin.state import Twin
from rfcore.wire.instruments import Instruments, Readings
from rfcore.wire.notices import NOTICE_KINDS, ObjectAhead, StreetNotice
from rfcore.wire.twin import PictureEncoding


class ConsumerEnd(StrEnum):
    """Reason why a consumer's stream ended."""

    LEFT = "left"
    SLOW = "slow"
    IDLE = "idle"
    REFUSED = "refused"
    DRAINED = "drained"


class TwinMetrics:
    """Ages and misses are read from the twin at the moment of a scrape."""

    def __init__(self, make: Instruments, twin: Twin, *, per_vehicle: bool = False) -> None:

        def ages_s() -> Readings:
            ages = twin.ages_s(time.monotonic())
            if per_vehicle:
                return {(vehicle_id,): age_s for vehicle_id, age_s in ages.items()}
            return {(): max(ages.values())} if ages else {}

        make.read(
            "rfedge_twin_age_seconds",
            "Seconds since the capture of the newest picture there is: of the vehicle where it is "
            "oldest.",
            ("vehicle",) if per_vehicle else (),
            ages_s,
        )
        make.read(
            "rfedge_twin_pictures_missed_total",
            "Pictures that a consumer was too slow for.",
            (),
            lambda: {(): twin.missed},
        )
        self.consumers = make.gauge("rfedge_twin_consumers", "Consumers that watch the twin.")
        self.ended = make.counter(
            "rfedge_twin_consumers_ended",
            "Consumers by how they ended: left, slow (took nothing for long), idle (asked for "
            "nothing for long), refused, drained.",
            ("reason",),
        )
        self.sent = make.counter(
            "rfedge_twin_pictures_sent", "Pictures handed to consumers, by encoding.", ("encoding",)
        )
        self.bytes = make.counter("rfedge_twin_sent_bytes", "Bytes handed to consumers.")
        self.sent_age = make.seconds(
            "rfedge_twin_sent_age_seconds", "Seconds from capture to handing over to a consumer."
        )
        self.notices = make.counter(
            "rfedge_twin_notices",
            "Notices sent to vehicles, by what they tell of: object, map, light.",
            ("kind",),
        )
        self.notice_age = make.seconds(
            "rfedge_twin_notice_age_seconds",
            "From the capture of the picture that shows an object to the notice of it.",
        )
        self.nats_connected = make.gauge(
            "rfedge_twin_nats_connected", "1 while pictures are published over NATS (--nats)."
        )
        self.nats_published = make.counter(
            "rfedge_twin_nats_published", "Pictures handed to NATS, by encoding.", ("encoding",)
        )
        self.nats_missed: Callable[[], int] = int
        """Returns the number of pictures that were not published so far; read at each scrape."""
        make.read(
            "rfedge_twin_nats_dropped_total",
            "Pictures that NATS was too slow, too small or away for.",
            (),
            lambda: {(): self.nats_missed()},
        )
        for kind in NOTICE_KINDS:
            self.notices.labels(kind)
        for reason in ConsumerEnd:
            self.ended.labels(reason)
        for encoding in PictureEncoding:
            self.sent.labels(encoding)
            self.nats_published.labels(encoding)

    def noticed(self, notice: StreetNotice) -> None:
        """Count a notice that was handed to a vehicle's stream."""
        self.notices.labels(notice.kind).inc()
        if isinstance(notice.subject, ObjectAhead):
            self.notice_age.observe(notice.subject.unseen_s)
