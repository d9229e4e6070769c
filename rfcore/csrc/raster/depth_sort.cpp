#include "raster/depth_sort.h"

#include <algorithm>
#include <cstring>

namespace rfcore::raster {
namespace {

constexpr int kPasses = 3;
constexpr int kMinDigitBits = 4;
constexpr int kMinItemsPerThread = 8192;  // below, starting threads costs more than it saves

struct Digit {
    uint32_t lowest_key;
    int shift;
    uint32_t mask;
    uint32_t of(const SortItem& item) const {
        return (item.depth_bits - lowest_key) >> shift & mask;
    }
};

// Turn counts[part][digit] into the first output position of that digit of that part.
void counts_to_starts(std::vector<uint32_t>& counts, int parts, uint32_t digits) {
    uint32_t next = 0;
    for (uint32_t digit = 0; digit < digits; ++digit) {
        for (int part = 0; part < parts; ++part) {
            uint32_t& count = counts[static_cast<size_t>(part) * digits + digit];
            next += std::exchange(count, next);
        }
    }
}

}  // namespace

void DepthSort::sort(ThreadPool& pool, AlignedBuffer<SortItem>& items, const Projected& all) {
    const int count = all.count;
    if (count < 2) return;
    uint32_t lowest, highest;
    std::memcpy(&lowest, &all.nearest, sizeof lowest);
    std::memcpy(&highest, &all.farthest, sizeof highest);
    const uint32_t range = highest - lowest;
    const int bits = range == 0 ? 1 : 32 - __builtin_clz(range);
    const int digit_bits = std::max(kMinDigitBits, (bits + kPasses - 1) / kPasses);
    const uint32_t digits = 1u << digit_bits;
    const int parts = std::clamp(count / kMinItemsPerThread, 1, pool.threads());
    other_.reserve(static_cast<size_t>(count));
    for (int pass = 0; pass < kPasses; ++pass) {
        const Digit digit{lowest, pass * digit_bits, digits - 1};
        const SortItem* from = items.data();
        SortItem* to = other_.data();
        starts_.assign(static_cast<size_t>(parts) * digits, 0);
        pool.run(parts, [&](int part) {
            uint32_t* counts = starts_.data() + static_cast<size_t>(part) * digits;
            const int end = share_begin(count, part + 1, parts);
            for (int i = share_begin(count, part, parts); i < end; ++i) ++counts[digit.of(from[i])];
        });
        counts_to_starts(starts_, parts, digits);
        pool.run(parts, [&](int part) {
            uint32_t* next = starts_.data() + static_cast<size_t>(part) * digits;
            const int end = share_begin(count, part + 1, parts);
            for (int i = share_begin(count, part, parts); i < end; ++i) {
                to[next[digit.of(from[i])]++] = from[i];
            }
        });
        swap(items, other_);
    }
}

}  // namespace rfcore::raster
