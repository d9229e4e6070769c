// Which kernels this machine can run: decided once, by CPUID.
#include <cstring>

#include "raster/kernels.h"

namespace rfcore::raster {
namespace {

struct Available {
    const Kernels* list[4] = {};

    Available() {
        const Kernels** next = list;
#if defined(RF_HAVE_X86)
        if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
            __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
            *next++ = &kAvx512Kernels;
        }
        if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
            *next++ = &kAvx2Kernels;
        }
#endif
#if defined(RF_HAVE_NEON)
        *next++ = &kNeonKernels;
#endif
        *next = &kScalarKernels;
    }
};

}  // namespace

const Kernels* const* available_kernels() {
    static const Available available;
    return available.list;
}

const Kernels* kernels_named(const char* isa) {
    for (const Kernels* const* k = available_kernels(); *k != nullptr; ++k) {
        if (std::strcmp((*k)->isa, isa) == 0) return *k;
    }
    return nullptr;
}

}  // namespace rfcore::raster
