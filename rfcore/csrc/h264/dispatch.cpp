#include "h264/kernels.h"
#include "simd/kernel_table.h"

namespace rfcore::h264 {

const Kernels& kernels_for(const char* isa) {
    static const Kernels* const all[] = {RF_KERNEL_TABLES};
    return kernel_table(all, isa);
}

}  // namespace rfcore::h264
