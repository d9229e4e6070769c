#include "h264/kernels.h"
#include "simd/kernel_table.h"

namespace rfcore::h264 {

const Kernels& kernels_for(const char* isa) {
    static const Kernels* const all[] = {
#if defined(RF_HAVE_X86)
        &kAvx512Kernels,
        &kAvx2Kernels,
#endif
#if defined(RF_HAVE_NEON)
        &kNeonKernels,
#endif
        &kScalarKernels,
    };
    return kernel_table(all, isa);
}

}  // namespace rfcore::h264
