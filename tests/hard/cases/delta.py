"""Hard frames for the delta codec: flat, noise, tiny, extreme quality, an unrelated render.

Always right: the receiver shows the sender's closed loop, digest for digest (its decoder raises
otherwise). The quality asked of a frame is noted with each case.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from hard.cases.case import Case, Finding, statement
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.image import I420
from rfcore.metrics import psnr
from rfcore.views import FieldView

GROUP = "Delta codec"
SIZE_PX = (64, 48)

Make = Callable[[tuple[int, int]], I420]


def _flat(level: int, size_px: tuple[int, int]) -> I420:
    return I420(*(np.full(shape, level, np.uint8) for shape in _shapes(size_px)))


def _noise(seed: int, size_px: tuple[int, int]) -> I420:
    rng = np.random.default_rng(seed)
    return I420(*(rng.integers(0, 256, shape, dtype=np.uint8) for shape in _shapes(size_px)))


def _ramp(size_px: tuple[int, int]) -> I420:
    width_px, height_px = size_px
    y = (16 + np.indices((height_px, width_px)).sum(axis=0) % 200).astype(np.uint8)
    return I420(y, *_flat(128, size_px).planes[1:])


def _shapes(size_px: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    width_px, height_px = size_px
    half = ((height_px + 1) // 2, (width_px + 1) // 2)
    return ((height_px, width_px), half, half)


black, white, grey = (partial(_flat, level) for level in (16, 235, 128))
zeros, full = (partial(_flat, level) for level in (0, 255))
noise, other_noise = partial(_noise, 1), partial(_noise, 2)


def _view(render: Make, size_px: tuple[int, int] = SIZE_PX) -> FieldView:
    """A view of no depth that shows ``render``."""
    width_px, height_px = size_px
    k = Intrinsics(width_px, height_px, 32.0, 32.0, 0.5 * width_px, 0.5 * height_px)
    depth = np.zeros((height_px, width_px), np.float32)
    return FieldView(Camera(k, Pose.identity()), render(size_px), depth)


def _sent(
    frame: Make,
    render: Make,
    least_db: float,
    size_px: tuple[int, int] = SIZE_PX,
    crf: float = 23.0,
) -> Finding:
    """Send one frame and receive it; ``least_db`` is asked of its luma."""
    encoder = DeltaEncoder(CodecConfig(*size_px, crf=crf))
    decoder = DeltaDecoder(encoder.header)
    encoded = encoder.encode(encoder.start(1), frame(size_px), _view(render, size_px))
    decoded = decoder.decode(decoder.start(1), encoded.packet, _view(render, size_px))
    quality_db = psnr(decoded.frame.y, frame(size_px).y)
    same = decoded.frame.digest() == encoded.reconstruction.digest()
    got = f"{quality_db:.1f} dB in {len(encoded.packet.payload)} bytes"
    return statement(same and quality_db >= least_db, got, f"{got}, equal: {same}")


def _repeats() -> Finding:
    """A fresh encoder each time: equal input, equal packet."""
    payloads = []
    for _ in range(2):
        encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
        encoded = encoder.encode(encoder.start(1), _ramp(SIZE_PX), _view(noise))
        payloads.append(encoded.packet.payload)
    return statement(payloads[0] == payloads[1], "equal bytes", "bytes differ")


def _monotonous() -> Finding:
    sizes, qualities = [], []
    for crf in (1.0, 18.0, 36.0, 51.0):
        encoder = DeltaEncoder(CodecConfig(*SIZE_PX, crf=crf))
        encoded = encoder.encode(encoder.start(1), noise(SIZE_PX), _view(grey))
        sizes.append(len(encoded.packet.payload))
        qualities.append(psnr(encoded.reconstruction.y, noise(SIZE_PX).y))
    falling = sizes == sorted(sizes, reverse=True) and qualities == sorted(qualities, reverse=True)
    got = " / ".join(f"{db:.0f} dB {size} B" for db, size in zip(qualities, sizes, strict=True))
    return statement(falling, got, got)


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, f"the closed loop; {expected}", measure)


CASES = (
    _case("black from black", "exact", partial(_sent, black, black, 99.0)),
    _case("white from black", "45 dB", partial(_sent, white, black, 45.0)),
    _case("black from white", "45 dB", partial(_sent, black, white, 45.0)),
    _case("0 from 255", "40 dB (predictions are clamped to 1)", partial(_sent, zeros, full, 40.0)),
    _case("a frame equal to its render", "45 dB", partial(_sent, _ramp, _ramp, 45.0)),
    _case("noise from unrelated noise", "25 dB", partial(_sent, noise, other_noise, 25.0)),
    _case("noise equal to its render", "40 dB", partial(_sent, noise, noise, 40.0)),
    _case("a ramp from noise", "30 dB", partial(_sent, _ramp, noise, 30.0)),
    _case("noise at CRF 1", "45 dB", partial(_sent, noise, grey, 45.0, crf=1.0)),
    _case("noise at CRF 51", "8 dB", partial(_sent, noise, grey, 8.0, crf=51.0)),
    _case("2 x 2 px", "20 dB", partial(_sent, noise, grey, 20.0, size_px=(2, 2))),
    _case("2 px wide", "20 dB", partial(_sent, noise, black, 20.0, size_px=(2, 50))),
    _case("2 px high", "20 dB", partial(_sent, noise, black, 20.0, size_px=(50, 2))),
    _case("odd sides, 33 x 17 px", "20 dB", partial(_sent, noise, white, 20.0, size_px=(33, 17))),
    Case(GROUP, "the same frame twice", "the same bytes", _repeats),
    Case(GROUP, "CRF 1 to 51 on noise", "bytes and quality fall together", _monotonous),
)
