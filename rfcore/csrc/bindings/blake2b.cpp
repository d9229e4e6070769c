// Binds rfcore/csrc/blake2b.h for rfcore/native/digest.py.
#include "blake2b.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <vector>

namespace nb = nanobind;

namespace rfcore {
namespace {

using InBytes = nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>;
constexpr std::size_t kDigestBytes = 16;

}  // namespace

void bind_blake2b(nb::module_& m) {
    m.def(
        "blake2b_128",
        [](nb::bytes first, const std::vector<InBytes>& pieces) {
            std::uint8_t digest[kDigestBytes];
            {
                const auto* before = static_cast<const std::uint8_t*>(first.data());
                const std::size_t before_bytes = first.size();
                const nb::gil_scoped_release released;
                Blake2b hash(kDigestBytes);
                hash.update(before, before_bytes);
                for (const InBytes& piece : pieces) hash.update(piece.data(), piece.size());
                hash.finish(digest);
            }
            return nb::bytes(digest, sizeof digest);
        },
        nb::arg("first"), nb::arg("pieces"));
}

}  // namespace rfcore
