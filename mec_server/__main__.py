"""``mec-server``: the edge server's command."""

from __future__ import annotations

import asyncio
import sys

from mec_server.config import ServerConfig
from mec_server.server import serve
from rfcore.program import run_program, service_options


def main() -> int:
    """Parse the command line, serve until SIGTERM or SIGINT, and return the exit status."""
    return run_program("mec-server", _run)


def _run() -> None:
    asyncio.run(serve(service_options(ServerConfig, "mec-server")))


if __name__ == "__main__":
    sys.exit(main())
