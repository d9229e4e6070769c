// Binds picture/blake2b.h. rfcore/native/yuv.py makes sure that both messages have the same size.
#include "picture/blake2b.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <utility>
#include <vector>

namespace nb = nanobind;

namespace rfcore {
namespace {

using InBytes = nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>;

std::vector<Piece> pieces_of(const nb::bytes& head, const std::vector<InBytes>& arrays) {
    std::vector<Piece> pieces{{static_cast<const std::uint8_t*>(head.data()), head.size()}};
    for (const InBytes& array : arrays) pieces.push_back({array.data(), array.size()});
    return pieces;
}

std::size_t total_of(const std::vector<Piece>& pieces) {
    std::size_t total = 0;
    for (const Piece& piece : pieces) total += piece.count;
    return total;
}

}  // namespace

void bind_blake2b(nb::module_& m) {
    m.def(
        "blake2b_pair",
        [](const nb::bytes& head, const std::vector<InBytes>& first,
           const std::vector<InBytes>& second) {
            const std::vector<Piece> one = pieces_of(head, first), other = pieces_of(head, second);
            if (total_of(one) != total_of(other) || total_of(one) == 0) {
                throw nb::value_error("two messages of the same length are expected");
            }
            std::uint8_t digests[2][kDigestBytes];
            {
                const nb::gil_scoped_release released;
                blake2b_pair(one, other, digests);
            }
            return std::make_pair(nb::bytes(digests[0], kDigestBytes),
                                  nb::bytes(digests[1], kDigestBytes));
        },
        nb::arg("head"), nb::arg("first"), nb::arg("second"));
}

}  // namespace rfcore
