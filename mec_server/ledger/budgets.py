"""The resources that identities are charged for, their budgets, and the names of limits.

A resource is either *held* (a stream, a decoder) and given back, or *spent* (bytes, worker time)
and refilled at a rate. Each has a budget for one identity and one for all of them together. One
identity never gets more than ``IdentityBudget.share`` of the latter, so that none can keep the
others out, whatever the two budgets are set to.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath

from mec_server.config import IdentityBudget, ServerBudget
from rfcore.wire.messages import Hello


class Resource(StrEnum):
    """A resource that identities are charged for; label of ``rfedge_server_held`` and
    ``.._spent_total``."""

    RPCS = "rpcs"
    """Calls in progress, of every method."""
    STREAMS = "streams"
    """Streams of vehicles."""
    DECODERS = "decoders"
    """Decoders of their cameras: a process each; a large picture counts as several."""
    FETCHES = "fetches"
    """Fields being sent."""
    WATCHES = "watches"
    """Consumers of the twin."""
    CALLS = "calls"
    """Calls begun."""
    MESSAGES = "messages"
    """Messages on streams of vehicles, parsable or not."""
    BYTES = "bytes"
    """Bytes of these messages."""
    WORKER_SECONDS = "worker_seconds"
    """Time for which frames kept a worker busy, those that were rejected included."""
    REJECTED_SECONDS = "rejected_seconds"
    """The part of it that went to frames that were rejected, unless their decoder was lost."""


HELD = (
    Resource.RPCS,
    Resource.STREAMS,
    Resource.DECODERS,
    Resource.FETCHES,
    Resource.WATCHES,
)
SPENT = (
    Resource.CALLS,
    Resource.MESSAGES,
    Resource.BYTES,
    Resource.WORKER_SECONDS,
    Resource.REJECTED_SECONDS,
)


class Limit(StrEnum):
    """The limit that was exceeded; label of ``rfedge_server_limited_total``."""

    IDENTITY_RPCS = "identity_rpcs"
    IDENTITY_STREAMS = "identity_streams"
    IDENTITY_DECODERS = "identity_decoders"
    IDENTITY_FETCHES = "identity_fetches"
    IDENTITY_WATCHES = "identity_watches"
    IDENTITY_CALLS = "identity_calls"
    IDENTITY_MESSAGES = "identity_messages"
    IDENTITY_BYTES = "identity_bytes"
    IDENTITY_WORKER_SECONDS = "identity_worker_seconds"
    IDENTITY_REJECTED_SECONDS = "identity_rejected_seconds"
    SERVER_RPCS = "server_rpcs"
    SERVER_STREAMS = "server_streams"
    SERVER_DECODERS = "server_decoders"
    SERVER_FETCHES = "server_fetches"
    SERVER_WATCHES = "server_watches"
    SERVER_CALLS = "server_calls"
    SERVER_MESSAGES = "server_messages"
    SERVER_BYTES = "server_bytes"
    SERVER_WORKER_SECONDS = "server_worker_seconds"
    SERVER_REJECTED_SECONDS = "server_rejected_seconds"
    CAPACITY = "capacity"
    CAMERA_TAKEN = "camera_taken"
    CAMERA_FRAMES = "camera_frames"
    CAMERA_BYTES = "camera_bytes"
    RENDER_DEADLINE = "render_deadline"
    LOST_DECODERS = "lost_decoders"
    FAILED_OPENINGS = "failed_openings"
    UNUSABLE_FRAMES = "unusable_frames"
    UNREAD_ANSWERS = "unread_answers"
    ADDRESS_CONNECTIONS = "address_connections"
    IDENTITY_CONNECTIONS = "identity_connections"
    CONNECTION_BYTES = "connection_bytes"
    HEADER_BYTES = "header_bytes"


@dataclass(frozen=True)
class Budget:
    """The amounts of a resource that one identity and all of them together may use.

    Amounts of held resources are counts; those of spent ones are per second.
    """

    identity: float
    total: float


def budgets_of(
    identity: IdentityBudget, server: ServerBudget, workers: int, memory_bytes: int
) -> Mapping[Resource, Budget]:
    """Return the budget of every resource, each identity's within its share of the total."""
    totals = {
        Resource.RPCS: server.rpcs,
        Resource.STREAMS: server.streams,
        Resource.DECODERS: server.decoders or decoders_that_fit(memory_bytes),
        Resource.FETCHES: server.fetches,
        Resource.WATCHES: server.watches,
        Resource.CALLS: server.calls_per_s,
        Resource.MESSAGES: server.messages_per_s,
        Resource.BYTES: server.bytes_per_s,
    }
    wanted = {
        Resource.RPCS: identity.rpcs,
        Resource.STREAMS: identity.streams,
        Resource.DECODERS: identity.decoders,
        Resource.FETCHES: identity.fetches,
        Resource.WATCHES: identity.watches,
        Resource.CALLS: identity.calls_per_s,
        Resource.MESSAGES: identity.messages_per_s,
        Resource.BYTES: identity.bytes_per_s,
    }
    budgets = {
        resource: Budget(_within(identity.share, wanted[resource], total, resource), total)
        for resource, total in totals.items()
    }
    # All together cannot spend more worker time than there is.
    return budgets | {
        Resource.WORKER_SECONDS: Budget(identity.share * workers, math.inf),
        Resource.REJECTED_SECONDS: Budget(
            min(identity.rejected_workers, identity.share * workers), math.inf
        ),
    }


def _within(share: float, wanted: float, total: float, resource: Resource) -> float:
    """Return ``wanted``, or the share of ``total`` if that is less; one can always be held."""
    most = share * total
    if resource in HELD:
        most = min(total, max(1, int(most)))
    return min(wanted, most)


RESERVED_BYTES = 384 << 20
"""Memory reserved for the server itself: it takes 280 MiB with the sample's field and four
vehicles."""

DECODER_BYTES = 48 << 20
"""A decoder process takes 55 MB, half of it shared with the others; the rest are its pictures."""

FEWEST_DECODERS, MOST_DECODERS = 4, 256


def decoders_that_fit(memory_bytes: int) -> int:
    """Return how many decoders have room in ``memory_bytes`` beside the server."""
    fit = (memory_bytes - RESERVED_BYTES) // DECODER_BYTES
    return max(FEWEST_DECODERS, min(MOST_DECODERS, fit))


PIXELS_PER_DECODER = 1920 * 1088
"""A camera of more pixels counts as several decoders, as its pictures take so much memory."""


def decoders_of(hello: Hello) -> int:
    """Return how many decoders the cameras of ``hello`` count as."""
    pixels = (k.intrinsics.width_px * k.intrinsics.height_px for k in hello.cameras)
    return sum(-(-count // PIXELS_PER_DECODER) for count in pixels)


CGROUPS, OWN_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def memory_limit_bytes(cgroups: Path = CGROUPS, own: Path = OWN_CGROUPS) -> int:
    """Return how much memory this process may use: the machine's, or less in a control group.

    Every group above its own counts. ``cgroups``: where control groups are mounted, of version 1
    or 2; in a container its own group may be what is mounted there. ``own``: which they are.
    """
    limit = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for folder in _own_folders("memory", cgroups, own):
        for name in ("memory.max", "memory.limit_in_bytes"):
            with suppress(OSError, ValueError):  # another version, or "max"
                limit = min(limit, int((folder / name).read_text()))
    return limit


def usable_processors(cgroups: Path = CGROUPS, own: Path = OWN_CGROUPS) -> int:
    """Return how many processors this process may keep busy, at least 1: those that it may run on,
    or what a control group grants it of them, a part of one counted as one.

    Arguments as of ``memory_limit_bytes``.
    """
    processors = float(len(os.sched_getaffinity(0)))
    for folder in _own_folders("cpu", cgroups, own):
        with suppress(OSError, ValueError):
            quota, period = (folder / "cpu.max").read_text().split()
            processors = min(processors, int(quota) / int(period))
        with suppress(OSError, ValueError):
            quota_us, period_us = (
                int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period")
            )
            if quota_us > 0:  # -1: none
                processors = min(processors, quota_us / period_us)
    return max(1, math.ceil(processors))


def _own_folders(controller: str, cgroups: Path, own: Path) -> Iterator[Path]:
    """Yield where limits of a controller may be, of version 2 or 1: its own group's folders, and
    those above (cgroups(7), "/proc/PID/cgroup")."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        lines = []
    groups = {"": "/", controller: "/"}
    for line in lines:
        _, controllers, path = line.split(":", 2)
        groups |= {name: path for name in controllers.split(",") if name in groups}
    for name, path in groups.items():
        group = PurePosixPath("/", path)
        for each in (group, *group.parents):
            yield cgroups / name / each.relative_to("/")
