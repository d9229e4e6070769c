// Binds picture/yuv.h. Shapes and dtypes are checked by rfcore/native/yuv.py; the types below
// refuse anything else that nanobind can see.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "picture/yuv.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using InPlane = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutPlane = nb::ndarray<std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using InRgb = nb::ndarray<const std::uint8_t, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using OutRgb = nb::ndarray<std::uint8_t, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using InColour = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;

template <typename Y, typename C>
void require_i420(PictureSize size, const Y& y, const C& u, const C& v) {
    const auto fits = [](const auto& plane, int height, int width) {
        return plane.shape(0) == static_cast<std::size_t>(height) &&
               plane.shape(1) == static_cast<std::size_t>(width);
    };
    const int half_height = (size.height_px + 1) / 2, half_width = (size.width_px + 1) / 2;
    if (!fits(y, size.height_px, size.width_px) || !fits(u, half_height, half_width) ||
        !fits(v, half_height, half_width)) {
        throw nb::value_error("planes do not fit the picture");
    }
}

template <typename Picture>
PictureSize size_of(const Picture& picture) {
    return {static_cast<int>(picture.shape(1)), static_cast<int>(picture.shape(0))};
}

}  // namespace

void bind_yuv(nb::module_& m) {
    m.def(
        "i420_from_rgb",
        [](InRgb rgb, OutPlane y, OutPlane u, OutPlane v) {
            const PictureSize size = size_of(rgb);
            require_i420(size, y, u, v);
            const nb::gil_scoped_release released;
            i420_from_rgb(rgb.data(), size, {y.data(), u.data(), v.data()});
        },
        nb::arg("rgb"), nb::arg("y"), nb::arg("u"), nb::arg("v"));
    m.def(
        "i420_from_colour",
        [](InColour colour, OutPlane y, OutPlane u, OutPlane v) {
            const PictureSize size = size_of(colour);
            require_i420(size, y, u, v);
            const nb::gil_scoped_release released;
            return i420_from_colour(colour.data(), size, {y.data(), u.data(), v.data()});
        },
        nb::arg("colour"), nb::arg("y"), nb::arg("u"), nb::arg("v"));
    m.def(
        "rgb_from_i420",
        [](InPlane y, InPlane u, InPlane v, OutRgb rgb) {
            const PictureSize size = size_of(rgb);
            require_i420(size, y, u, v);
            const nb::gil_scoped_release released;
            rgb_from_i420({y.data(), u.data(), v.data()}, size, rgb.data());
        },
        nb::arg("y"), nb::arg("u"), nb::arg("v"), nb::arg("rgb"));
}

}  // namespace rfcore
