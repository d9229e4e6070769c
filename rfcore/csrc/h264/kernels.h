// The slice coder as a table of function pointers, one table per instruction set.
#pragma once

#include "h264/types.h"

namespace rfcore::h264 {

struct Kernels {
    const char* isa;
    size_t coded_bytes, contexts_bytes;
    // Decides on one row of macroblocks; rows may run at the same time, begun in order.
    void (*decide_row)(const SliceJob&, int row);
    // Returns the bytes of slice_data written to `out`, 0 where `capacity` does not hold them.
    // Macroblocks above kMaxMacroblockBits are forced to I_PCM: `again` asks for both passes anew.
    size_t (*write_slice)(const SliceJob&, bool* again);
    // Filters a row of the reconstruction in place (8.7), after `write_slice` and, up to one
    // macroblock further on, the row above.
    void (*deblock_row)(const SliceJob&, int row);
    // Half-sample planes b, h, j of a padded plane of integer samples (8.4.2.2.1).
    void (*half_samples)(const uint8_t* whole, ptrdiff_t stride, int width, int height,
                         uint8_t* const* out);
};

extern const Kernels kScalarKernels;
#if defined(RF_HAVE_X86)
extern const Kernels kAvx2Kernels;
extern const Kernels kAvx512Kernels;
#endif
#if defined(RF_HAVE_NEON)
extern const Kernels kNeonKernels;
#endif

// The table for the instruction set `isa`, "" for the best; throws for one this machine lacks.
const Kernels& kernels_for(const char* isa);

}  // namespace rfcore::h264
