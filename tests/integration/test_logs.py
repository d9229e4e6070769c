"""Both ends name vehicle, session and sequence when a frame was sent in vain."""

import asyncio
import re
from dataclasses import replace
from typing import Any

from structlog.testing import capture_logs

from rfcore.wire.messages import Frame
from rfedge.link.proxy import LinkProxy, ProxySettings


def damaged(frame: Frame) -> Frame:
    return replace(frame, packet=replace(frame.packet, crc32=frame.packet.crc32 ^ 1))


async def test_the_server_says_which_frame_of_which_session_it_refused(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    with capture_logs() as lines:
        async with serve() as server, raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            assert await vehicle.told(damaged(coded.frames[0])) == ("crc_mismatch", 0)
            await vehicle.farewell()
    (line,) = (line for line in lines if line["event"] == "frame rejected")
    assert re.fullmatch(r"[0-9a-f]{12}", line["session"])
    assert (line["vehicle"], line["camera"]) == ("cav-raw", "front")
    assert (line["epoch"], line["seq"], line["reason"]) == (0, 0, "crc_mismatch")


async def test_the_vehicle_says_which_frame_was_lost_with_its_connection(
    serve: Any, travel: Any
) -> None:
    """The link is cut while the second frame is on it; lockstep sends the next ones again."""
    with capture_logs() as lines:
        async with serve() as server:
            first = LinkProxy(ProxySettings(str(server.address), uplink_bps=20e3, delay_ms=0.0))
            address = await first.start()
            travelling = asyncio.create_task(travel(address, crf=10.0))  # 3 kB a frame
            while not server.registry.get_sample_value(
                "rfedge_server_frames_total", {"result": "acked", "reason": ""}
            ):
                await asyncio.sleep(0.001)
            while first._up.held_bytes < 150:  # the next frame is on its way, at 20 kbit/s
                await asyncio.sleep(0.001)
            await first.stop()
            second = LinkProxy(ProxySettings(str(server.address), listen=str(address)))
            await second.start()
            assert (await travelling).counts["acked"] == 6
            await second.stop()
    lost = [line for line in lines if line["event"] == "frame lost"]
    assert lost
    assert all(re.fullmatch(r"[0-9a-f]{12}", line["session"]) for line in lost)
    assert all(line["seq"] >= 0 and line["reason"] for line in lost)
    assert any(line["event"] == "stream lost" for line in lines)
