"""One attack, in a process of its own: ``python -m attack.attacker NAME SECONDS TARGET [BEGUN]``,
the target as JSON, BEGUN a file to write when it begins; ``--decoy READY CERTIFICATES`` is somebody
to attack in vain."""

from __future__ import annotations

import asyncio
import json
import resource
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from pathlib import Path

import grpc

from attack import connection_attacks as connections
from attack import field_attacks as fields
from attack import packet_attacks as packets
from attack import rpc_attacks as rpcs
from attack.target import Target
from rfcore.wire.tls import TlsFiles

ATTACKS: dict[str, tuple[str, Callable[[Target], Awaitable[None]]]] = {
    attack.__name__: (identity, attack)
    for identity, attack in (
        ("consumer", rpcs.unread_fetches),
        ("vehicle", rpcs.decoders_for_nothing),
        ("vehicle", rpcs.bad_crc),
        ("vehicle", rpcs.junk_slices),
        ("vehicle", rpcs.greedy_promise),
        ("vehicle", rpcs.cancelled_hellos),
        ("vehicle", rpcs.unread_refusals),
        ("consumer", rpcs.unread_watches),
        ("vehicle", rpcs.impossible_times),
        ("vehicle", rpcs.many_streams),
        ("vehicle", rpcs.compressed_bombs),
        ("vehicle", rpcs.rapid_resets),
        ("vehicle", rpcs.foreign_names),
        ("vehicle", rpcs.refused_frames),
        ("vehicle", rpcs.unknown_fields),
        ("vehicle", rpcs.odd_numbers),
        ("consumer", rpcs.foreign_paths),
        ("vehicle", rpcs.many_connections),
        ("vehicle", rpcs.revoked),
        ("vehicle", packets.flipped_slices),
        ("vehicle", packets.hung_decoders),
        ("none", connections.strangers),
        ("none", connections.silent_connections),
        ("none", connections.half_requests),
        ("vehicle", connections.pings),
        ("vehicle", connections.settings),
        ("vehicle", connections.resets),
        ("vehicle", connections.continuations),
        ("vehicle", connections.repeated_headers),
        ("none", fields.strange_entries),
        ("vehicle", fields.malformed_archives),
        ("vehicle", fields.field_bombs),
    )
}


async def decoy(ready: Path, certificates: Path) -> None:
    """Take every call and connection, read everything and answer nothing, until killed."""

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
    if begun:
        Path(begun).write_text("begun")
    with suppress(TimeoutError):
        async with asyncio.timeout(float(seconds)):
            await ATTACKS[name][1](Target(**json.loads(target)))


if __name__ == "__main__":
    if sys.argv[1] == "--decoy":
        asyncio.run(decoy(Path(sys.argv[2]), Path(sys.argv[3])))
    else:
        asyncio.run(main(*sys.argv[1:]))
