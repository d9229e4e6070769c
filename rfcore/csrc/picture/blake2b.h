// BLAKE2b (RFC 7693) of two messages of equal length at the same time, without a key.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace rfcore {

constexpr std::size_t kDigestBytes = 16;

// Bytes of a message; the pieces of one follow each other.
struct Piece {
    const std::uint8_t* bytes;
    std::size_t count;
};

// Writes BLAKE2b-128 of either message. One message is a chain in which each step waits for the
// last; two of them take little more time than one. Both must have as many bytes, at least one.
void blake2b_pair(const std::vector<Piece>& first, const std::vector<Piece>& second,
                  std::uint8_t digests[2][kDigestBytes]);

}  // namespace rfcore
