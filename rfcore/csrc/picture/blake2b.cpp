#include "picture/blake2b.h"

#include <algorithm>
#include <cstring>

// Integers only: every instruction set gives the same bytes.
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define RFCORE_PER_ISA __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define RFCORE_PER_ISA
#endif

namespace rfcore {
namespace {

constexpr std::size_t kBlockBytes = 128;
constexpr int kWords = 16, kRounds = 12;

// The same word of the first message and of the second; and four of those.
using Pair = std::uint64_t __attribute__((vector_size(16)));
using Pairs = std::uint64_t __attribute__((vector_size(64)));

// The constants of RFC 7693, sections 2.6 and 2.7.
constexpr std::uint64_t kInitial[8] = {
    0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1,
    0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};
constexpr std::uint8_t kSchedule[10][kWords] = {
    {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
    {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
    {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
    {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
    {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
    {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
    {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
    {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
    {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
    {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0}};

// Reads a message block by block, the last one filled up with zeros.
class Reader {
public:
    explicit Reader(const std::vector<Piece>& pieces) : pieces_(pieces) {}

    void read(std::uint8_t* block) {
        std::size_t filled = 0;
        while (filled < kBlockBytes && piece_ < pieces_.size()) {
            const Piece& piece = pieces_[piece_];
            const std::size_t count = std::min(kBlockBytes - filled, piece.count - at_);
            std::memcpy(block + filled, piece.bytes + at_, count);
            filled += count;
            at_ += count;
            if (at_ == piece.count) ++piece_, at_ = 0;
        }
        std::memset(block + filled, 0, kBlockBytes - filled);
    }

private:
    const std::vector<Piece>& pieces_;
    std::size_t piece_ = 0, at_ = 0;
};

// Puts the words of two blocks side by side.
RFCORE_PER_ISA
void interleave(const std::uint8_t* first, const std::uint8_t* second, Pair m[kWords]) {
    for (int n = 0; n < kWords; n += 2) {
        Pair a, b;
        std::memcpy(&a, first + 8 * n, sizeof a);
        std::memcpy(&b, second + 8 * n, sizeof b);
        m[n] = __builtin_shufflevector(a, b, 0, 2);
        m[n + 1] = __builtin_shufflevector(a, b, 1, 3);
    }
}

inline void side_by_side(const Pair& p, const Pair& q, const Pair& r, const Pair& t, Pairs* out) {
    *out = __builtin_shufflevector(__builtin_shufflevector(p, q, 0, 1, 2, 3),
                                   __builtin_shufflevector(r, t, 0, 1, 2, 3), 0, 1, 2, 3, 4, 5, 6, 7);
}

// Compresses one block of each message into the states h (3.2). `counted`: bytes up to its end.
RFCORE_PER_ISA
void compress(const Pair m[kWords], std::uint64_t counted, bool last, Pairs h[2]) {
    const std::uint64_t all = last ? ~std::uint64_t{0} : 0;
    const std::uint64_t* i = kInitial;
    Pairs a = h[0], b = h[1];
    Pairs c = {i[0], i[0], i[1], i[1], i[2], i[2], i[3], i[3]};
    Pairs d = {i[4] ^ counted, i[4] ^ counted, i[5], i[5], i[6] ^ all, i[6] ^ all, i[7], i[7]};
#pragma GCC unroll 12
    for (int round = 0; round < kRounds; ++round) {
        const std::uint8_t* s = kSchedule[round % 10];
#pragma GCC unroll 2
        for (int half = 0; half < 2; ++half, s += 8) {
            // The diagonals are numbered by where a is, one place to the left of b.
            const int p = half == 0 ? 0 : 6, q = half == 0 ? 2 : 0, r = half == 0 ? 4 : 2;
            const int t = half == 0 ? 6 : 4;
            Pairs x, y;
            side_by_side(m[s[p]], m[s[q]], m[s[r]], m[s[t]], &x);
            side_by_side(m[s[p + 1]], m[s[q + 1]], m[s[r + 1]], m[s[t + 1]], &y);
            a += x + b;
            d ^= a;
            d = d >> 32 | d << 32;
            c += d;
            b ^= c;
            b = b >> 24 | b << 40;
            a += y + b;
            d ^= a;
            d = d >> 16 | d << 48;
            c += d;
            b ^= c;
            b = b >> 63 | b << 1;
            // From columns to diagonals and back; b stays in place, as the next step waits for it.
            const Pairs left_a = __builtin_shufflevector(a, a, 2, 3, 4, 5, 6, 7, 0, 1);
            const Pairs right_a = __builtin_shufflevector(a, a, 6, 7, 0, 1, 2, 3, 4, 5);
            const Pairs left_c = __builtin_shufflevector(c, c, 2, 3, 4, 5, 6, 7, 0, 1);
            const Pairs right_c = __builtin_shufflevector(c, c, 6, 7, 0, 1, 2, 3, 4, 5);
            a = half == 0 ? right_a : left_a;
            c = half == 0 ? left_c : right_c;
            d = __builtin_shufflevector(d, d, 4, 5, 6, 7, 0, 1, 2, 3);
        }
    }
    h[0] ^= a ^ c;
    h[1] ^= b ^ d;
}

}  // namespace

void blake2b_pair(const std::vector<Piece>& first, const std::vector<Piece>& second,
                  std::uint8_t digests[2][kDigestBytes]) {
    std::size_t total = 0;
    for (const Piece& piece : first) total += piece.count;
    const std::uint64_t* i = kInitial;
    const std::uint64_t parameters = 0x01010000 ^ kDigestBytes;
    Pairs h[2] = {{i[0] ^ parameters, i[0] ^ parameters, i[1], i[1], i[2], i[2], i[3], i[3]},
                  {i[4], i[4], i[5], i[5], i[6], i[6], i[7], i[7]}};
    Reader readers[2] = {Reader(first), Reader(second)};
    for (std::size_t begin = 0; begin < total; begin += kBlockBytes) {
        std::uint8_t blocks[2][kBlockBytes];
        Pair m[kWords];
        for (int n = 0; n < 2; ++n) readers[n].read(blocks[n]);
        interleave(blocks[0], blocks[1], m);
        const std::size_t end = std::min(total, begin + kBlockBytes);
        compress(m, end, end == total, h);
    }
    for (int n = 0; n < 2; ++n) {
        const std::uint64_t words[2] = {h[0][n], h[0][2 + n]};
        std::memcpy(digests[n], words, kDigestBytes);
    }
}

}  // namespace rfcore
