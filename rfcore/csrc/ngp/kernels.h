// The kernels as tables of function pointers, one table per instruction set.
#pragma once

#include "ngp/types.h"

namespace rfcore::ngp {

struct Kernels {
    const char* isa;
    // [unbounded]; one tile of 16x16 pixels; `chunks` holds kRenderChunks.
    void (*render_tile[2])(const RenderJob&, int tile, Chunk* chunks);
    // [unbounded]
    void (*train_block[2])(const TrainJob&, int block);
    void (*encode)(const Field&, Chunk* chunks, int count);
    void (*update_level)(const TableJob&, int level);
    void (*adam)(const AdamStep&, size_t count, float* gradients, float* parameters,
                 float* first_moments, float* second_moments);
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

}  // namespace rfcore::ngp
