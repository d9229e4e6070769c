// Compiled once per instruction set; RF_KERNELS names the table, RF_ISA_* picks the wrapper.
// Everything else here has internal linkage.
#include "raster/blend_backward.h"
#include "raster/blend_forward.h"
#include "raster/kernels.h"
#include "raster/loss.h"
#include "raster/project.h"
#include "raster/project_backward.h"
#include "raster/spans.h"

namespace rfcore::raster {

extern const Kernels RF_KERNELS;
const Kernels RF_KERNELS = {
    RF_ISA_NAME,
    prepare,
    {{project<0, false>, project<1, false>, project<2, false>, project<3, false>},
     {project<0, true>, project<1, true>, project<2, true>, project<3, true>}},
    find_spans,
    blend<false, false>,
    blend<true, false>,
    blend<true, true>,
    blend_backward,
    {project_backward<0>, project_backward<1>, project_backward<2>, project_backward<3>},
    loss_strip,
};

}  // namespace rfcore::raster
