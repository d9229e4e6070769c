// The macroblocks of an I_PCM picture: samples in the order of ITU-T H.264, 7.3.5.
//
// The definition (header bytes, clamping, edges) is in rfcore/codec/h264/splice.py.
#pragma once

#include <cstddef>
#include <cstdint>

#include "picture/yuv.h"

namespace rfcore {

// How many bytes pcm_macroblocks writes: 386 a macroblock, without the two before the first.
std::size_t pcm_bytes(PictureSize size);

void pcm_macroblocks(ConstI420Planes in, PictureSize size, std::uint8_t* out);

}  // namespace rfcore
