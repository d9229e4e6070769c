"""The splice: a decoder whose reference picture is put there by us.

Sender and receiver run the same code: an I_PCM picture of the render, then the received P slice.
The P slice predicts from exactly the render's samples, and whatever it carries, the next frame
begins with an IDR picture again, so nothing outlives a frame.
"""

from __future__ import annotations

from rfcore.codec.bitstream import join_nals
from rfcore.codec.h264 import H264Decoder
from rfcore.codec.header import StreamHeader, check_header
from rfcore.codec.parameter_sets import NAL_P, nal_type, parse_slice_start
from rfcore.codec.reference import pcm_picture, pcm_pps
from rfcore.errors import BitstreamError, CodecError
from rfcore.image import I420

__all__ = ["SpliceDecoder"]

_P_SLICE = 0


class SpliceDecoder:
    """Decodes P slices against renders. One caller at a time.

    Raises ``InvalidInput`` for a header that our encoder would not make.
    """

    def __init__(self, header: StreamHeader) -> None:
        self._config = header.config
        self._log2_max_frame_num = check_header(header).log2_max_frame_num
        self._parameter_sets = join_nals([header.sps, header.pps, pcm_pps()])
        self._decoder = H264Decoder(header.config.coded_size_px)
        self._knows_parameter_sets = False
        self._idr_pic_id = 0

    def check_payload(self, payload: bytes) -> None:
        """Raise ``BitstreamError`` unless ``payload`` is one NAL unit holding the first slice of a
        P picture under x264's PPS, the first after the IDR picture."""
        if nal_type(payload) != NAL_P:
            raise BitstreamError(f"NAL unit type {nal_type(payload)} is not a P picture's slice")
        start = parse_slice_start(payload, self._log2_max_frame_num)
        fields = (start.first_mb, start.slice_type, start.pps_id, start.frame_num)
        if fields != (0, _P_SLICE, 0, 1):
            raise BitstreamError(
                f"slice with first macroblock, type, PPS, frame number {fields} "
                f"where (0, {_P_SLICE}, 0, 1) is expected"
            )

    def predict_from(self, render: I420) -> None:
        """Make ``render`` the reference picture; raise ``CodecError`` if the decoder fails.

        The caller checks the render's size.
        """
        self._idr_pic_id ^= 1
        picture = join_nals([pcm_picture(render, self._log2_max_frame_num, self._idr_pic_id)])
        known = self._knows_parameter_sets
        self._decode(picture if known else self._parameter_sets + picture)
        self._knows_parameter_sets = True

    def decode(self, payload: bytes) -> I420:
        """Return the picture that ``payload`` makes of the reference picture, cropped to size.

        Raises ``CodecError`` when the decoder notices damage; it does not notice all of it.
        """
        picture = self._decode(join_nals([payload]))
        width_px, height_px = self._config.size_px
        half_height, half_width = (height_px + 1) // 2, (width_px + 1) // 2
        return I420(
            picture.y[:height_px, :width_px],
            picture.u[:half_height, :half_width],
            picture.v[:half_height, :half_width],
        )

    def reset(self) -> None:
        """Start over with a fresh decoder, whatever the last payload did to the old one."""
        self._decoder.reset()
        self._knows_parameter_sets = False

    def _decode(self, access_unit: bytes) -> I420:
        try:
            return self._decoder.decode(access_unit)
        except CodecError:
            self.reset()
            raise
