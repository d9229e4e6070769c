// Compiled once per instruction set; RF_KERNELS names the table. Everything else here has internal
// linkage, and all arithmetic is of integers: every table writes the same bytes.
#include "h264/half_samples.h"
#include "h264/loop_filter.h"
#include "h264/slice.h"

namespace rfcore::h264 {

extern const Kernels RF_KERNELS;
const Kernels RF_KERNELS = {RF_ISA_NAME, sizeof(Coded),   sizeof(RowContexts),
                                  decide_row,  write_slice,     deblock_row,
                                  half_samples};

}  // namespace rfcore::h264
