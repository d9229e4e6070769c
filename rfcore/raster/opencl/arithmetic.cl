// IEEE-754 float32 arithmetic as rfcore/csrc/simd defines it, one lane a work-item.
//
// Every fused multiply-add is written out, nothing else may be fused, and min and max are
// comparisons, because fmin and fmax treat NaN in another way. The host chooses a build:
//   UNFUSED_PRODUCTS  the compiler ignores FP_CONTRACT: products that feed a sum pass through
//                     integers, with a zero that is known at run time alone
//   INTEGER_DIVISION  divisions and square roots are not correctly rounded: done in integers
//   WORST_CASE        (tests) asks clang to contract across statements, which the first of them
//                     must survive
#ifdef WORST_CASE
#pragma OPENCL FP_CONTRACT ON
#else
#pragma OPENCL FP_CONTRACT OFF
#endif

#ifdef UNFUSED_PRODUCTS
#define PRODUCT(x, y) as_float(as_uint((x) * (y)) ^ zero)
#else
#define PRODUCT(x, y) ((x) * (y))
#endif

inline float least_of(float x, float y) { return x < y ? x : y; }
inline float most_of(float x, float y) { return x > y ? x : y; }
inline float within(float x, float low, float high) { return most_of(least_of(x, high), low); }
inline float negate(float x) { return 0.0f - x; }
inline float absolute(float x) { return most_of(x, negate(x)); }
inline float fnma(float x, float y, float z) { return fma(-x, y, z); }
inline float above_floor(float x) { return x - floor(x); }
inline float round_down(float x) { return x - above_floor(x); }
inline float round_up(float x) { return x + above_floor(negate(x)); }
inline float dot3(float3 p, float3 q) { return fma(p.x, q.x, fma(p.y, q.y, p.z * q.z)); }

#ifdef INTEGER_DIVISION
#define NOT_A_NUMBER as_float(0x7fc00000u)
#define INFINITY_BITS 0x7f800000u
#define FRACTION_BITS 0x007fffffu

// A finite float above zero is significand * 2^exponent with the significand in 2^23 .. 2^24 - 1.
typedef struct {
    ulong significand;
    int exponent;
} Parts;

inline Parts parts_of(uint bits) {
    Parts p;
    const uint fraction = bits & FRACTION_BITS, biased = bits >> 23;
    const int missing = biased == 0 ? (int)clz(fraction) - 8 : 0;
    p.significand = biased == 0 ? (ulong)fraction << missing : fraction | 0x00800000u;
    p.exponent = (biased == 0 ? 1 : (int)biased) - 150 - missing;
    return p;
}

// Round significand * 2^exponent to the nearest float, ties to even. The significand is in
// 2^26 .. 2^27 - 1, its lowest bit also set for a remainder below it.
inline float nearest_float(uint sign, ulong significand, int exponent) {
    int biased = exponent + 153;
    if (biased < 1) {
        const int shift = min(1 - biased, 28);
        const ulong lost = significand & ((1UL << shift) - 1);
        significand = significand >> shift | (ulong)(lost != 0);
        biased = 1;
    }
    const ulong kept = significand >> 3, rest = significand & 7;
    const ulong rounded = kept + (ulong)(rest > 4 || (rest == 4 && (kept & 1)));
    const ulong bits = ((ulong)(biased - 1) << 23) + rounded;
    return as_float(sign | (bits < INFINITY_BITS ? (uint)bits : INFINITY_BITS));
}

inline float divide(float x, float y) {
    const uint sign = (as_uint(x) ^ as_uint(y)) & 0x80000000u;
    const uint over = as_uint(x) & 0x7fffffffu, under = as_uint(y) & 0x7fffffffu;
    const bool undefined = (over == 0 && under == 0) || (over == INFINITY_BITS && under == over);
    if (over > INFINITY_BITS || under > INFINITY_BITS || undefined) return NOT_A_NUMBER;
    if (over == INFINITY_BITS || under == 0) return as_float(sign | INFINITY_BITS);
    if (over == 0 || under == INFINITY_BITS) return as_float(sign);
    const Parts p = parts_of(over), q = parts_of(under);
    const ulong scaled = p.significand << 27;
    ulong quotient = scaled / q.significand;  // above 2^26, below 2^28
    int exponent = p.exponent - q.exponent - 27;
    ulong remainder = scaled - quotient * q.significand;
    if (quotient >> 27) {
        remainder |= quotient & 1;
        quotient >>= 1;
        ++exponent;
    }
    return nearest_float(sign, quotient | (ulong)(remainder != 0), exponent);
}

inline float square_root(float x) {
    const uint bits = as_uint(x);
    if ((bits & 0x7fffffffu) == 0 || bits == INFINITY_BITS) return x;
    if (bits > INFINITY_BITS) return NOT_A_NUMBER;
    const Parts p = parts_of(bits);
    const int shift = 29 + ((p.exponent - 29) & 1);  // leaves an even exponent
    const ulong square = p.significand << shift;     // 2^52 .. 2^54
    ulong root = 0;
    for (ulong bit = 1UL << 26; bit != 0; bit >>= 1) {
        if ((root | bit) * (root | bit) <= square) root |= bit;
    }
    return nearest_float(0, root | (ulong)(root * root != square), (p.exponent - shift) / 2);
}
#else
inline float divide(float x, float y) { return x / y; }
inline float square_root(float x) { return sqrt(x); }
#endif

// 2^x to 1e-7, x clamped to +-120 (simd/math.h).
inline float exp2_accurate(float x) {
    const float p = within(x, -120.0f, 120.0f), f = above_floor(p);
    float e = fma(2.1702255472e-04f, f, 1.2439687824e-03f);
    e = fma(e, f, 9.6788409965e-03f);
    e = fma(e, f, 5.5483341984e-02f);
    e = fma(e, f, 2.4022983627e-01f);
    e = fma(e, f, 6.9314698384e-01f);
    e = fma(e, f, 1.0000000019e+00f);
    return as_float(as_uint(e) + ((uint)(int)floor(p) << 23));
}

// log2 of a normal x > 0 (simd/math.h): the mantissa is taken from sqrt(1/2) to sqrt(2).
inline float log2_accurate(float x) {
    const int from_root_half = as_int(x) - 0x3f3504f3;
    const float m = as_float((from_root_half & 0x007fffff) + 0x3f3504f3);
    const float s = divide(m - 1.0f, m + 1.0f), z = s * s;
    float r = fma(4.3174903923e-01f, z, 5.7671382547e-01f);
    r = fma(r, z, 9.6179885343e-01f);
    r = fma(r, z, 2.8853900798e+00f);
    return fma(r, s, (float)(from_root_half >> 23));
}

#define LOG2_E 1.44269504f
inline float sigmoid(float logit) {
    return divide(1.0f, 1.0f + exp2_accurate(logit * -LOG2_E));
}

// 2^(p - 8), 0 <= p < 126 (simd/math.h).
inline float alpha_from_log2(float p) {
    const float f = above_floor(p), scale = 1.0f / 256.0f;
    float e = fma(scale * 1.3534167915e-02f, f, scale * 5.2011460612e-02f);
    e = fma(e, f, scale * 2.4144275689e-01f);
    e = fma(e, f, scale * 6.9300383447e-01f);
    e = fma(e, f, scale * 1.0000025934e+00f);
    return as_float(as_uint(e) + ((uint)(int)floor(p) << 23));
}

// What the device makes of patterns x, y, z [count]: results [6][count].
kernel void arithmetic(uint count, global const float* x, global const float* y,
                       global const float* z, global float* results) {
    const uint n = get_global_id(0);
    if (n >= count) return;
    results[n] = x[n] + y[n];
    results[count + n] = x[n] * y[n];
    results[2 * count + n] = divide(x[n], y[n]);
    results[3 * count + n] = square_root(fabs(x[n]));
    results[4 * count + n] = fma(x[n], y[n], z[n]);
    results[5 * count + n] = floor(x[n]);
}
