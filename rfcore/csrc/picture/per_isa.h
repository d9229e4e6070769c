// RFCORE_PER_ISA before a function: the compiler makes it for AVX2, too, and the machine picks one.
//
// For integers, and for float32 with separate multiplications and additions (no contraction, see
// CMakeLists.txt): there every instruction set gives the same bytes.
#pragma once

#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define RFCORE_PER_ISA __attribute__((target_clones("avx2", "default")))
#else
#define RFCORE_PER_ISA
#endif
