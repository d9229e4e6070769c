#!/usr/bin/env bash
# grpcio 1.85.1: a connection that answers nothing is given up 60 s after the ping, whatever
# grpc.keepalive_timeout_ms says (here 1 s). grpcio 1.59.0 gives it up after 3 s ("keepalive watchdog
# timeout"), as documented; 1.66.0 and 1.72.0 behave as 1.85.1. What is obeyed now is
# grpc.http2.ping_timeout_ms. Takes a minute.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/silent.py" <<'PY'
import asyncio
import os
import sys
import time

import grpc

KEEPALIVE = [
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 1000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
]
is_silent = asyncio.Event()


async def echo(requests, context):
    async for request in requests:
        yield request


async def forward(reader, writer, may_fall_silent):
    while data := await reader.read(65536):
        if not (may_fall_silent and is_silent.is_set()):
            writer.write(data)


async def main(options):
    server = grpc.aio.server(options=[("grpc.http2.max_ping_strikes", 0)])
    method = grpc.stream_stream_rpc_method_handler(echo)
    server.add_generic_rpc_handlers(
        (grpc.method_handlers_generic_handler("test", {"Echo": method}),)
    )
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()

    async def connected(reader, writer):
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        await asyncio.gather(
            forward(reader, far_writer, False), forward(far_reader, writer, True)
        )

    proxy = await asyncio.start_server(connected, "127.0.0.1", 0)
    address = "127.0.0.1:%d" % proxy.sockets[0].getsockname()[1]
    call = grpc.aio.insecure_channel(address, options=KEEPALIVE + options).stream_stream("/test/Echo")()
    await call.write(b"x")
    await call.read()
    is_silent.set()
    begun_s = time.monotonic()
    try:
        await asyncio.wait_for(call.read(), 100)
    except grpc.aio.AioRpcError as error:
        print(f"{time.monotonic() - begun_s:.0f} {error.code().name} {error.details()}", flush=True)
    os._exit(0)


asyncio.run(main([("grpc.http2.ping_timeout_ms", 1000)] if sys.argv[1] == "ping" else []))
PY
for version in 1.59.0 1.85.1; do
  python3 -m venv "$folder/$version"
  "$folder/$version/bin/pip" install -q grpcio==$version
done
seen() { "$folder/$1/bin/python" "$folder/silent.py" "$2" 2> /dev/null; }
old=$(seen 1.59.0 keepalive); new=$(seen 1.85.1 keepalive); ping=$(seen 1.85.1 ping)
printf 'grpcio 1.59.0: %s\ngrpcio 1.85.1: %s\n1.85.1 with grpc.http2.ping_timeout_ms: %s\n' "$old" "$new" "$ping"
[ "${old%% *}" -le 10 ] && [ "${new%% *}" -ge 55 ] && [ "${ping%% *}" -le 10 ] || { echo changed; exit 1; }
echo "as seen: grpcio 1.85.1"
