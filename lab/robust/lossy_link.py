"""A clip over a link that loses datagrams, by our codec and by x264, on a virtual clock.

Losses come in bursts (Gilbert 1960, Elliott 1963: a good state that delivers, a bad one that does
not). A frame is cut into datagrams of 1200 bytes and is lost if one of them is; no repetition, no
forward error correction. What became of a frame is known to the sender one round trip after it was
sent, and what was lost, one frame later, when the next one shows the gap. Answers are not lost.

The viewer sees the last picture that was decoded. Our receiver refuses what it cannot decode to the
bit and keeps the picture before; x264's is FFmpeg, which shows what it can make of it (damage that
fades as the refresh passes, or until the next IDR picture).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from random import Random
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from av.video.frame import PictureType

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig, even_size_px
from rfcore.codec.h264.ffmpeg import picture_of, video_frame
from rfcore.codec.references import RENDER_ONLY, EncoderState, Past
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420
from rfcore.metrics import ssim
from rfcore.wire.head_prediction import KEPT_HEADS
from rfedge.evaluate.field_coder import MessageWriter, RenderedClip
from rfedge.offline import Arrival, decode_frames

DATAGRAM_BYTES = 1200
"""A datagram of this size passes every network without fragments (RFC 9000, 14)."""

KEPT = 8
"""Coded frames that are kept, for each frame of the clip."""


@dataclass(frozen=True)
class Bursts:
    """``share`` of the datagrams lost on average, ``length`` in a row on average."""

    share: float
    length: float = 2.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 0.5:
            raise InvalidInput("loss.share", f"{self.share} is outside 0..0.5")
        if not self.length >= 1:
            raise InvalidInput("loss.length", f"{self.length} must be at least 1 datagram")


class Lossy:
    """The link: tells of one frame after another whether it arrives."""

    def __init__(self, bursts: Bursts, random: Random) -> None:
        self._random = random
        self._leave_bad = 1 / bursts.length
        self._enter_bad = bursts.share / (1 - bursts.share) / bursts.length
        self._bad = False

    def delivers(self, size_bytes: int) -> bool:
        """Send a frame of ``size_bytes``; return whether all its datagrams arrived."""
        datagrams = max(1, -(-size_bytes // DATAGRAM_BYTES))
        lost = sum(self._loses() for _ in range(datagrams))
        return lost == 0

    def _loses(self) -> bool:
        chance = self._leave_bad if self._bad else self._enter_bad
        if self._random.random() < chance:
            self._bad = not self._bad
        return self._bad


class Policy(StrEnum):
    """A sender's choice of the earlier frame to predict from."""

    LAST_SENT = "last-sent"
    """The one before, as if it had arrived; after bad news the last one known to have."""
    LAST_ACKED = "last-acked"
    """The newest that is known to have arrived, however old."""
    RENDER_ONLY = "render-only"
    """None: every frame needs the field alone."""


@dataclass
class Feedback:
    """A sender's knowledge at ``frame / rate_hz`` seconds of the frames before ``frame``."""

    rate_hz: float
    rtt_s: float
    _good: list[bool] = field(default_factory=list)
    _chain_start: int = 0

    def sent(self, good: bool) -> None:
        """The next frame was sent, and was or was not decoded at the other end."""
        self._good.append(good)

    def known_good(self) -> int | None:
        """Return the newest frame known now to have been decoded."""
        return next((k for k in range(len(self._good) - 1, -1, -1) if self._acked(k)), None)

    def known_bad(self) -> list[int]:
        """Return the frames known now not to have been."""
        return [k for k in range(len(self._good)) if not self._good[k] and self._known(k + 1)]

    def base(self, policy: Policy) -> int | None:
        """Return the frame that the next one is predicted from."""
        if policy is Policy.RENDER_ONLY or not self._good:
            return None
        if policy is Policy.LAST_ACKED:
            return self.known_good()
        if any(k >= self._chain_start for k in self.known_bad()):
            self._chain_start = len(self._good)
            return self.known_good()
        return len(self._good) - 1

    def news_of_loss(self, since: int) -> bool:
        """Tell whether a frame from ``since`` on is known to be lost."""
        return any(k >= since for k in self.known_bad())

    def _acked(self, frame: int) -> bool:
        return self._good[frame] and self._known(frame)

    def _known(self, frame: int) -> bool:
        """A frame's answer has come back by the time the next one is made."""
        now_s = len(self._good) / self.rate_hz
        return frame / self.rate_hz + self.rtt_s <= now_s + 1e-9


Row = dict[str, Any]


@dataclass(frozen=True)
class Crossing:
    """A clip of ``frames`` at ``rate_hz``, coded at ``crf``, by x264 at ``preset``, over a link."""

    frames: Sequence[I420]
    rate_hz: float
    preset: str
    crf: float
    bursts: Bursts
    rtt_s: float
    seed: int

    def link(self) -> Lossy:
        """The same losses for everybody who sends as many datagrams."""
        return Lossy(self.bursts, Random(f"loss/{self.seed}/{self.bursts}"))


@dataclass(frozen=True)
class Outcome:
    """The bytes of each frame, whether it became a new picture, and the SSIM of what was shown."""

    frame_bytes: tuple[int, ...]
    new: tuple[bool, ...]
    ssim: tuple[float, ...]

    def row(self, rate_hz: float) -> Row:
        """Return rate and quality without the first frame, which every stream delivers once."""
        return {
            "kbps": 8e-3 * float(np.mean(self.frame_bytes[1:])) * rate_hz,
            "ssim": float(np.mean(self.ssim[1:])),
            "ssim_p5": float(np.quantile(self.ssim[1:], 0.05)),
            "not_new": sum(not new for new in self.new[1:]),
            "frames": len(self.new) - 1,
        }


class FrameCoder:
    """Codes frames of one clip at one CRF, each against any earlier one, and keeps what it made.

    Crossings share what they have in common: all that was sent before the first loss, and with the
    same losses often more. Of ``KEPT`` times as many as the clip has, those used longest ago go.
    """

    def __init__(
        self, clip: Sequence[I420], rendered: RenderedClip, effort: str, crf: float
    ) -> None:
        self.rendered = rendered
        self._clip = clip
        self._encoder = DeltaEncoder(CodecConfig(*clip[0].size_px, effort, crf))
        self._made: OrderedDict[tuple[int, bytes, bool], Encoded] = OrderedDict()

    @property
    def header(self) -> StreamHeader:
        """The earlier frames that the receiver needs first."""
        return self._encoder.header

    def code(self, index: int, past: Past | None, *, render_only: bool) -> Encoded:
        """Return frame ``index`` coded against ``past``."""
        key = (index, b"" if past is None else past.digest, render_only)
        if key not in self._made:
            choice = FrameChoice(references=RENDER_ONLY if render_only else None)
            state = EncoderState(1, index, past)
            view = self.rendered.views[index]
            self._made[key] = self._encoder.encode(state, self._clip[index], view, choice)
            while len(self._made) > KEPT * len(self._clip):
                self._made.popitem(last=False)
        self._made.move_to_end(key)
        return self._made[key]

    def arrival(self, index: int, made: Encoded) -> Arrival:
        """Return the frame as a receiver gets it, if it gets it."""
        return Arrival(made.packet, self.rendered.views[index])


class LossySender:
    """Our sender on a crossing: codes from what ``feedback`` knows of the frames before."""

    def __init__(self, crossing: Crossing, coder: FrameCoder, policy: Policy) -> None:
        self.feedback = Feedback(crossing.rate_hz, crossing.rtt_s)
        self.frame_bytes: list[int] = []
        self._crossing = crossing
        self._coder = coder
        self._policy = policy

    def arrivals(self) -> Iterator[Arrival | None]:
        """Yield what comes out of the link, None for a lost frame; the first one always arrives, as
        after a handshake. ``feedback`` must be told of a frame before the next is asked for."""
        link, pasts = self._crossing.link(), dict[int | None, Past | None]()
        writer = MessageWriter(self._coder.header, self._crossing.rate_hz)
        render_only = self._policy is Policy.RENDER_ONLY
        for index in range(len(self._crossing.frames)):
            base = self.feedback.base(self._policy)
            if base is not None and index - base > KEPT_HEADS:
                base = None  # no longer named by a head
            made = self._coder.code(index, pasts.get(base), render_only=render_only)
            pasts[index] = made.state.past
            arrival = self._coder.arrival(index, made)
            self.frame_bytes.append(len(writer.message(arrival, base)))
            delivered = link.delivers(self.frame_bytes[-1])
            yield arrival if delivered or index == 0 else None


def delta_crossing(crossing: Crossing, coder: FrameCoder, policy: Policy) -> Outcome:
    """Send the clip by our codec."""
    sender, decoder = LossySender(crossing, coder, policy), DeltaDecoder(coder.header)
    new, shown = [], list[I420]()
    for decoded in decode_frames(decoder, sender.arrivals(), skip_rejected=True):
        sender.feedback.sent(decoded is not None)
        new.append(decoded is not None)
        shown.append(shown[-1] if decoded is None else decoded)
    return Outcome(tuple(sender.frame_bytes), tuple(new), _ssims(shown, crossing.frames))


def x264_crossing(crossing: Crossing, *, idr_on_nack: bool) -> Outcome:
    """Send the clip by low-delay x264, with a refresh a second or an IDR picture after bad news."""
    encoder = _x264(crossing, idr_on_nack=idr_on_nack)
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    feedback, link = Feedback(crossing.rate_hz, crossing.rtt_s), crossing.link()
    refreshed, sizes, new = 0, [], []
    decoded: dict[int, I420] = {}
    for index, frame in enumerate(crossing.frames):
        fed = video_frame(frame, even_size_px(frame.size_px), index)
        if idr_on_nack and feedback.news_of_loss(refreshed):
            fed.pict_type = PictureType.I
            refreshed = index
        (packet,) = encoder.encode(fed)
        data = bytes(packet)
        good = link.delivers(len(data)) or index == 0
        feedback.sent(good)
        sizes.append(len(data))
        new.append(good)
        if good:
            arrived = av.Packet(data)
            arrived.pts = index
            decoded |= _pictures(decoder, arrived, frame.size_px)
    decoded |= _pictures(decoder, None, crossing.frames[0].size_px)
    shown: list[I420] = []
    for index in range(len(crossing.frames)):
        shown.append(decoded.get(index, shown[-1] if shown else decoded[min(decoded)]))
    return Outcome(tuple(sizes), tuple(new), _ssims(shown, crossing.frames))


def _x264(crossing: Crossing, *, idr_on_nack: bool) -> av.VideoCodecContext:
    second = max(2, round(crossing.rate_hz))
    params = {"scenecut": "0", "threads": "1", "keyint": "infinite"}
    if not idr_on_nack:
        params |= {"intra-refresh": "1", "keyint": str(second)}
    encoder = av.CodecContext.create("libx264", "w")
    if not isinstance(encoder, av.VideoCodecContext):
        raise CodecError("libx264 is not a video encoder here")
    rate = Fraction(crossing.rate_hz).limit_denominator(1000)
    encoder.width, encoder.height = even_size_px(crossing.frames[0].size_px)
    encoder.pix_fmt = "yuv420p"
    encoder.time_base, encoder.framerate = 1 / rate, rate
    encoder.thread_count = 1
    encoder.options = {
        "preset": crossing.preset,
        "tune": "zerolatency",
        "forced-idr": "1",
        "crf": f"{crossing.crf:g}",
        "x264-params": ":".join(f"{name}={value}" for name, value in params.items()),
    }
    encoder.open()
    return encoder


def _pictures(decoder: Any, packet: Any, size_px: tuple[int, int]) -> dict[int, I420]:
    """Return what the decoder shows, by the frame's number; of what it cannot use, nothing."""
    try:
        return {frame.pts: picture_of(frame).cropped(size_px) for frame in decoder.decode(packet)}
    except FFmpegError:
        return {}


def _ssims(shown: Sequence[I420], frames: Sequence[I420]) -> tuple[float, ...]:
    return tuple(float(ssim(a.y, b.y)) for a, b in zip(shown, frames, strict=True))
