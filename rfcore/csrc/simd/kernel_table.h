// The one search of every kernel family: the table of the instruction set that was asked for.
#pragma once

#include <cstring>
#include <stdexcept>
#include <string>

#include "simd/isa.h"

// The tables of a kernel family, as its namespace names them, best first.
#if defined(RF_HAVE_X86)
#define RF_KERNEL_TABLES &kAvx512Kernels, &kAvx2Kernels, &kScalarKernels
#elif defined(RF_HAVE_NEON)
#define RF_KERNEL_TABLES &kNeonKernels, &kScalarKernels
#else
#define RF_KERNEL_TABLES &kScalarKernels
#endif

namespace rfcore {

// The table of `tables` whose `isa` this machine runs under that name; "" asks for the best.
// Throws std::invalid_argument for an instruction set this machine lacks.
template <class Kernels, int count>
const Kernels& kernel_table(const Kernels* const (&tables)[count], const char* isa) {
    const char* found = find_isa(isa);
    if (found == nullptr) throw std::invalid_argument(std::string("no kernels named ") + isa);
    for (const Kernels* table : tables) {
        if (std::strcmp(table->isa, found) == 0) return *table;
    }
    throw std::logic_error(std::string("this family has no kernels for ") + found);
}

}  // namespace rfcore
