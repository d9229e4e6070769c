// BLAKE2b (RFC 7693) without a key, over several pieces of memory as if they were one.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rfcore {

class Blake2b {
public:
    // digest_bytes: 1..64.
    explicit Blake2b(std::size_t digest_bytes);
    void update(const std::uint8_t* data, std::size_t bytes);
    // Writes digest_bytes; nothing may follow.
    void finish(std::uint8_t* digest);

private:
    static constexpr std::size_t kBlock = 128;
    void compress(const std::uint8_t* blocks, std::size_t count);

    std::size_t digest_bytes_;
    std::uint64_t state_[8];
    std::uint64_t before_ = 0;  // bytes in the blocks that were compressed
    std::uint8_t rest_[kBlock];
    std::size_t rest_bytes_ = 0;
};

}  // namespace rfcore
