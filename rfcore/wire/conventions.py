"""Conventions of both ends besides the proto: gRPC options, names, histogram buckets, limits.

Every option that departs from gRPC's default says why; the figures were measured on loopback.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

MAX_MESSAGE_BYTES: Final = 1 << 20
"""Longest message either end accepts; a longer one ends its stream, not the connection."""

RETRY_AFTER: Final = "retry-after-ms"
"""Trailing metadata of a refused stream: after how many milliseconds it may be opened again."""

LONGEST_RETRY_AFTER_S: Final = 30.0
"""A server that is full says when to try again; its peers wait no longer than this."""

AGENT_PROCESS: Final = "agent-process"
"""Metadata of a stream: a name of the agent process that opened it, different for each process. A
server lets two processes never send the same camera; without it the connection stands for it."""

VEHICLE: Final = "rfedge-vehicle"
"""Metadata of a stream and of calls for lists and archives: the vehicle's id, as in its Hello."""

MAY_SEE: Final = "rfedge-may-see"
"""Initial metadata of ``TwinService.Watch``: what the caller may see, if that is not everything."""

TILE: Final = "rfedge-tile"
"""Metadata of a stream: the name of the tile it is for. A proxy may place streams by this and by
``VEHICLE`` before it has seen a message (docs/how-to/servers.md); a server believes neither."""

STREAM_METHOD: Final = "/rfcore.wire.v1.EdgeService/Stream"

RENDERER_CONTRACT: Final = "splats-f32-2.ngp-f32-1"
"""Names of the bit-exact contracts of ``rfcore.raster.native`` and ``rfcore.ngp.native``; a part
changes when its pixels change."""

FRAME_BUDGET_BUCKETS_S: Final = (
    0.001, 0.002, 0.005, 0.010, 0.0167, 0.0333, 0.050, 0.0667, 0.100, 0.150, 0.200, 0.500, 1.0, 2.0,
    5.0,
)  # fmt: skip
"""Histogram buckets at the frame budgets of 200, 100, 60, 30, 20, 15, 10, 5, 2, 1, 0.5 and 0.2 Hz,
two below them for single stages, and 150 ms: from capture to Ack in docs/how-to/operations.md."""

Options = tuple[tuple[str, int], ...]

SHARED_OPTIONS: Final[Options] = (
    # The bandwidth estimator grows the window until 4 MiB of stale video are buffered; without it
    # the window stays at 64 KiB.
    ("grpc.http2.bdp_probe", 0),
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    # H.264 and trained parameters do not compress, and a compressed message can be a bomb.
    ("grpc.default_compression_algorithm", 0),
)

RECONNECT_S: Final = 0.5
"""Longest pause before a client connects again. With jitter and the greeting a whole second would
miss the promised one."""

CHANNEL_OPTIONS: Final[Options] = (
    *SHARED_OPTIONS,
    # A connection that answers nothing is given up after 5 s; TCP that repairs losses of 5 % takes
    # up to 2.5 s. The ping's timeout decides (60 s by default), keepalive's does not (gRPC 1.85).
    ("grpc.keepalive_time_ms", 2_000),
    ("grpc.http2.ping_timeout_ms", 3_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
    # After an outage the stream is back in half a second instead of 2.7 s.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", round(1e3 * RECONNECT_S)),
    # Despite its name, how long one attempt may take (20 s by default). Two seconds let links of
    # half a second of round trip in; 100 ms would shut them out for ever.
    ("grpc.min_reconnect_backoff_ms", 2_000),
    # A process that reconnects must not inherit another channel's backoff or connection.
    ("grpc.use_local_subchannel_pool", 1),
)

LONGEST_PICTURE_BYTES: Final = 64 << 20
"""A raw picture of 8192x4320 px and its header, as a consumer of the twin may ask for it."""

CONSUMER_OPTIONS: Final[Options] = (
    *(o for o in CHANNEL_OPTIONS if o[0] != "grpc.max_receive_message_length"),
    ("grpc.max_receive_message_length", LONGEST_PICTURE_BYTES),
)

SERVER_OPTIONS: Final[Options] = (
    *SHARED_OPTIONS,
    # Permits the clients' keepalive with margin: by default a ping more often than every five
    # minutes is answered with "too_many_pings" and the connection is closed.
    ("grpc.http2.min_ping_interval_without_data_ms", 1_000),
    ("grpc.http2.max_ping_strikes", 0),
    ("grpc.keepalive_permit_without_calls", 1),
    # A consumer of the twin only listens: if its machine vanishes, nobody but this would notice.
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.http2.ping_timeout_ms", 5_000),
    # Two servers on one port would share the vehicles between them at random.
    ("grpc.so_reuseport", 0),
    # A vehicle or consumer has a handful; a proxy opens another connection. What one connection may
    # have at once, the event loop has to answer before it comes to anybody else.
    ("grpc.max_concurrent_streams", 64),
    # A peer may take two minutes by default over its handshake, and hold a connection for it; and
    # there may be any number of connections.
    ("grpc.server_handshake_timeout_ms", 5_000),
    # A peer that shakes hands and then asks for nothing does not keep its connection.
    ("grpc.max_connection_idle_ms", 15_000),
    ("grpc.max_allowed_incoming_connections", 1_024),
    # Bytes that are read at once are parsed at once, and their calls are answered before those of
    # others: few calls shall fit whose headers are 13 kB and become 17 MB (an HPACK bomb).
    ("grpc.experimental.tcp_max_read_chunk_size", 16_384),
)


def retry_after_s(trailing_metadata: Iterable[tuple[str, str | bytes]] | None) -> float:
    """Return the pause that a server asked for when it refused a call; 0: it did not say."""
    for key, value in trailing_metadata or ():
        if key == RETRY_AFTER and isinstance(value, str) and value.isdecimal():
            return min(int(value) / 1e3, LONGEST_RETRY_AFTER_S)
    return 0.0
