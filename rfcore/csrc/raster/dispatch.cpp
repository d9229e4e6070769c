#include "raster/kernels.h"
#include "simd/kernel_table.h"

namespace rfcore::raster {

const Kernels& kernels_for(const char* isa) {
    static const Kernels* const all[] = {RF_KERNEL_TABLES};
    return kernel_table(all, isa);
}

}  // namespace rfcore::raster
