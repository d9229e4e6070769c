// Sixteen lanes as a plain array: the baseline of every machine, and what the others must equal.
#pragma once

namespace {

struct Lanes {
    float f[16];
};
struct Mask {
    uint32_t set;
};

#define RF_EACH for (int i = 0; i < 16; ++i)
RF_INLINE Lanes splat(float x) {
    Lanes r;
    RF_EACH r.f[i] = x;
    return r;
}
RF_INLINE Lanes load(const float* p) {
    Lanes r;
    memcpy(r.f, p, sizeof r.f);
    return r;
}
RF_INLINE Lanes load_unaligned(const float* p) { return load(p); }
RF_INLINE Lanes load_repeated(const float* p) {
    Lanes r;
    RF_EACH r.f[i] = p[i & 3];
    return r;
}
RF_INLINE void store(float* p, Lanes x) { memcpy(p, x.f, sizeof x.f); }
RF_INLINE void store_unaligned(float* p, Lanes x) { store(p, x); }
RF_INLINE void store_where(float* p, Mask m, Lanes x) {
    RF_EACH if (m.set >> i & 1) p[i] = x.f[i];
}

RF_INLINE Lanes operator+(Lanes x, Lanes y) {
    RF_EACH x.f[i] += y.f[i];
    return x;
}
RF_INLINE Lanes operator-(Lanes x, Lanes y) {
    RF_EACH x.f[i] -= y.f[i];
    return x;
}
RF_INLINE Lanes operator*(Lanes x, Lanes y) {
    RF_EACH x.f[i] *= y.f[i];
    return x;
}
RF_INLINE Lanes operator/(Lanes x, Lanes y) {
    RF_EACH x.f[i] /= y.f[i];
    return x;
}
RF_INLINE Lanes fma(Lanes x, Lanes y, Lanes z) {
    RF_EACH x.f[i] = __builtin_fmaf(x.f[i], y.f[i], z.f[i]);
    return x;
}
RF_INLINE Lanes fnma(Lanes x, Lanes y, Lanes z) {
    RF_EACH x.f[i] = __builtin_fmaf(-x.f[i], y.f[i], z.f[i]);
    return x;
}
RF_INLINE Lanes sqrt(Lanes x) {
    RF_EACH x.f[i] = __builtin_sqrtf(x.f[i]);
    return x;
}
RF_INLINE Lanes min(Lanes x, Lanes y) {
    RF_EACH x.f[i] = x.f[i] < y.f[i] ? x.f[i] : y.f[i];
    return x;
}
RF_INLINE Lanes max(Lanes x, Lanes y) {
    RF_EACH x.f[i] = x.f[i] > y.f[i] ? x.f[i] : y.f[i];
    return x;
}

RF_INLINE Mask ge(Lanes x, Lanes y) {
    Mask m{0};
    RF_EACH m.set |= static_cast<uint32_t>(x.f[i] >= y.f[i]) << i;
    return m;
}
RF_INLINE Mask gt(Lanes x, Lanes y) {
    Mask m{0};
    RF_EACH m.set |= static_cast<uint32_t>(x.f[i] > y.f[i]) << i;
    return m;
}
RF_INLINE Mask both(Mask x, Mask y) { return {x.set & y.set}; }
RF_INLINE uint32_t bits(Mask m) { return m.set; }
RF_INLINE Mask mask_from_bits(uint32_t m) { return {m}; }
RF_INLINE Lanes select(Mask m, Lanes x, Lanes y) {
    RF_EACH x.f[i] = (m.set >> i & 1) ? x.f[i] : y.f[i];
    return x;
}
RF_INLINE Lanes keep(Mask m, Lanes x) { return select(m, x, splat(0.0f)); }
RF_INLINE Lanes keep_min(Mask m, Lanes x, Lanes y) { return keep(m, min(x, y)); }
RF_INLINE Lanes keep_mul(Mask m, Lanes x, Lanes y) { return keep(m, x * y); }

// floor without libm; what lies beyond a thousand million is masked by every caller.
RF_INLINE int floor_to_int(float p) {
    constexpr float kLimit = 1e9f;
    const float near = p > -kLimit ? (p < kLimit ? p : kLimit) : -kLimit;
    const int whole = static_cast<int>(near);
    return whole - (static_cast<float>(whole) > near);
}
RF_INLINE Lanes above_floor(Lanes p) {
    RF_EACH p.f[i] -= static_cast<float>(floor_to_int(p.f[i]));
    return p;
}
RF_INLINE Lanes above_floor_of_positive(Lanes p) { return above_floor(p); }
RF_INLINE Lanes reciprocal_guess(Lanes x) {
    RF_EACH {
        uint32_t bits_of_x;
        memcpy(&bits_of_x, &x.f[i], sizeof bits_of_x);
        bits_of_x = 0x7ef311c3u - bits_of_x;
        memcpy(&x.f[i], &bits_of_x, sizeof bits_of_x);
    }
    return x;
}
RF_INLINE Lanes times_exp2_floor(Lanes x, Lanes p) {
    RF_EACH {
        uint32_t bits_of_x;
        memcpy(&bits_of_x, &x.f[i], sizeof bits_of_x);
        bits_of_x += static_cast<uint32_t>(floor_to_int(p.f[i])) << 23;
        memcpy(&x.f[i], &bits_of_x, sizeof bits_of_x);
    }
    return x;
}
RF_INLINE Lanes split_exponent(Lanes x, Lanes* mantissa) {
    constexpr int32_t kRootHalf = 0x3f3504f3;
    RF_EACH {
        int32_t shifted;
        memcpy(&shifted, &x.f[i], sizeof shifted);
        shifted -= kRootHalf;
        const int32_t fraction = (shifted & 0x007fffff) + kRootHalf;
        memcpy(&mantissa->f[i], &fraction, sizeof fraction);
        x.f[i] = static_cast<float>(shifted >> 23);
    }
    return x;
}

RF_INLINE int append_offsets(uint16_t* out, uint32_t mask, int base, int step) {
    int count = 0;
    for (; mask != 0; mask &= mask - 1) {
        out[count++] = static_cast<uint16_t>(base + step * __builtin_ctz(mask));
    }
    return count;
}
RF_INLINE void transpose(const float* rows, Lanes* columns) {
    for (int j = 0; j < 16; ++j) RF_EACH columns[j].f[i] = rows[16 * i + j];
}
#undef RF_EACH

}  // namespace
