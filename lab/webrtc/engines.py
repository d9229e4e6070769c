"""Two engines of WebRTC behind one interface: aiortc, and Chrome's libwebrtc (the package wrtc).

Both are as an application gets them: their own congestion control, jitter buffer, retransmission
and choice of rates. They are imported when an engine is made: nothing else needs them.
"""

from __future__ import annotations

import asyncio
import contextlib
import fractions
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from lab.webrtc.camera import Capture
from lab.webrtc.measure import Luma
from rfcore.errors import BackendUnavailable

VIDEO_CLOCK_HZ = 90_000
"""Clock of RTP's time stamps for video (RFC 3551)."""
Show = Callable[[int, int, Luma], None]
"""Takes a picture when the application has it: nanoseconds of the epoch, time stamp, luma."""


class Engine(Protocol):
    """One end of a connection; descriptions are the SDP of its offer or answer."""

    async def offer(self) -> str:
        """Return the offer of an end that sends."""

    async def accept(self, answer: str) -> None:
        """Take the answer."""

    async def answer(self, offer: str) -> str:
        """Return the answer of an end that receives."""

    async def connected(self) -> None:
        """Wait until media may be sent."""

    async def send(self, capture: Capture, hz: float) -> None:
        """Hand a picture to the encoder."""

    async def show(self, show: Show) -> None:
        """Hand on every picture that arrives, for ever."""

    async def close(self) -> None:
        """End the connection."""


def engine_of(name: str, codec: str) -> Engine:
    """Return one end; raise ``BackendUnavailable``, saying what to install, without its package."""
    try:
        return AiortcEngine(codec) if name == "aiortc" else LibwebrtcEngine(codec)
    except ModuleNotFoundError as error:
        package = "aiortc" if name == "aiortc" else "wrtc"
        raise BackendUnavailable(f"{error.name} is missing: pip install {package}") from error


class AiortcEngine:
    """Python's own WebRTC: VP8 by libvpx, H.264 by x264, rates by REMB."""

    def __init__(self, codec: str) -> None:
        import aiortc

        self._codec = codec
        self._pc = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        self._made: Any = aiortc
        self._newest: asyncio.Queue[Any] = asyncio.Queue(1)
        self._tracks: asyncio.Queue[Any] = asyncio.Queue()
        self._pc.on("track", self._tracks.put_nowait)

    async def offer(self) -> str:
        newest = self._newest

        async def recv(_: object) -> Any:
            return await newest.get()

        content = {"kind": "video", "recv": recv}
        track = type("Track", (self._made.MediaStreamTrack,), content)()
        transceiver = self._pc.addTransceiver(track, "sendonly")
        known = self._made.RTCRtpSender.getCapabilities("video").codecs
        mime = f"video/{self._codec}".lower()
        transceiver.setCodecPreferences([each for each in known if each.mimeType.lower() == mime])
        await self._pc.setLocalDescription(await self._pc.createOffer())
        return str(self._pc.localDescription.sdp)

    async def accept(self, answer: str) -> None:
        await self._pc.setRemoteDescription(self._made.RTCSessionDescription(answer, "answer"))

    async def answer(self, offer: str) -> str:
        await self._pc.setRemoteDescription(self._made.RTCSessionDescription(offer, "offer"))
        await self._pc.setLocalDescription(await self._pc.createAnswer())
        return str(self._pc.localDescription.sdp)

    async def connected(self) -> None:
        while self._pc.connectionState != "connected":
            await asyncio.sleep(0.01)

    async def send(self, capture: Capture, hz: float) -> None:
        from av import VideoFrame

        frame = VideoFrame(*capture.picture.size_px, "yuv420p")
        for plane, samples in zip(frame.planes, capture.picture.planes, strict=True):
            rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
            rows[: samples.shape[0], : samples.shape[1]] = samples
        frame.pts = round(capture.number * VIDEO_CLOCK_HZ / hz)
        frame.time_base = fractions.Fraction(1, VIDEO_CLOCK_HZ)
        with contextlib.suppress(asyncio.QueueEmpty):
            self._newest.get_nowait()
        self._newest.put_nowait(frame)

    async def show(self, show: Show) -> None:
        track = await self._tracks.get()
        while True:
            frame = await track.recv()
            plane = frame.planes[0]
            rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
            show(time.time_ns(), frame.pts, rows[: frame.height, : frame.width].copy())

    async def close(self) -> None:
        await self._pc.close()


class LibwebrtcEngine:
    """Chrome's engine: VP8, VP9 and AV1, rates by transport-wide feedback (GCC)."""

    def __init__(self, codec: str) -> None:
        import webrtc

        self._codec = codec
        self._made: Any = webrtc
        self._pc = webrtc.RTCPeerConnection()
        self._generator = webrtc.VideoTrackGenerator()
        self._writer = self._generator.writable.get_writer()
        self._tracks: asyncio.Queue[Any] = asyncio.Queue()
        self._pc.on("track", lambda event: self._tracks.put_nowait(event.track))

    async def offer(self) -> str:
        track = self._generator.track
        transceiver = self._pc.add_transceiver(
            track, self._made.RTCRtpTransceiverInit(direction="sendonly")
        )
        known = self._made.RTCRtpSender.get_capabilities("video").codecs
        wanted = f"video/{self._codec}".lower()
        transceiver.set_codec_preferences(
            [each for each in known if each.mime_type.lower() in (wanted, "video/rtx")]
        )
        await self._pc.set_local_description(await self._pc.create_offer())
        return await self._gathered()

    async def accept(self, answer: str) -> None:
        await self._pc.set_remote_description(
            self._made.RTCSessionDescriptionInit(type="answer", sdp=answer)
        )

    async def answer(self, offer: str) -> str:
        await self._pc.set_remote_description(
            self._made.RTCSessionDescriptionInit(type="offer", sdp=offer)
        )
        await self._pc.set_local_description(await self._pc.create_answer())
        return await self._gathered()

    async def _gathered(self) -> str:
        """Return the local description with all of its candidates."""
        while self._pc.ice_gathering_state != "complete":
            await asyncio.sleep(0.01)
        return str(self._pc.local_description.sdp)

    async def connected(self) -> None:
        while self._pc.connection_state != "connected":
            await asyncio.sleep(0.01)

    async def send(self, capture: Capture, hz: float) -> None:
        width, height = capture.picture.size_px
        described = self._made.VideoFrameBufferInit(
            format="I420",
            coded_width=width,
            coded_height=height,
            timestamp=round(1e6 * capture.number / hz),
        )
        await self._writer.write(self._made.VideoFrame(capture.picture.packed(), described))

    async def show(self, show: Show) -> None:
        init = self._made.MediaStreamTrackProcessorInit(await self._tracks.get(), 1)
        reader = self._made.MediaStreamTrackProcessor(init).readable.get_reader()
        while (frame := (await reader.read()).value) is not None:
            now_ns = time.time_ns()
            width, height = int(frame.coded_width), int(frame.coded_height)
            held = bytearray(frame.allocation_size())
            await frame.copy_to(held)
            luma = np.frombuffer(held, np.uint8, width * height).reshape(height, width)
            show(now_ns, frame.metadata().rtp_timestamp, luma)
            frame.close()

    async def close(self) -> None:
        self._pc.close()
