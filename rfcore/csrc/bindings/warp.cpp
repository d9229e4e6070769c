// Binds picture/warp.h and picture/light_grid.h. Shapes and dtypes are checked by
// rfcore/native/warp.py; the types below refuse anything else that nanobind can see.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <tuple>

#include "picture/light_grid.h"
#include "picture/warp.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using InPlane = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutPlane = nb::ndarray<std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using InDepth = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Picture = std::tuple<InPlane, InPlane, InPlane>;
using InLight = nb::ndarray<const std::int32_t, nb::ndim<4>, nb::c_contig, nb::device::cpu>;
using OutLight = nb::ndarray<std::int32_t, nb::ndim<4>, nb::c_contig, nb::device::cpu>;
using OutCosts = nb::ndarray<std::int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

template <typename Plane>
void require_shape(const Plane& plane, int height, int width) {
    if (plane.shape(0) != static_cast<std::size_t>(height) ||
        plane.shape(1) != static_cast<std::size_t>(width)) {
        throw nb::value_error("arrays do not fit the picture");
    }
}

template <typename Light>
void require_light(PictureSize size, const Light& light) {
    const auto cells = [](int px) { return static_cast<std::size_t>((px - 1) / kLightCellPx + 1); };
    if (light.shape(0) != cells(size.height_px) || light.shape(1) != cells(size.width_px) ||
        light.shape(2) != kLightBins || light.shape(3) != kLightPlanes) {
        throw nb::value_error("changes do not fit the picture");
    }
}

template <typename Plane>
void require_i420(PictureSize size, const Plane& y, const Plane& u, const Plane& v) {
    require_shape(y, size.height_px, size.width_px);
    require_shape(u, (size.height_px + 1) / 2, (size.width_px + 1) / 2);
    require_shape(v, (size.height_px + 1) / 2, (size.width_px + 1) / 2);
}

void require_picture(PictureSize size, const Picture& picture) {
    const auto& [y, u, v] = picture;
    require_i420(size, y, u, v);
}

ConstI420Planes planes_of(const Picture& picture) {
    const auto& [y, u, v] = picture;
    return {y.data(), u.data(), v.data()};
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
    m.def("warp_filter", [] {
        const std::size_t size_bytes = sizeof(std::int16_t) * kWarpSteps * kWarpLanes;
        return nb::bytes(warp_filter(), size_bytes);
    });
    m.def(
        "warp_i420",
        [](const Picture& previous, InDepth previous_depth, InDepth depth, const Picture& render,
           const std::optional<Picture>& previous_render, std::int32_t doubt, const std::vector<double>& numbers,
           OutPlane y, OutPlane u, OutPlane v, int threads) {
            if (threads < 1) throw nb::value_error("threads must be at least 1");
            const PictureSize size = size_of(y);
            require_i420(size, y, u, v);
            require_picture(size, previous);
            require_picture(size, render);
            if (previous_render) require_picture(size, *previous_render);
            require_shape(previous_depth, size.height_px, size.width_px);
            require_shape(depth, size.height_px, size.width_px);
            const WarpGeometry geometry = geometry_of(numbers);
            const WarpInputs in{planes_of(previous),
                                previous_depth.data(),
                                depth.data(),
                                planes_of(render),
                                previous_render ? planes_of(*previous_render) : ConstI420Planes{},
                                doubt};
            const nb::gil_scoped_release released;
            return warp_i420(in, geometry, size, {y.data(), u.data(), v.data()}, threads);
        },
        nb::arg("previous"), nb::arg("previous_depth"), nb::arg("depth"), nb::arg("render"),
        nb::arg("previous_render").none(), nb::arg("doubt"), nb::arg("numbers"), nb::arg("y"),
        nb::arg("u"), nb::arg("v"), nb::arg("threads"));
    m.def(
        "relight_i420",
        [](const Picture& seen, const Picture& seen_render, const Picture& render, OutPlane y,
           OutPlane u, OutPlane v) {
            const PictureSize size = size_of(y);
            require_i420(size, y, u, v);
            for (const Picture* picture : {&seen, &seen_render, &render}) {
                require_picture(size, *picture);
            }
            const nb::gil_scoped_release released;
            relight_i420(planes_of(seen), planes_of(seen_render), planes_of(render), size,
                         {y.data(), u.data(), v.data()});
        },
        nb::arg("seen"), nb::arg("seen_render"), nb::arg("render"), nb::arg("y"), nb::arg("u"),
        nb::arg("v"));
    m.def(
        "solve_light",
        [](const Picture& frame, const Picture& render, OutLight changes) {
            const PictureSize size = size_of(std::get<0>(frame));
            require_picture(size, frame);
            require_picture(size, render);
            require_light(size, changes);
            const nb::gil_scoped_release released;
            solve_light(planes_of(frame), planes_of(render), size, changes.data());
        },
        nb::arg("frame"), nb::arg("render"), nb::arg("changes"));
    m.def(
        "apply_light",
        [](InLight changes, const Picture& render, OutPlane y, OutPlane u, OutPlane v) {
            const PictureSize size = size_of(y);
            require_i420(size, y, u, v);
            require_picture(size, render);
            require_light(size, changes);
            const nb::gil_scoped_release released;
            apply_light(changes.data(), planes_of(render), size, {y.data(), u.data(), v.data()});
        },
        nb::arg("changes"), nb::arg("render"), nb::arg("y"), nb::arg("u"), nb::arg("v"));
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
