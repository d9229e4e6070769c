"""Measure cells of the sizing tables: a clip coded by us and by the rivals, decoded, and timed.

The rivals are those of ``rfedge eval compare``, in the form that is fairest to them at a PSNR: x264
and x265 veryfast tuned for PSNR, SVT-AV1 preset 8, all for low delay with one key frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from time import process_time_ns

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import DEFAULT_EFFORT, CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.image import I420
from rfcore.metrics import psnr_of_mse
from rfcore.native.yuv import i420_from_rgb
from rfedge.evaluate.clips import STEADY, Clip, CodedClip, Drive, DriveName
from rfedge.evaluate.field_coder import FieldCoder, RenderedClip, render_clip
from rfedge.evaluate.rivals import Rival, svtav1_lowdelay, x264_for_psnr, x265_for_psnr
from rfedge.evaluate.runner import clip_key, coded_clip, program_version
from rfedge.jobs import CellStore
from rfedge.offline import FrameInput, decode_promised, encode_frames
from rfedge.results import host
from rfedge.sizing.estimate import Demand
from rfedge.sizing.tables import SAME_RATE, SizingCell, SizingTables, interpolated, machine_name

MIN_FRAMES = 5
SETTLED_FRAMES = 8
SETTLING = slice(4, None)
"""Frames that count in a clip of at least ``SETTLED_FRAMES``; shorter clips leave out the first
alone. An encoder spends more on its key frame than it must, and the next frames profit: at 30 Hz
the sizes of x264 still grow in the fourth frame."""
MIDDLE_DB = 34.0
"""Quality at which times and the sizes of single frames are taken."""
STEP_DB = 0.5
DRAWS, SEED = 200, 1
RIVALS = {
    "x264": x264_for_psnr("veryfast"),
    "x265": x265_for_psnr("veryfast"),
    "svtav1": svtav1_lowdelay(8),
}


def read_sized_drive(name: DriveName, size_px: tuple[int, int] | None, limit: int | None) -> Drive:
    """Read at most ``limit`` frames, reduced to ``size_px`` (width, height) by averaging areas."""
    dataset = read_dataset(name.dataset, size_px=size_px)
    for change in dataset.changes:
        print(f"{name.dataset}: {change}")
    pictures = dataset.pictures[:limit]
    return Drive(name, pictures, [i420_from_rgb(picture.read()) for picture in pictures])


def measured_cells(drive: Drive, field: RadianceField, store: CellStore) -> Iterator[SizingCell]:
    """Yield the cell of each codec on a drive, taking from ``store`` what is there.

    Raises ``InvalidInput`` for fewer than ``MIN_FRAMES`` frames or an odd size.
    """
    if len(drive.frames) < MIN_FRAMES:
        raise InvalidInput("frames", f"{len(drive.frames)} are too few, at least {MIN_FRAMES}")
    clip = drive.clip()
    rendered = render_clip(field, drive.cameras)
    name = f"rfedge-{DEFAULT_EFFORT}-{rendered.field_id[:12]}"
    ours = FieldCoder(rendered, name, program_version(), effort=DEFAULT_EFFORT)
    yield _measured("rfedge", ours, clip, rendered, store)
    for codec, rival in RIVALS.items():
        yield _measured(codec, rival, clip, rendered, store)


def _measured(
    codec: str, coder: FieldCoder | Rival, clip: Clip, rendered: RenderedClip, store: CellStore
) -> SizingCell:
    clips = [coded_clip(clip, coder, point, store) for point in coder.points]
    steady = steady_frames(len(clip.frames))
    nearest = min(clips, key=lambda coded: abs(coded.psnr_db(steady) - MIDDLE_DB))

    def receive() -> list[dict[str, float]]:
        if isinstance(coder, Rival):
            made = coder.pictures(clip.frames, clip.rate_hz, nearest.point)
            return [{"receiver_ms": made.decoder_cpu_ms / len(clip.frames)}]
        cpu_ms = _our_receiver_ms(rendered, clip.frames, nearest.point)
        return [{"receiver_ms": cpu_ms / len(clip.frames)}]

    (row,) = store.rows({**clip_key(clip, coder, nearest.point), "receiver": 1}, receive)
    return _cell(codec, clip, clips, nearest, row["receiver_ms"])


def steady_frames(count: int) -> slice:
    """Return which frames of a clip of ``count`` stand for its steady state."""
    return SETTLING if count >= SETTLED_FRAMES else STEADY


def _our_receiver_ms(rendered: RenderedClip, frames: Sequence[I420], crf: float) -> float:
    encoder = DeltaEncoder(CodecConfig(*frames[0].size_px, effort=DEFAULT_EFFORT, crf=crf))
    inputs = (FrameInput(frame, view) for frame, view in zip(frames, rendered.views, strict=True))
    coded = list(encode_frames(encoder, inputs))
    began_ns = process_time_ns()
    for _ in decode_promised(DeltaDecoder(encoder.header), coded):
        pass
    return (process_time_ns() - began_ns) / 1e6 + rendered.render_cpu_ms


def _cell(
    codec: str, clip: Clip, clips: Sequence[CodedClip], nearest: CodedClip, receiver_ms: float
) -> SizingCell:
    steady = steady_frames(len(clip.frames))
    mse = np.array([coded.luma_mse[steady] for coded in clips])
    sizes = np.array([coded.frame_bytes[steady] for coded in clips], np.float64)
    whole = np.arange(mse.shape[1])
    grid_db = _grid_db(mse)
    draws = np.random.default_rng(SEED).choice(whole, (DRAWS, len(whole)))
    drawn = np.array([_bytes_at(grid_db, mse, sizes, draw) for draw in draws])
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    ratios = nearest.frame_bytes[steady] / nearest.bytes_per_frame(steady)
    width_px, height_px = clip.frames[0].size_px
    return SizingCell(
        codec=codec,
        width_px=width_px,
        height_px=height_px,
        hz=clip.rate_hz,
        frames=len(clip.frames),
        psnr_db=grid_db,
        bytes_per_frame=_rounded(_bytes_at(grid_db, mse, sizes, whole)),
        low_bytes=_rounded(low),
        high_bytes=_rounded(high),
        frame_ratios=[round(float(ratio), 3) for ratio in ratios],
        sender_ms=round(nearest.cpu_ms / len(clip.frames), 2),
        receiver_ms=round(receiver_ms, 2),
    )


def _grid_db(mse: NDArray[np.float64]) -> list[float]:
    """Return the half decibels that the clip's curve spans."""
    ends_db = sorted(psnr_of_mse(float(row.mean())) for row in (mse[0], mse[-1]))
    first, last = np.ceil(ends_db[0] / STEP_DB), np.floor(ends_db[1] / STEP_DB)
    return [float(n * STEP_DB) for n in np.arange(first, last + 1)]


def _bytes_at(
    grid_db: Sequence[float],
    mse: NDArray[np.float64],
    sizes: NDArray[np.float64],
    frames: NDArray[np.intp],
) -> list[float]:
    """Return bytes a frame at each quality of the grid, over the chosen frames of every point."""
    psnr_db = np.array([psnr_of_mse(float(value)) for value in mse[:, frames].mean(axis=1)])
    log_bytes = np.log(sizes[:, frames].mean(axis=1))
    order = np.argsort(psnr_db)
    return [
        float(np.exp(interpolated(psnr_db[order].tolist(), log_bytes[order].tolist(), at_db)))
        for at_db in grid_db
    ]


def _rounded(values: Sequence[float] | NDArray[np.float64]) -> list[float]:
    return [round(float(value), 1) for value in values]


def own_tables(
    dataset: Path, field: Path, demand: Demand, frames: int, cells: Path
) -> SizingTables:
    """Measure one cell of every codec on a user's drive at the size and rate of ``demand``.

    Every n-th frame is taken where the drive is faster. Raises ``InvalidInput`` where the drive's
    rate is no multiple of the wanted one, or its pictures are smaller.
    """
    own_hz = read_dataset(dataset).rate_hz or demand.hz
    step = max(round(own_hz / demand.hz), 1)
    if abs(own_hz / step / demand.hz - 1) > SAME_RATE:
        raise InvalidInput(
            "hz", f"{demand.hz:g} is not {own_hz:.3g} Hz, the rate of {dataset}, or a part of it"
        )
    name = DriveName(dataset.stem, demand.hz * step, dataset)
    drive = read_sized_drive(name, (demand.width_px, demand.height_px), frames * step)
    measured = measured_cells(drive.every(step), load_field(field), CellStore(cells))
    return SizingTables(tuple(measured), f"{dataset}; field {field}", machine_name(host()))
