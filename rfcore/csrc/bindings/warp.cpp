// Binds rfcore/csrc/warp.h. Shapes and dtypes are checked by rfcore/native/warp.py; the types below
// refuse anything else that nanobind can see.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include "warp.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using InPlane = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutPlane = nb::ndarray<std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using InDepth = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutCosts = nb::ndarray<std::int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

template <typename Plane>
void require_shape(const Plane& plane, int height, int width) {
    if (plane.shape(0) != static_cast<std::size_t>(height) ||
        plane.shape(1) != static_cast<std::size_t>(width)) {
        throw nb::value_error("arrays do not fit the picture");
    }
}

template <typename Plane>
void require_i420(PictureSize size, const Plane& y, const Plane& u, const Plane& v) {
    require_shape(y, size.height_px, size.width_px);
    require_shape(u, (size.height_px + 1) / 2, (size.width_px + 1) / 2);
    require_shape(v, (size.height_px + 1) / 2, (size.width_px + 1) / 2);
}

// `numbers`: rotation 9, translation 3, fx, fy, cx, cy.
WarpGeometry geometry_of(const std::vector<double>& numbers) {
    if (numbers.size() != 16) throw nb::value_error("a warp is 16 numbers");
    WarpGeometry g{};
    for (int i = 0; i < 9; ++i) g.rotation[i] = static_cast<float>(numbers[i]);
    for (int i = 0; i < 3; ++i) g.translation[i] = static_cast<float>(numbers[9 + i]);
    g.fx = static_cast<float>(numbers[12]);
    g.fy = static_cast<float>(numbers[13]);
    g.cx = static_cast<float>(numbers[14]);
    g.cy = static_cast<float>(numbers[15]);
    return g;
}

template <typename Plane>
PictureSize size_of(const Plane& plane) {
    return {static_cast<int>(plane.shape(1)), static_cast<int>(plane.shape(0))};
}

}  // namespace

void bind_warp(nb::module_& m) {
    m.def(
        "warp_i420",
        [](InPlane previous_y, InPlane previous_u, InPlane previous_v, InDepth previous_depth,
           InDepth depth, InPlane render_y, InPlane render_u, InPlane render_v,
           const std::vector<double>& numbers, OutPlane y, OutPlane u, OutPlane v) {
            const PictureSize size = size_of(y);
            require_i420(size, previous_y, previous_u, previous_v);
            require_i420(size, render_y, render_u, render_v);
            require_i420(size, y, u, v);
            require_shape(previous_depth, size.height_px, size.width_px);
            require_shape(depth, size.height_px, size.width_px);
            const WarpGeometry geometry = geometry_of(numbers);
            const WarpInputs in{{previous_y.data(), previous_u.data(), previous_v.data()},
                                previous_depth.data(),
                                depth.data(),
                                {render_y.data(), render_u.data(), render_v.data()}};
            const nb::gil_scoped_release released;
            return warp_i420(in, geometry, size, {y.data(), u.data(), v.data()});
        },
        nb::arg("previous_y"), nb::arg("previous_u"), nb::arg("previous_v"),
        nb::arg("previous_depth"), nb::arg("depth"), nb::arg("render_y"), nb::arg("render_u"),
        nb::arg("render_v"), nb::arg("numbers"), nb::arg("y"), nb::arg("u"), nb::arg("v"));
    m.def(
        "block_costs",
        [](InPlane frame, InPlane reference, OutCosts satd, OutCosts ssd) {
            const PictureSize size = size_of(frame);
            require_shape(reference, size.height_px, size.width_px);
            require_shape(satd, size.height_px / 8, size.width_px / 8);
            require_shape(ssd, size.height_px / 8, size.width_px / 8);
            const nb::gil_scoped_release released;
            block_costs(frame.data(), reference.data(), size, satd.data(), ssd.data());
        },
        nb::arg("frame"), nb::arg("reference"), nb::arg("satd"), nb::arg("ssd"));
}

}  // namespace rfcore
