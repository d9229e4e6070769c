// Compiled once per instruction set; RF_KERNELS names the table, RF_ISA_* picks the wrapper.
// Everything else here has internal linkage.
#include "raster/blend_backward.h"
#include "raster/blend_forward.h"
#include "raster/kernels.h"
#include "raster/loss.h"
#include "raster/project.h"
#include "raster/project_backward.h"

namespace rfcore::raster {

// One kernel per SH degree: a field of few bands does not pay for those it lacks.
#define RF_PER_DEGREE(kernel, ...) \
    {kernel<0, __VA_ARGS__>, kernel<1, __VA_ARGS__>, kernel<2, __VA_ARGS__>, kernel<3, __VA_ARGS__>}

extern const Kernels RF_KERNELS;
const Kernels RF_KERNELS = {
    RF_ISA_NAME,
    prepare,
    {{RF_PER_DEGREE(project, false, false), RF_PER_DEGREE(project, false, true)},
     {RF_PER_DEGREE(project, true, false), RF_PER_DEGREE(project, true, true)}},
    place_large,
    blend<false, false>,
    blend<true, false>,
    blend<true, true>,
    blend_backward,
    {RF_PER_DEGREE(project_backward, false), RF_PER_DEGREE(project_backward, true)},
    loss_strip,
};

}  // namespace rfcore::raster
