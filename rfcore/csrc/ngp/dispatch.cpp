// Which kernels this machine can run is the rasterizer's to say: the same instruction sets.
#include <cstring>
#include <stdexcept>
#include <string>

#include "ngp/kernels.h"
#include "raster/kernels.h"

namespace rfcore::ngp {

const Kernels& kernels_for(const char* isa) {
    const raster::Kernels* present =
        *isa == '\0' ? raster::available_kernels()[0] : raster::kernels_named(isa);
    if (present == nullptr) throw std::invalid_argument(std::string("no kernels named ") + isa);
    const Kernels* all[] = {
#if defined(RF_HAVE_X86)
        &kAvx512Kernels,
        &kAvx2Kernels,
#endif
#if defined(RF_HAVE_NEON)
        &kNeonKernels,
#endif
        &kScalarKernels,
    };
    for (const Kernels* kernels : all) {
        if (std::strcmp(kernels->isa, present->isa) == 0) return *kernels;
    }
    throw std::logic_error(std::string("hash grids have no kernels for ") + present->isa);
}

}  // namespace rfcore::ngp
