// Which instruction sets this machine can run.
#pragma once

namespace rfcore {

// Names of those with kernels in this build, best first, "scalar" last; null-terminated. Decided
// once, by CPUID.
const char* const* available_isas();
// The name in that list equal to `isa`, the best one for "", null for one this machine lacks.
const char* find_isa(const char* isa);

}  // namespace rfcore
