// The levels of a block: each coefficient and the last one chosen by squared error and bits.
#pragma once

#include "h264/transform.h"

namespace {

using Cost = int64_t;

constexpr Cost kWorst = INT64_MAX / 4;

// Where the coefficient at a scan position lies in its block, and the other way round. Blocks are
// transposed, as `forward4` and `forward8` leave them, those of DC coefficients are not.
struct Scan {
    uint8_t place[64];
    uint8_t position[64];
};

constexpr Scan make_scan(Category category) {
    Scan scan{};
    for (int i = 0; i < kCoefficients[category]; ++i) {
        const bool ac = category == kLumaAc || category == kChromaAc;
        const int zigzag4 = kZigzag4[(i + ac) % 16], zigzag8 = kZigzag8[i];
        const int place = category == kLuma8      ? zigzag8 % 8 * 8 + zigzag8 / 8
                          : category == kLumaDc   ? zigzag4
                          : category == kChromaDc ? i
                                                  : zigzag4 % 4 * 4 + zigzag4 / 4;
        scan.place[i] = static_cast<uint8_t>(place);
        scan.position[place] = static_cast<uint8_t>(i);
    }
    return scan;
}

constexpr Scan kScan[6] = {make_scan(kLumaDc),   make_scan(kLumaAc),   make_scan(kLuma4),
                           make_scan(kChromaDc), make_scan(kChromaAc), make_scan(kLuma8)};

inline uint32_t symbol_cost(const Contexts& contexts, int context, int value) {
    return kSymbolCost[contexts.state[context] ^ value];
}

// Bits of the levels of one category in 1/256, with contexts as they are before a macroblock.
struct LevelRates {
    uint32_t zeros_before[64];  // significant_coeff_flag 0 at all positions before
    uint32_t inside[64];        // significant and not the last
    uint32_t last[64];          // significant and the last
    // coeff_abs_level_minus1, by context increment: whether above 0, then each further bin.
    uint32_t one[5], larger[5], further[5], end[5];

    uint32_t zero(int position) const {
        return zeros_before[position + 1] - zeros_before[position];
    }

    // The sign too; `ones` and `more` levels of 1 and above it come later in the scan.
    uint32_t level(Category category, int ones, int more, int magnitude) const {
        const int first = more ? 0 : ones < 3 ? 1 + ones : 4;
        if (magnitude == 1) return one[first];
        const int most = 4 - (category == kChromaDc);
        const int rest = more < most ? more : most;
        if (magnitude < 15) {
            return larger[first] + static_cast<uint32_t>(magnitude - 2) * further[rest] + end[rest];
        }
        const int k = 31 - __builtin_clz(static_cast<uint32_t>(magnitude - 14));
        return larger[first] + 13 * further[rest] + 256u * static_cast<uint32_t>(2 * k + 1);
    }
};

inline void measure(const Contexts& contexts, Category category, LevelRates& rates) {
    const int end = kCoefficients[category] - 1;
    rates.zeros_before[0] = 0;
    for (int i = 0; i < end; ++i) {
        const int significant = significant_context(category, i), last = last_context(category, i);
        const uint32_t present = symbol_cost(contexts, significant, 1);
        rates.zeros_before[i + 1] = rates.zeros_before[i] + symbol_cost(contexts, significant, 0);
        rates.inside[i] = present + symbol_cost(contexts, last, 0);
        rates.last[i] = present + symbol_cost(contexts, last, 1);
    }
    rates.last[end] = 0;  // inferred
    for (int i = 0; i < 5; ++i) {
        const int first = kLevelContext[category] + i;
        const int rest = first + 5 - (category == kChromaDc && i == 4);
        rates.one[i] = 256 + symbol_cost(contexts, first, 0);
        rates.larger[i] = 256 + symbol_cost(contexts, first, 1);
        rates.further[i] = symbol_cost(contexts, rest, 1);
        rates.end[i] = symbol_cost(contexts, rest, 0);
    }
}

// The rates of all categories, each measured when a macroblock first needs it.
class Rates {
public:
    void begin(const Contexts& contexts) {
        contexts_ = &contexts;
        known_ = 0;
    }

    const LevelRates& of(Category category) {
        LevelRates& rates = rates_[category];
        if (!((known_ >> category) & 1)) {
            measure(*contexts_, category, rates);
            known_ |= 1u << category;
        }
        return rates;
    }

    uint32_t flag(int context, int value) const { return symbol_cost(*contexts_, context, value); }

private:
    const Contexts* contexts_ = nullptr;
    unsigned known_ = 0;
    LevelRates rates_[6];
};

// The category is known when compiling: its sizes, contexts and scan are constants then.
template <Category kCategory>
struct RateQuantiser {
    static constexpr Category category = kCategory;
    Rates& rates;
    int flag_context;  // of coded_block_flag, -1 where there is none
    uint32_t lambda_q8;
    int shift;         // of `multiplier` to levels in 1/256
    int energy_shift;  // 2 * (qp / 6)
};

struct Quantised {
    uint64_t coded;  // a bit for each scan position that has a level
    uint32_t bits;   // of the levels, in 1/256
    explicit operator bool() const { return coded != 0; }
};

// Levels below this in 1/256 become 0: rounding them up saves less error than their sign bit costs.
constexpr int32_t kLeastLevel = 140;

// Levels in 1/256 without sign; returns a bit for each place that may have a level. Products stay
// below 2^32: 16 * 255 * 64 * 13107.
template <int count>
RF_INLINE uint64_t scale(const int32_t* coefficients, const uint16_t* multiplier, int shift,
                         int32_t* scaled) {
    for (int i = 0; i < count; ++i) {
        const uint32_t size =
            static_cast<uint32_t>(coefficients[i] < 0 ? -coefficients[i] : coefficients[i]);
        scaled[i] = static_cast<int32_t>((size * multiplier[i]) >> shift);
    }
    for (int i = count; i < 8; ++i) scaled[i] = 0;
    uint64_t large = 0;
    for (int i = 0; i < count; i += 8) {
        large |= static_cast<uint64_t>(above(scaled + i, kLeastLevel - 1)) << i;
    }
    return large;
}

// A coefficient that may have a level.
struct Choice {
    int32_t position, level, last_level;
    Cost inside;   // of `level`, against leaving it 0, if a later one is the last
    Cost at_last;  // of `last_level`, the same, if this is the last
};

// Returns the level inside. (A returned Choice would be copied by a wide load behind narrow stores,
// which took 3 % of a picture.)
template <Category category>
RF_INLINE int choose_level(const RateQuantiser<category>& q, const LevelRates& rates, int position,
                           int32_t scaled, Cost weight, int ones, int more, Choice& choice) {
    const Cost lambda = q.lambda_q8;
    const bool end = position == kCoefficients[category] - 1;
    const uint32_t zero_bits = end ? 0 : rates.zero(position);
    const Cost zero = (static_cast<Cost>(scaled) * scaled * weight) >> 8;
    int chosen = 0, chosen_last = 0;
    Cost least = 0, least_last = kWorst;
    const int high = (scaled + 128) >> 8;
    const int low = scaled < 256 * high && high > 1 ? high - 1 : high;  // else not worth a try
    for (int level = high; level >= low; --level) {
        const Cost off = scaled - 256 * level;
        const Cost saved = ((off * off * weight) >> 8) - zero;
        const Cost bits = rates.level(category, ones, more, level);
        const Cost last = saved + lambda * (bits + rates.last[position]);
        if (last < least_last) {
            least_last = last;
            chosen_last = level;
        }
        if (end) continue;
        const Cost inside = saved + lambda * (bits + rates.inside[position] - zero_bits);
        if (inside < least) {
            least = inside;
            chosen = level;
        }
    }
    choice.position = position;
    choice.level = chosen;
    choice.last_level = chosen_last;
    choice.inside = least;
    choice.at_last = least_last;
    return chosen;
}

// Writes the levels up to choices[chosen], the last one; choices run from the end of the scan.
template <Category category>
Quantised take_levels(const LevelRates& rates, Choice* choices, int chosen, int count,
                      const int32_t* coefficients, int16_t* levels) {
    constexpr const Scan& scan = kScan[category];
    Quantised result = {0, rates.zeros_before[choices[chosen].position]};
    __builtin_memset(levels, 0, sizeof(int16_t) * static_cast<size_t>(kCoefficients[category]));
    choices[chosen].level = choices[chosen].last_level;
    int ones = 0, more = 0;
    for (int k = chosen; k < count; ++k) {
        const int level = choices[k].level, position = choices[k].position;
        if (level == 0) continue;
        result.coded |= uint64_t{1} << position;
        result.bits += rates.level(category, ones, more, level);
        result.bits += k == chosen ? rates.last[position]
                                   : rates.inside[position] - rates.zero(position);
        ++(level == 1 ? ones : more);
        const bool negative = coefficients[scan.place[position]] < 0;
        levels[position] = static_cast<int16_t>(negative ? -level : level);
    }
    return result;
}

// Levels in scan order for the `coefficients` of a block; `levels` is left alone where nothing is
// worth its bits.
template <Category category>
Quantised quantise(const RateQuantiser<category>& q, const int32_t* coefficients,
                   const uint16_t* multiplier, const uint16_t* energy, int16_t* levels) {
    constexpr const Scan& scan = kScan[category];
    alignas(32) int32_t scaled[64];
    constexpr int kCount = category == kLuma8 ? 64 : category == kChromaDc ? 4 : 16;
    uint64_t large = scale<kCount>(coefficients, multiplier, q.shift, scaled);
    if (category == kLumaAc || category == kChromaAc) large &= ~uint64_t{1};
    if (large == 0) return {0, 0};
    uint64_t todo = 0;
    for (; large != 0; large &= large - 1) {
        todo |= uint64_t{1} << scan.position[__builtin_ctzll(large)];
    }
    const LevelRates& rates = q.rates.of(category);
    Choice choices[64];
    int count = 0, ones = 0, more = 0;
    while (todo != 0) {
        const int position = 63 - __builtin_clzll(todo), place = scan.place[position];
        todo ^= uint64_t{1} << position;
        const Cost weight = static_cast<Cost>(energy[place]) << q.energy_shift;
        const int level =
            choose_level(q, rates, position, scaled[place], weight, ones, more, choices[count++]);
        ones += level == 1;
        more += level > 1;
    }
    const Cost lambda = q.lambda_q8;
    Cost before = 0, least = 0;
    if (q.flag_context >= 0) {
        least = lambda * q.rates.flag(q.flag_context, 0);
        before = lambda * q.rates.flag(q.flag_context, 1);
    }
    int chosen = -1;
    for (int k = count - 1; k >= 0; --k) {
        const Cost all = before + lambda * rates.zeros_before[choices[k].position];
        if (all + choices[k].at_last < least) {
            least = all + choices[k].at_last;
            chosen = k;
        }
        before += choices[k].inside;
    }
    if (chosen < 0) return {0, 0};
    return take_levels<category>(rates, choices, chosen, count, coefficients, levels);
}

}  // namespace
