#include "blake2b.h"

#include <algorithm>
#include <cstring>

#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define RFCORE_PER_ISA __attribute__((target_clones("avx2", "default")))
#else
#define RFCORE_PER_ISA
#endif

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "words are read from memory as they are");

namespace rfcore {
namespace {

constexpr std::uint64_t kIv[8] = {0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b,
                                  0xa54ff53a5f1d36f1, 0x510e527fade682d1, 0x9b05688c2b3e6c1f,
                                  0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};

// RFC 7693, section 2.7; rounds 10 and 11 begin again.
constexpr std::uint8_t kOrder[10][16] = {
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

// A row of the 4x4 words in the compilers' own notation for vectors (GCC, Clang).
using Row = std::uint64_t __attribute__((vector_size(32)));
#define RFCORE_INLINE inline __attribute__((always_inline))

RFCORE_INLINE void rotate_right(Row& x, int bits) { x = (x >> bits) | (x << (64 - bits)); }

// Moves each word `places` to the left in its row.
template <int places>
RFCORE_INLINE void turn(Row& x) {
    constexpr int p = places;
    const Row from = x;
    for (int i = 0; i < 4; ++i) x[i] = from[(i + p) % 4];
}

// G (section 3.1) on the four columns at once.
RFCORE_INLINE void mix(Row& a, Row& b, Row& c, Row& d, const Row& x, const Row& y) {
    a += x;
    a += b;
    d ^= a;
    rotate_right(d, 32);
    c += d;
    b ^= c;
    rotate_right(b, 24);
    a += y;
    a += b;
    d ^= a;
    rotate_right(d, 16);
    c += d;
    b ^= c;
    rotate_right(b, 63);
}

// For the diagonals rows a, c and d turn, because b is known last: it need not wait.
template <int n>
RFCORE_INLINE void round(Row& a, Row& b, Row& c, Row& d, const std::uint64_t* m) {
    constexpr const std::uint8_t* s = kOrder[n % 10];
    mix(a, b, c, d, Row{m[s[0]], m[s[2]], m[s[4]], m[s[6]]}, Row{m[s[1]], m[s[3]], m[s[5]], m[s[7]]});
    turn<3>(a);
    turn<2>(d);
    turn<1>(c);
    mix(a, b, c, d, Row{m[s[14]], m[s[8]], m[s[10]], m[s[12]]},
        Row{m[s[15]], m[s[9]], m[s[11]], m[s[13]]});
    turn<1>(a);
    turn<2>(d);
    turn<3>(c);
}

// `bytes`: those up to the end of the first block; of the last one alone when `last` is all ones.
RFCORE_PER_ISA
void compress_blocks(std::uint64_t* state, const std::uint8_t* blocks, std::size_t count,
                     std::uint64_t bytes, std::uint64_t last) {
    Row low, high;
    std::memcpy(&low, state, sizeof low);
    std::memcpy(&high, state + 4, sizeof high);
    for (std::size_t i = 0; i < count; ++i, blocks += 128, bytes += 128) {
        std::uint64_t m[16];
        std::memcpy(m, blocks, sizeof m);
        Row a = low, b = high, c{kIv[0], kIv[1], kIv[2], kIv[3]};
        Row d{kIv[4] ^ bytes, kIv[5], kIv[6] ^ last, kIv[7]};
        round<0>(a, b, c, d, m);
        round<1>(a, b, c, d, m);
        round<2>(a, b, c, d, m);
        round<3>(a, b, c, d, m);
        round<4>(a, b, c, d, m);
        round<5>(a, b, c, d, m);
        round<6>(a, b, c, d, m);
        round<7>(a, b, c, d, m);
        round<8>(a, b, c, d, m);
        round<9>(a, b, c, d, m);
        round<10>(a, b, c, d, m);
        round<11>(a, b, c, d, m);
        low ^= a ^ c;
        high ^= b ^ d;
    }
    std::memcpy(state, &low, sizeof low);
    std::memcpy(state + 4, &high, sizeof high);
}

}  // namespace

Blake2b::Blake2b(std::size_t digest_bytes) : digest_bytes_(digest_bytes) {
    std::copy_n(kIv, 8, state_);
    state_[0] ^= 0x01010000 ^ digest_bytes;
}

// The last block is told from the others, so one is held back until more comes.
void Blake2b::update(const std::uint8_t* data, std::size_t bytes) {
    if (rest_bytes_ + bytes > kBlock) {
        const std::size_t missing = kBlock - rest_bytes_;
        std::copy_n(data, missing, rest_ + rest_bytes_);
        compress(rest_, 1);
        const std::size_t blocks = (bytes - missing - 1) / kBlock;
        compress(data + missing, blocks);
        data += missing + blocks * kBlock;
        bytes -= missing + blocks * kBlock;
        rest_bytes_ = 0;
    }
    std::copy_n(data, bytes, rest_ + rest_bytes_);
    rest_bytes_ += bytes;
}

void Blake2b::compress(const std::uint8_t* blocks, std::size_t count) {
    compress_blocks(state_, blocks, count, before_ + kBlock, 0);
    before_ += count * kBlock;
}

void Blake2b::finish(std::uint8_t* digest) {
    std::fill(rest_ + rest_bytes_, rest_ + kBlock, std::uint8_t{0});
    compress_blocks(state_, rest_, 1, before_ + rest_bytes_, ~std::uint64_t{0});
    std::memcpy(digest, state_, digest_bytes_);
}

}  // namespace rfcore
