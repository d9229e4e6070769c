"""``cav-agent``: the command that runs one vehicle; ``cav_agent.vehicle`` puts it together."""

from __future__ import annotations

import asyncio
import signal
import sys

import structlog

from cav_agent.config import AgentConfig
from cav_agent.vehicle import Vehicle
from rfcore.errors import RfedgeError
from rfcore.program import run_program, service_options


def main() -> int:
    """Parse the command line, drive, and return the exit status."""
    return run_program("cav-agent", _run)


def _run() -> None:
    asyncio.run(drive(service_options(AgentConfig, "cav-agent")))


async def drive(config: AgentConfig) -> None:
    """Drive to the end, or until SIGTERM or SIGINT.

    Raises ``RfedgeError`` if no picture was acknowledged.
    """
    vehicle = Vehicle(config)
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, vehicle.stop)
    counts = await vehicle.run()
    structlog.get_logger().info("drive ended", **counts, **vehicle.quality)
    if not counts["acked"]:
        raise RfedgeError(vehicle.explanation)


if __name__ == "__main__":
    sys.exit(main())
