// The slice coder as a table of function pointers, one table per instruction set.
#pragma once

#include "h264/types.h"

namespace rfcore::h264 {

struct Kernels {
    const char* isa;
    // Returns the bytes of slice_data written to `out`, 0 where `capacity` does not hold them.
    size_t (*encode)(const SliceJob&);
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
