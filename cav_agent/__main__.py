"""``cav-agent``: the command that runs one vehicle; ``cav_agent.vehicle`` puts it together."""

from __future__ import annotations

import asyncio
import signal
import sys

import structlog
import tyro

from cav_agent.config import AgentConfig
from cav_agent.vehicle import Vehicle
from rfcore.errors import RfedgeError
from rfcore.wire.settings import OPTIONS, configure_logs, words_of_command_line


def main() -> None:
    """Parse the command line and drive; exit 2 with one line when it cannot be done."""
    try:
        words = words_of_command_line(sys.argv[1:])
        config = tyro.cli(AgentConfig, config=OPTIONS, prog="cav-agent", args=words)
        configure_logs(sys.stderr, config.log)
        config.render.check()
        asyncio.run(drive(config))
    except (RfedgeError, OSError) as error:
        print(f"cav-agent: {error}", file=sys.stderr)
        sys.exit(2)


async def drive(config: AgentConfig) -> None:
    """Drive to the end, or until SIGTERM or SIGINT."""
    vehicle = Vehicle(config)
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, vehicle.stop)
    counts = await vehicle.run()
    structlog.get_logger().info("drive ended", **counts)


if __name__ == "__main__":
    main()
