"""The splice: a standard decoder is fed our own reference pictures, then the received slice.

Sender and receiver run the same code: an I_PCM picture for each reference, then the received slice.
The P slice predicts from exactly those samples. Whatever it carries, the next frame begins with an
IDR picture again, so no decoder state outlives a frame.

A frame without references is an IDR picture. A grey I_PCM picture goes before it, so that its
``idr_pic_id``, which is always 0, never follows another 0 (7.4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from rfcore.codec.h264.bitstream import NAL_IDR, NAL_P, join_nals, nal_type, parse_slice_start
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.header import StreamHeader, check_header
from rfcore.codec.h264.pcm_picture import PcmPictures, PcmPlace, pcm_pps
from rfcore.errors import BitstreamError, CodecError
from rfcore.image import I420

_P_SLICE, _I_SLICE = 0, 2


class PictureDecoder(Protocol):
    """A standard decoder for access units of one size, as ``ffmpeg.H264Decoder`` is."""

    def decode(self, access_unit: bytes) -> I420:
        """Return the picture of one access unit; raise ``CodecError``."""

    def feed(self, access_unit: bytes | memoryview) -> None:
        """Decode a reference for later units; raise ``CodecError``. The buffer is not kept."""

    def reset(self) -> None:
        """Forget everything, parameter sets included."""

    def close(self) -> None:
        """Release the decoder's resources; it is not used again."""


class SpliceDecoder:
    """Decodes slices against references. One caller at a time.

    Raises ``InvalidInput`` for a header that our encoder would not make, before ``open_decoder``
    is called with the coded size.
    """

    def __init__(
        self,
        header: StreamHeader,
        open_decoder: Callable[[tuple[int, int]], PictureDecoder] = H264Decoder,
    ) -> None:
        self._config = header.config
        check_header(header)
        self._parameter_sets = join_nals([header.sps, header.pps, pcm_pps()])
        self._decoder = open_decoder(header.config.coded_size_px)
        self._pcm_pictures = PcmPictures(header.config.size_px)
        self._knows_parameter_sets = False
        self._idr_pic_id = 1

    def check_payload(self, payload: bytes, references: int = 1) -> None:
        """Raise ``BitstreamError`` unless ``payload`` is one NAL unit holding the first slice of a
        picture under x264's PPS: the P picture after so many references, or an IDR picture."""
        expected_nal = NAL_P if references else NAL_IDR
        if nal_type(payload) != expected_nal:
            kind = "a P picture's slice" if references else "an IDR picture's slice"
            raise BitstreamError(f"NAL unit type {nal_type(payload)} is not {kind}")
        start = parse_slice_start(payload)
        fields = (start.first_mb, start.slice_type, start.pps_id, start.frame_num)
        expected = (0, _P_SLICE if references else _I_SLICE, 0, references)
        if fields != expected:
            raise BitstreamError(
                f"slice with first macroblock, type, PPS, frame number {fields} "
                f"where {expected} is expected"
            )

    def predict_from(self, *pictures: I420) -> None:
        """Make ``pictures`` the references, the last one reference 0; none prepares for an IDR
        picture. Raises ``CodecError`` if the decoder fails. The caller checks sizes and number.
        """
        fed: Sequence[I420] = pictures or [I420.filled(self._config.size_px)]
        self._idr_pic_id ^= 3  # 1 and 2 by turns
        for frame_num, picture in enumerate(fed):
            place = PcmPlace(frame_num, self._idr_pic_id)
            sets = b"" if self._knows_parameter_sets else self._parameter_sets
            unit = self._pcm_pictures.access_unit(picture, place, sets)
            with self._fresh_after_errors():
                self._decoder.feed(unit)
            self._knows_parameter_sets = True

    def decode(self, payload: bytes) -> I420:
        """Return the picture that ``payload`` makes of the references, cropped to size.

        Raises ``CodecError`` for damage that the decoder detects; it does not detect all damage.
        """
        with self._fresh_after_errors():
            picture = self._decoder.decode(join_nals([payload]))
        return picture.cropped(self._config.size_px)

    def reset(self) -> None:
        """Start over with a fresh decoder, whatever the last payload did to the old one."""
        self._knows_parameter_sets = False
        self._decoder.reset()

    def close(self) -> None:
        """Release the decoder's resources."""
        self._decoder.close()

    @contextmanager
    def _fresh_after_errors(self) -> Iterator[None]:
        try:
            yield
        except CodecError:
            self.reset()
            raise
