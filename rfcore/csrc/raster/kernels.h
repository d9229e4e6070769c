// The kernels as tables of function pointers, one table per instruction set.
#pragma once

#include "raster/types.h"

namespace rfcore::raster {

struct Kernels {
    const char* isa;
    // Fill `geometry` of blocks begin..end from their parameters.
    void (*prepare)(const float* parameters, int planes, float* geometry, int begin, int end);
    // Project blocks begin..end. [training][antialiased][degree]
    Projected (*project[2][2][kMaxDegree + 1])(const ProjectJob&, int begin, int end);
    // Append the entries of one splat, of any size, to `out`; return how many. There must be room
    // for every group of the picture.
    int (*place_large)(const Camera&, const Splat* splats, uint32_t id, GroupEntry* out);
    // Tiles are numbered group by group, those of a group row by row.
    void (*blend_colour)(const BlendJob&, int tile);
    void (*blend_view)(const BlendJob&, int tile);
    void (*blend_counting)(const BlendJob&, int tile);
    void (*blend_backward)(const BlendBackwardJob&, int group);
    // [antialiased][degree]; blocks begin..end
    void (*project_backward[2][kMaxDegree + 1])(const ProjectBackwardJob&, int begin, int end);
    // Rows begin..end of a channel; `scratch` holds kLossRows * loss_stride(width) zeros before
    // the first call and is left ready for the next one of the same width.
    void (*loss_strip)(const LossJob&, int channel, int begin, int end, float* scratch);
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

}  // namespace rfcore::raster
