// Binds picture/pcm.h. Shapes and dtypes are checked by rfcore/codec/h264/splice.py; the
// types below refuse anything else that nanobind can see.
#include "picture/pcm.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace nb = nanobind;

namespace rfcore {
namespace {

using InPlane = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutBytes = nb::ndarray<std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

bool fits(const InPlane& plane, int height, int width) {
    return plane.shape(0) == static_cast<std::size_t>(height) &&
           plane.shape(1) == static_cast<std::size_t>(width);
}

}  // namespace

void bind_pcm(nb::module_& m) {
    m.def(
        "pcm_macroblocks",
        [](InPlane y, InPlane u, InPlane v, OutBytes out) {
            const PictureSize size{static_cast<int>(y.shape(1)), static_cast<int>(y.shape(0))};
            const int half_height = (size.height_px + 1) / 2, half_width = (size.width_px + 1) / 2;
            if (size.width_px < 1 || size.height_px < 1 || !fits(u, half_height, half_width) ||
                !fits(v, half_height, half_width) || out.shape(0) != pcm_bytes(size)) {
                throw nb::value_error("arrays do not fit the picture");
            }
            const nb::gil_scoped_release released;
            pcm_macroblocks({y.data(), u.data(), v.data()}, size, out.data());
        },
        nb::arg("y"), nb::arg("u"), nb::arg("v"), nb::arg("out"));
}

}  // namespace rfcore
