"""One attack, in a process of its own: ``python -m attack.attacker NAME SECONDS TARGET [BEGUN]``,
the target as JSON, BEGUN a file to write when it begins, from when on it gives way to whoever wants
a processor; ``--decoy READY CERTIFICATES`` is somebody to attack in vain."""

from __future__ import annotations

import asyncio
import json
import resource
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import grpc

from attack import connection_attacks as connections
from attack import field_attacks as fields
from attack import packet_attacks as packets
from attack import rpc_attacks as rpcs
from attack.control_group import leave_the_processor
from attack.target import Target
from mec_server.decoding.process import LossCause
from mec_server.ledger.budgets import Limit, Resource
from rfcore.errors import RejectReason
from rfcore.wire.tls import TlsFiles

LOG_LINES, OPEN_FILES = "lines of its log", "descriptors it had open at most"
PROCESSOR_S = "seconds of a processor"
DEFERRED = "connections that the kernel keeps until they say something"


@dataclass(frozen=True)
class Attack:
    """One attack, with whose certificate, and what shows that it reached the server.

    ``effect`` names what must be more than ``EFFECT`` times as much when the server is attacked as
    when the decoy is: a counter of the server's metrics ("NAME{LABELS}", the values of its labels
    in the order of their names), or one of the four above for what no metric counts. ``refusal``:
    where it depends on the machine whether the attacker is let in, the counter of the limit that
    keeps it out. What is refused was noticed, too, so both are added up.
    """

    identity: str
    work: Callable[[Target], Awaitable[None]]
    effect: str
    refusal: str = ""

    @property
    def name(self) -> str:
        """Return how it is called."""
        return self.work.__name__

    @property
    def evidence(self) -> str:
        """Return what shows that it reached the server, in words."""
        return " or ".join(filter(None, (self.effect, self.refusal)))

    def amount(self, grown: Mapping[str, float]) -> float:
        """Return how much of it there was, by how much the server's counters grew."""
        return grown.get(self.effect, 0.0) + grown.get(self.refusal, 0.0)

    def is_noticed(self, by_decoy: Mapping[str, float], by_server: Mapping[str, float]) -> bool:
        """Whether the server's counters show the attack, beside how much they grew while the decoy
        was attacked."""
        return self.amount(by_server) > EFFECT.get(self.effect, MUCH) * self.amount(by_decoy)


EFFECT = {LOG_LINES: 2.0, OPEN_FILES: 1.2, PROCESSOR_S: 1.1}
"""Factor of growth that is an effect; ``MUCH`` for counters, which stand still otherwise."""
MUCH = 2.0


def limited(limit: Limit) -> str:
    """Return the counter of calls, streams and frames that a limit refused."""
    return f"rfedge_server_limited_total{{{limit}}}"


def nacked(reason: RejectReason) -> str:
    """Return the counter of frames refused for a reason."""
    return f"rfedge_server_frames_total{{{reason} nacked}}"


def spent(resource: Resource) -> str:
    """Return the counter of what identities used."""
    return f"rfedge_server_spent_total{{{resource}}}"


def poses(result: str) -> str:
    """Return the counter of poses ahead of their frames; the bystander sends none."""
    return f"rfedge_server_poses_ahead_total{{{result}}}"


def lost(cause: LossCause) -> str:
    """Return the counter of decoder processes that ended in use."""
    return f"rfedge_server_decoders_lost_total{{{cause}}}"


OPENED = "rfedge_server_openings_total{opened}"
REFUSED_CERTIFICATES = "rfedge_server_refused_certificates_total{}"
NO_CAPACITY = limited(Limit.CAPACITY)

ATTACKS = {
    attack.name: attack
    for attack in (
        Attack("consumer", rpcs.unread_fetches, limited(Limit.IDENTITY_FETCHES)),
        Attack("vehicle", rpcs.decoders_for_nothing, limited(Limit.IDENTITY_DECODERS)),
        Attack("vehicle", rpcs.decoders_within_budget, OPENED),
        Attack("vehicle", rpcs.bad_crc, nacked(RejectReason.CRC_MISMATCH), NO_CAPACITY),
        Attack("vehicle", rpcs.junk_slices, spent(Resource.MESSAGES)),
        Attack("vehicle", rpcs.greedy_promise, limited(Limit.IDENTITY_DECODERS)),
        Attack("vehicle", rpcs.greedy_promise_within_budget, OPENED, NO_CAPACITY),
        Attack("vehicle", rpcs.cancelled_hellos, spent(Resource.CALLS)),
        Attack("vehicle", rpcs.unread_refusals, spent(Resource.MESSAGES)),
        Attack("consumer", rpcs.unread_watches, limited(Limit.IDENTITY_WATCHES)),
        Attack("vehicle", rpcs.impossible_times, spent(Resource.MESSAGES)),
        Attack("vehicle", rpcs.many_streams, limited(Limit.IDENTITY_CALLS)),
        Attack("vehicle", rpcs.compressed_bombs, spent(Resource.CALLS)),
        Attack("vehicle", rpcs.rapid_resets, spent(Resource.CALLS)),
        Attack("vehicle", rpcs.foreign_names, spent(Resource.CALLS)),
        Attack("vehicle", rpcs.refused_frames, nacked(RejectReason.RENDER_MISMATCH)),
        Attack("vehicle", rpcs.unknown_fields, spent(Resource.BYTES)),
        Attack("vehicle", rpcs.odd_numbers, nacked(RejectReason.INVALID_ARGUMENT)),
        Attack("consumer", rpcs.foreign_paths, spent(Resource.CALLS)),
        Attack("vehicle", rpcs.many_connections, limited(Limit.IDENTITY_CONNECTIONS)),
        Attack("vehicle", rpcs.revoked, REFUSED_CERTIFICATES),
        Attack("vehicle", packets.flipped_slices, spent(Resource.MESSAGES)),
        Attack("vehicle", packets.hung_decoders, lost(LossCause.TIMEOUT)),
        Attack("vehicle", packets.poses_for_nothing, poses("taken"), NO_CAPACITY),
        Attack("vehicle", packets.poses_of_large_renders, poses("taken"), NO_CAPACITY),
        Attack("vehicle", packets.poses_of_other_places, poses("taken"), NO_CAPACITY),
        Attack("vehicle", packets.junk_poses, poses("refused")),
        Attack("none", connections.strangers, PROCESSOR_S),
        Attack("none", connections.silent_connections, DEFERRED),
        Attack("none", connections.half_requests, OPEN_FILES),
        Attack("vehicle", connections.silent_peers, OPEN_FILES),
        Attack("vehicle", connections.pings, limited(Limit.CONNECTION_BYTES)),
        Attack("vehicle", connections.settings, limited(Limit.CONNECTION_BYTES)),
        Attack("vehicle", connections.resets, limited(Limit.IDENTITY_CALLS)),
        Attack("vehicle", connections.continuations, limited(Limit.CONNECTION_BYTES)),
        Attack("vehicle", connections.repeated_headers, limited(Limit.HEADER_BYTES)),
        Attack("none", fields.strange_entries, LOG_LINES),
        Attack("vehicle", fields.malformed_archives, LOG_LINES),
        Attack("none", fields.malformed_publications, LOG_LINES),
        Attack("vehicle", fields.field_bombs, LOG_LINES),
    )
}


async def decoy(ready: Path, certificates: Path) -> None:
    """Take every call and connection, read everything and answer nothing, until killed."""
    leave_the_processor()

    class Swallow(grpc.GenericRpcHandler):
        def service(self, handler_call_details: object) -> object:  # noqa: ARG002
            async def take(requests: AsyncIterator[bytes], _: object) -> None:
                async for _data in requests:
                    pass
                await asyncio.Event().wait()

            return grpc.stream_stream_rpc_method_handler(take)

    async def read(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while await reader.read(1 << 16):
                pass

    root = certificates
    files = TlsFiles(root / "server.pem", root / "server.key", root / "ca.pem")
    server = grpc.aio.server()
    server.add_generic_rpc_handlers((Swallow(),))
    port = server.add_secure_port("127.0.0.1:0", files.server_credentials())
    await server.start()
    metrics = await asyncio.start_server(read, "127.0.0.1", 0)
    metrics_port = metrics.sockets[0].getsockname()[1]
    ready.write_text(f"127.0.0.1:{port} 127.0.0.1:{metrics_port}")
    await server.wait_for_termination()


async def main(name: str, seconds: str, target: str, begun: str = "") -> None:
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    with suppress(TimeoutError):
        async with asyncio.timeout(float(seconds)), asyncio.TaskGroup() as tasks:
            tasks.create_task(ATTACKS[name].work(Target(**json.loads(target))))
            await asyncio.sleep(0)  # until it first waits: what it sends is prepared by then
            if begun:
                leave_the_processor()
                Path(begun).write_text("begun")


if __name__ == "__main__":
    if sys.argv[1] == "--decoy":
        asyncio.run(decoy(Path(sys.argv[2]), Path(sys.argv[3])))
    else:
        asyncio.run(main(*sys.argv[1:]))
