"""``mec-server``: the edge server's command."""

from __future__ import annotations

import asyncio
import sys

from mec_server.config import ServerConfig
from mec_server.server import serve
from rfcore.program import parse_options, run_program
from rfcore.wire.settings import configure_logs, words_of_command_line


def main() -> int:
    """Parse the command line, serve until SIGTERM or SIGINT, and return the exit status."""
    return run_program("mec-server", _run)


def _run() -> None:
    words = words_of_command_line(sys.argv[1:])
    config: ServerConfig = parse_options(ServerConfig, "mec-server", words)
    configure_logs(sys.stderr, config.log)
    config.render.check()
    asyncio.run(serve(config))


if __name__ == "__main__":
    sys.exit(main())
