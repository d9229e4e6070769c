// exp and log in double precision from IEEE operations alone: two C libraries need not agree.
#pragma once

#include <cmath>

namespace rfcore::raster {

// e^x to 1e-15 relative for |x| <= 700; beyond that as at the limit.
inline double portable_exp(double x) {
    x = x < -700.0 ? -700.0 : x > 700.0 ? 700.0 : x;
    constexpr double kLn2High = 6.93147180369123816490e-01, kLn2Low = 1.90821492927058770002e-10;
    const double n = std::floor(x * 1.44269504088896338700 + 0.5);
    const double r = (x - n * kLn2High) - n * kLn2Low;  // |r| <= 0.35
    double sum = 1.0;
    for (int k = 14; k > 0; --k) sum = 1.0 + sum * r / k;
    return std::ldexp(sum, static_cast<int>(n));
}

// ln x to 1e-15 for normal x > 0: atanh series in (m - 1) / (m + 1), |s| <= 0.172.
inline double portable_log(double x) {
    int exponent = 0;
    double m = std::frexp(x, &exponent);  // 0.5 .. 1
    if (m < 0.70710678118654752440) {
        m *= 2.0;
        --exponent;
    }
    const double s = (m - 1.0) / (m + 1.0), z = s * s;
    double sum = 0.0;
    for (int k = 23; k > 0; k -= 2) sum = sum * z + 1.0 / k;
    return 2.0 * s * sum + exponent * 0.69314718055994530942;
}

inline double portable_sigmoid(double logit) { return 1.0 / (1.0 + portable_exp(-logit)); }

}  // namespace rfcore::raster
