"""``mec-server``: the edge server's command."""

from __future__ import annotations

import asyncio
import gc
import signal
import sys

import tyro

from mec_server.config import ServerConfig
from mec_server.reconstruction import OpenCameras, open_cameras
from mec_server.server import EdgeServer
from rfcore.errors import RfedgeError
from rfcore.wire.settings import OPTIONS, configure_logs

__all__ = ["main"]


def main() -> None:
    """Parse the command line and serve until SIGTERM or SIGINT; exit 2 on a user's mistake."""
    try:
        config = tyro.cli(ServerConfig, config=OPTIONS, prog="mec-server")
        configure_logs(sys.stderr, config.log)
        config.render.check()
        asyncio.run(serve(config))
    except (RfedgeError, OSError) as error:
        print(f"mec-server: {error}", file=sys.stderr)
        sys.exit(2)


async def serve(config: ServerConfig, opened: OpenCameras = open_cameras) -> None:
    """Serve until told to stop, then drain."""
    server = EdgeServer(config, opened)
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    await server.start()
    gc.collect()
    gc.freeze()  # looking through all that is there for cycles stops every thread for 50 ms
    await stopped.wait()
    gc.unfreeze()  # what the native library counts as leaked at the end is collected again
    await server.stop()


if __name__ == "__main__":
    main()
