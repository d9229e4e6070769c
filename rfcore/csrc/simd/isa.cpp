#include "simd/isa.h"

#include <cstring>

namespace rfcore {
namespace {

struct Available {
    const char* names[5] = {};

    Available() {
        const char** next = names;
#if defined(RF_HAVE_X86)
        // Processors with AVX2 count bits with BMI, BMI2 and LZCNT; a virtual machine may hide them.
        const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                          __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") &&
                          __builtin_cpu_supports("lzcnt");
        if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
            __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
            *next++ = "avx512";
        }
        if (avx2) *next++ = "avx2";
#endif
#if defined(RF_HAVE_NEON)
        *next++ = "neon";
#endif
        *next = "scalar";
    }
};

}  // namespace

const char* const* available_isas() {
    static const Available available;
    return available.names;
}

const char* find_isa(const char* isa) {
    if (*isa == '\0') return available_isas()[0];
    for (const char* const* name = available_isas(); *name != nullptr; ++name) {
        if (std::strcmp(*name, isa) == 0) return *name;
    }
    return nullptr;
}

}  // namespace rfcore
