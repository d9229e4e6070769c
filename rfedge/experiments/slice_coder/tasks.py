"""The work that slice coders are compared on: frames, each with the references of a real stream.

The stream is coded by x264 medium in a closed loop, references chosen as the sender chooses them.
Every other coder gets the same pictures, so the curves differ by the coders alone; what a coder's
own reconstructions would be worth as references is not part of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.codec.h264.bitstream import BitReader, rbsp_of_nal
from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.header import StreamHeader, check_header
from rfcore.codec.h264.parameter_sets import NAL_IDR, nal_type, parse_pps
from rfcore.codec.h264.slices import CodedSlice, encode_slice
from rfcore.codec.h264.splice import SpliceDecoder, grey
from rfcore.codec.photometric import Photometric
from rfcore.codec.prediction import Prediction
from rfcore.codec.sender.frame_costs import FrameCosts
from rfcore.codec.sender.reference_choice import choose_photometric, choose_references
from rfcore.codec.state import Past
from rfcore.extras import needs
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.experiments.clips import Drive

with needs("eval"):
    import cv2

__all__ = ["Footage", "SliceTask", "header_of", "noisy", "resized", "slice_qp", "slice_tasks"]

RIVAL = "medium"
"""x264's preset that makes the references."""
_END_OF_CHANGES = 3
"""Of modification_of_pic_nums_idc (table 7-7)."""


@dataclass(frozen=True)
class Footage:
    """Frames of one size and what the field shows at the pose of each."""

    frames: Sequence[I420]
    views: Sequence[FieldView]

    @staticmethod
    def of(drive: Drive, field: RadianceField) -> Footage:
        """Render the field along a drive."""
        views = [render_field_view(field, camera) for camera in drive.cameras]
        return Footage(drive.frames, views)

    @property
    def config(self) -> CodecConfig:
        """The stream's configuration but for its quality."""
        return CodecConfig(*self.frames[0].size_px, effort=effort_of_preset(RIVAL))


@dataclass(frozen=True)
class SliceTask:
    """One frame to code, the last reference being reference 0.

    ``crf`` is x264's, ``qp`` the quantiser its slice got there: coders without that rate control
    take it, so that the points of all are at nearly the same quality.
    """

    crf: float
    qp: int
    frame: I420
    references: tuple[I420, ...]


def header_of(config: CodecConfig) -> StreamHeader:
    """Return the parameter sets of a stream, the same for every coder."""
    return encode_slice(config, [grey(config)], grey(config)).header


def resized(drive: Drive, field: RadianceField, width_px: int, height_px: int) -> Footage:
    """Resample a drive's frames and render the field at that size."""
    cameras = [
        Camera(camera.intrinsics.resized(width_px, height_px), camera.world_from_cam)
        for camera in drive.cameras
    ]
    frames = [_resampled(frame, width_px, height_px) for frame in drive.frames]
    return Footage(frames, [render_field_view(field, camera) for camera in cameras])


def _resampled(frame: I420, width_px: int, height_px: int) -> I420:
    half = ((width_px + 1) // 2, (height_px + 1) // 2)
    sizes = ((width_px, height_px), half, half)
    planes = zip(frame.planes, sizes, strict=True)
    return I420(*(_resampled_plane(plane, size) for plane, size in planes))


def _resampled_plane(plane: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(plane, size_px, interpolation=cv2.INTER_CUBIC), np.uint8)


def noisy(footage: Footage, sigma: float, seed: int) -> Footage:
    """Add Gaussian noise, as a camera's sensor does, to every sample of the frames."""
    rng = np.random.default_rng(seed)

    def plus_noise(plane: NDArray[Any]) -> NDArray[np.uint8]:
        return np.clip(plane + rng.normal(0, sigma, plane.shape), 0, 255).round().astype(np.uint8)

    frames = [I420(*map(plus_noise, frame.planes)) for frame in footage.frames]
    return Footage(frames, footage.views)


def slice_tasks(footage: Footage, crf: float, lights: list[Photometric]) -> Iterator[SliceTask]:
    """Yield every frame but the first with its references at ``crf``.

    ``lights`` holds each frame's light once it was looked for; an empty list is filled.
    """
    config = footage.config
    decoder = SpliceDecoder(header_of(config))
    past: Past | None = None
    for index, (frame, view) in enumerate(zip(footage.frames, footage.views, strict=True)):
        costs = FrameCosts(frame)
        if len(lights) <= index:
            lights.append(choose_photometric(costs, view.render, crf))
        prediction = Prediction.under_light(view, lights[index], past)
        references = choose_references(costs, prediction, crf)
        pictures = prediction.pictures(references)
        coded = encode_slice(_at(config, crf), pictures, frame)
        if index:
            yield SliceTask(crf, slice_qp(coded), frame, pictures)
        decoder.predict_from(*pictures)
        past = prediction.past_of(decoder.decode(coded.payload))


def slice_qp(coded: CodedSlice) -> int:
    """Return SliceQP_Y from a slice header of our streams (7.3.3), weights and list changes read
    over."""
    sps, pps = check_header(coded.header), parse_pps(coded.header.pps)
    r = BitReader(rbsp_of_nal(coded.payload))
    intra = nal_type(coded.payload) == NAL_IDR
    r.ue(), r.ue(), r.ue(), r.u(sps.log2_max_frame_num)
    if intra:
        r.ue(), r.u(2)  # idr_pic_id, dec_ref_pic_marking
    else:
        count = r.ue() + 1 if r.flag() else pps.default_refs[0]
        if r.flag():  # ref_pic_list_modification_flag_l0
            while r.ue() != _END_OF_CHANGES:
                r.ue()
        if pps.weighted_pred:
            _skip_weights(r, count)
        r.u(1)  # adaptive_ref_pic_marking_mode_flag
        r.ue()  # cabac_init_idc
    return pps.init_qp + r.se()


def _skip_weights(r: BitReader, count: int) -> None:
    r.ue(), r.ue()
    for _ in range(count):
        for values in (2, 4):
            for _ in range(values if r.flag() else 0):
                r.se()


def _at(config: CodecConfig, crf: float) -> CodecConfig:
    return CodecConfig(config.width_px, config.height_px, config.effort, crf)
