// How the small functions of kernels are inlined.
#pragma once

#if defined(RF_ISA_SCALAR)
// Sixteen lanes unrolled into every caller take the compiler minutes.
#define RF_INLINE static inline __attribute__((unused))
#else
#define RF_INLINE static inline __attribute__((always_inline))
#endif
