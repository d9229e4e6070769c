"""A link for each vehicle of a fleet, all in one process.

``python -m rfedge.loadtest.links PROFILE COUNT SERVER REPORT --ready-file FILE``: the ready file
receives one HOST:PORT a line, the report one link's measurements a line (JSON).
"""

from __future__ import annotations

import asyncio
import json
import selectors
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from rfcore.files import write_whole
from rfedge.link import LinkSettings
from rfedge.link.proxy import LinkProxy

__all__ = ["main", "run_links"]


async def run_links(profile: Path, count: int, server: str, report: Path, ready: Path) -> None:
    """Forward until SIGTERM."""
    stopped = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stopped.set)
    settings = LinkSettings(to=server, profile=profile, spin_s=0.0)
    proxies = [LinkProxy(settings) for _ in range(count)]
    addresses = [await proxy.start() for proxy in proxies]
    write_whole(ready, "".join(f"{address}\n" for address in addresses))
    await stopped.wait()
    for proxy in proxies:
        await proxy.stop()
    lines = (json.dumps(proxy.report()) + "\n" for proxy in proxies)
    write_whole(report, "".join(lines))


def main(arguments: Sequence[str]) -> None:
    """Run from the command line."""
    profile, count, server, report, _, ready = arguments
    loop = asyncio.SelectorEventLoop(selectors.SelectSelector())  # see rfedge.link.proxy
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(run_links(Path(profile), int(count), server, Path(report), Path(ready)))


if __name__ == "__main__":
    main(sys.argv[1:])
