"""One end of a WebRTC connection as a process: ``python -m lab.webrtc.peer send|receive ...``.

Descriptions, and what happens, go through standard input and output, a line of JSON each; the
network carries media alone. A line ``stop``, or the end of the input, ends the process, which then
writes what it knows.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from lab.webrtc.camera import CameraPictures, captured
from lab.webrtc.engines import Engine, engine_of
from lab.webrtc.measure import ShownPictures


def tell(**said: str) -> None:
    """Write a line."""
    print(json.dumps(said), flush=True)


async def heard() -> dict[str, str]:
    """Return what the next line says; nothing at the end of the input."""
    line = await asyncio.to_thread(sys.stdin.readline)
    told: dict[str, str] = json.loads(line or "{}")
    return told


async def send(engine: Engine, pictures: Path, hz: float, out: Path) -> None:
    """Offer, then send the camera's pictures until told to stop; write when each was captured."""
    tell(sdp=await engine.offer())
    await engine.accept((await heard())["sdp"])
    await engine.connected()
    times_ns: dict[int, int] = {}

    async def film() -> None:
        async for capture in captured(CameraPictures.read(pictures), hz):
            times_ns[capture.number] = capture.time_ns
            await engine.send(capture, hz)

    await until_stopped(film())
    out.write_text(json.dumps(times_ns))
    await engine.close()


async def receive(engine: Engine, out: Path) -> None:
    """Answer, then collect pictures until told to stop; write them."""
    shown = ShownPictures()
    tell(sdp=await engine.answer((await heard())["sdp"]))
    await until_stopped(engine.show(shown.take))
    shown.write(out)
    await engine.close()


async def until_stopped(work: Coroutine[Any, Any, None]) -> None:
    """Work until the next line; raise what the work raises."""
    working, stopped = asyncio.ensure_future(work), asyncio.ensure_future(heard())
    tell(event="ready")
    done, _ = await asyncio.wait((working, stopped), return_when=asyncio.FIRST_COMPLETED)
    working.cancel()
    if working in done:
        working.result()


def main(role: str, name: str, codec: str, *rest: str) -> None:
    async def work() -> None:
        engine = engine_of(name, codec)
        if role == "send":
            await send(engine, Path(rest[0]), float(rest[1]), Path(rest[2]))
        else:
            await receive(engine, Path(rest[0]))

    asyncio.run(work())


if __name__ == "__main__":
    main(*sys.argv[1:])
