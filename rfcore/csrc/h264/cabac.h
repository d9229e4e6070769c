// Context-adaptive binary arithmetic coding (ITU-T H.264, 9.3): a writer, and a counter of bits.
//
// Both take the same calls, so the one syntax of a macroblock (syntax.h) writes it or measures it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "h264/cabac_tables.h"

namespace {

// pStateIdx in the upper bits, valMPS in bit 0.
struct Contexts {
    uint8_t state[kContexts];
};

// The states a slice starts with (9.3.1.1). `p_slice`: cabac_init_idc is 0.
inline void init_contexts(Contexts& contexts, bool p_slice, int qp) {
    for (int i = 0; i < kContexts; ++i) {
        const int8_t* mn = kContextInit[i][p_slice];
        int pre = ((mn[0] * qp) >> 4) + mn[1];
        pre = pre < 1 ? 1 : pre > 126 ? 126 : pre;
        contexts.state[i] = pre <= 63 ? static_cast<uint8_t>((63 - pre) << 1)
                                      : static_cast<uint8_t>(((pre - 64) << 1) | 1);
    }
}

constexpr uint8_t after_symbol(int packed, bool likely) {
    const int state = packed >> 1;
    if (likely) return static_cast<uint8_t>(packed + (state < 62 ? 2 : 0));
    const int mps = (packed & 1) ^ (state == 0);
    return static_cast<uint8_t>((kNextLps[state] << 1) | mps);
}

// The state after one, by the state and whether the symbol was the less likely one.
struct NextStates {
    uint8_t of[128][2];
};

constexpr NextStates make_next_states() {
    NextStates next{};
    for (int packed = 0; packed < 128; ++packed) {
        next.of[packed][0] = after_symbol(packed, true);
        next.of[packed][1] = after_symbol(packed, false);
    }
    return next;
}

constexpr NextStates kNextStates = make_next_states();

// Writes the bytes of slice_data; the caller has room for them (checked between macroblocks).
class CabacWriter {
public:
    CabacWriter(Contexts& contexts, uint8_t* out) : contexts_(contexts), begin_(out), next_(out) {}

    void bin(int context, int value) {
        uint8_t& packed = contexts_.state[context];
        const uint32_t less = kRangeLps[packed >> 1][(range_ >> 6) & 3];
        const uint32_t rest = range_ - less;
        const int unlikely = value ^ (packed & 1);
        low_ += unlikely ? rest : 0;
        range_ = unlikely ? less : rest;
        packed = kNextStates.of[packed][unlikely];
        renormalise();
    }

    void bypass(int value) {
        low_ <<= 1;
        if (value) low_ += range_;
        shifted(1);
    }

    void bypass_bits(uint32_t value, int count) {
        while (count-- > 0) bypass((value >> count) & 1);
    }

    // end_of_slice_flag and the I_PCM bin (9.3.1.2); after a 1 only `finish` may follow.
    void terminate(int value) {
        range_ -= 2;
        if (value) {
            low_ += range_;
            range_ = 2;
        }
        renormalise();
    }

    // Clause 9.3.4.5: the last bit written is rbsp_stop_one_bit. Returns the number of bytes.
    size_t finish() {
        low_ = ((low_ >> 7) | 1) << 10;
        shifted(3);
        if (queued_ > 0) {
            low_ <<= 8 - queued_;
            shifted(8 - queued_);
        }
        return static_cast<size_t>(next_ - begin_);
    }

    // What follows the I_PCM bin (7.3.5): alignment, the samples, then the coder starts anew with
    // the contexts as they are (9.3.1.2).
    void samples(const uint8_t* luma, const uint8_t* chroma) {
        finish();
        std::memcpy(next_, luma, 256);
        std::memcpy(next_ + 256, chroma, 128);
        next_ += 384;
        low_ = 0;
        range_ = 510;
        queued_ = -1;
    }

    size_t size() const { return static_cast<size_t>(next_ - begin_); }
    size_t bits() const { return 8 * size() + static_cast<size_t>(queued_ + 1); }

private:
    void renormalise() {
        const int shift = __builtin_clz(range_) - 23;  // until range >= 256
        range_ <<= shift;
        low_ <<= shift;
        shifted(shift);
    }

    // Bits above the ten of codILow are final but for a carry; whole bytes of them go out.
    void shifted(int bits) {
        queued_ += bits;
        while (queued_ >= 8) {
            queued_ -= 8;
            const uint64_t byte = low_ >> (10 + queued_);
            low_ &= (uint64_t{1} << (10 + queued_)) - 1;
            if (byte > 0xFF) {
                for (uint8_t* p = next_ - 1; ++*p == 0; --p) {
                }
            }
            *next_++ = static_cast<uint8_t>(byte);
        }
    }

    Contexts& contexts_;
    uint8_t* begin_;
    uint8_t* next_;
    uint64_t low_ = 0;
    uint32_t range_ = 510;
    int queued_ = -1;  // the first bit is always 0 and is not written (firstBitFlag)
};

// Follows the states of the contexts alone.
class ContextTracker {
public:
    explicit ContextTracker(Contexts& contexts) : contexts_(contexts) {}

    void bin(int context, int value) {
        uint8_t& packed = contexts_.state[context];
        packed = kNextStates.of[packed][value ^ (packed & 1)];
    }
    void bypass(int) {}
    void bypass_bits(uint32_t, int) {}
    void terminate(int) {}

private:
    Contexts& contexts_;
};

// Adds up what the same calls would cost, in 1/256 bits, with contexts that stay as they are.
// Levels count nothing: their bits are known since they were chosen (quantise.h).
class CabacCounter {
public:
    explicit CabacCounter(const Contexts& contexts) : contexts_(contexts) {}

    void bin(int context, int value) { cost_ += kSymbolCost[contexts_.state[context] ^ value]; }
    void bypass(int) { cost_ += 256; }
    void bypass_bits(uint32_t, int count) { cost_ += static_cast<uint32_t>(256 * count); }
    void terminate(int) {}

    uint32_t cost() const { return cost_; }

private:
    const Contexts& contexts_;
    uint32_t cost_ = 0;
};

}  // namespace
