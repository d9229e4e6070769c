// Compiled once per instruction set; RF_KERNELS names the table, RF_ISA_* picks the wrapper.
// Everything else here has internal linkage.
#include "ngp/kernels.h"

#include "ngp/adam.h"
#include "ngp/train.h"

namespace rfcore::ngp {

extern const Kernels RF_KERNELS;
const Kernels RF_KERNELS = {
    RF_ISA_NAME,
    {render_tile<false>, render_tile<true>},
    {train_block<false>, train_block<true>},
    encode,
    update_level,
    adam,
};

}  // namespace rfcore::ngp
