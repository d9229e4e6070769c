"""``mec-server``: the edge server's command."""

from __future__ import annotations

import asyncio
import sys

import tyro

from mec_server.config import ServerConfig
from mec_server.server import serve
from rfcore.errors import RfedgeError
from rfcore.wire.settings import OPTIONS, configure_logs, words_of_command_line


def main() -> None:
    """Parse the command line and serve until SIGTERM or SIGINT; exit 2 on a user's mistake."""
    try:
        words = words_of_command_line(sys.argv[1:])
        config = tyro.cli(ServerConfig, config=OPTIONS, prog="mec-server", args=words)
        configure_logs(sys.stderr, config.log)
        config.render.check()
        asyncio.run(serve(config))
    except (RfedgeError, OSError) as error:
        print(f"mec-server: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
