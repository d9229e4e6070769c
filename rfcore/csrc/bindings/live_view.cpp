// Binds picture/live_view.h and picture/patch.h. Values are checked by rfcore/native/live_view.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "picture/live_view.h"
#include "picture/patch.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using InRgb = nb::ndarray<const std::uint8_t, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using OutRgb = nb::ndarray<std::uint8_t, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using InColour = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using OutColour = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using InSamples = nb::ndarray<const float, nb::shape<-1, -1, 4>, nb::c_contig, nb::device::cpu>;
using InPlane = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutPlane = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutBytes = nb::ndarray<std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
// Difference, depth, and 19 numbers: rotation 9, translation 3, fx, fy, cx, cy, weight, fade, owner.
using Source = std::tuple<InColour, InPlane, std::vector<float>>;

template <typename Array>
PictureSize size_of(const Array& array) {
    return {static_cast<int>(array.shape(1)), static_cast<int>(array.shape(0))};
}

template <typename Array>
void require_size(const Array& array, PictureSize size) {
    const PictureSize own = size_of(array);
    if (own.width_px != size.width_px || own.height_px != size.height_px) {
        throw nb::value_error("arrays do not fit the picture");
    }
}

void require_count(const std::vector<float>& numbers, std::size_t count) {
    if (numbers.size() != count) throw nb::value_error("a list of numbers has the wrong length");
}

PinholeCamera camera_of(const float* numbers) { return {numbers[0], numbers[1], numbers[2], numbers[3]}; }

LiveSource source_of(const Source& from) {
    const auto& [difference, depth, numbers] = from;
    require_count(numbers, 19);
    require_size(depth, size_of(difference));
    LiveSource source{difference.data(), depth.data(), size_of(difference), camera_of(&numbers[12]), {}, {},
                      numbers[16], numbers[17], static_cast<int>(numbers[18])};
    std::copy_n(numbers.begin(), 9, source.rotation);
    std::copy_n(numbers.begin() + 9, 3, source.translation);
    return source;
}

// 20 numbers: rotation 9, translation 3, fx, fy, cx, cy, left, top, depth, fade.
Patch patch_of(const InSamples& samples, const std::vector<float>& numbers) {
    require_count(numbers, 20);
    Patch patch{samples.data(), size_of(samples), camera_of(&numbers[12]), {}, {},
                numbers[16],    numbers[17],      numbers[18],             numbers[19]};
    std::copy_n(numbers.begin(), 9, patch.rotation);
    std::copy_n(numbers.begin() + 9, 3, patch.translation);
    return patch;
}

Box box_of(const std::vector<int>& box, PictureSize size) {
    if (box.size() != 4 || box[0] < 0 || box[1] > size.height_px || box[2] < 0 || box[3] > size.width_px) {
        throw nb::value_error("a box is outside of the picture");
    }
    return {box[0], box[1], box[2], box[3]};
}

}  // namespace

void bind_live_view(nb::module_& m) {
    m.def(
        "live_difference",
        [](InRgb picture, InColour colour, InPlane opacity, const std::vector<float>& light,
           const std::vector<float>& limits, OutColour difference, OutPlane share) {
            const PictureSize size = size_of(picture);
            require_size(colour, size);
            require_size(opacity, size);
            require_size(difference, size);
            require_size(share, size);
            require_count(light, 6);
            require_count(limits, 3);
            const Light fitted{{light[0], light[1], light[2]}, {light[3], light[4], light[5]}};
            const nb::gil_scoped_release released;
            live_difference(picture.data(), colour.data(), opacity.data(), size, fitted,
                            {limits[0], limits[1], limits[2]}, difference.data(), share.data());
        },
        nb::arg("picture"), nb::arg("colour"), nb::arg("opacity"), nb::arg("light"), nb::arg("limits"),
        nb::arg("difference"), nb::arg("share"));
    m.def(
        "carry_to_view",
        [](InColour colour, InPlane opacity, InPlane depth, const std::vector<float>& camera,
           const std::vector<Source>& from, const std::vector<float>& limits, OutRgb rgb, OutBytes chosen) {
            const PictureSize size = size_of(colour);
            require_size(opacity, size);
            require_size(depth, size);
            require_size(rgb, size);
            require_size(chosen, size);
            require_count(camera, 4);
            require_count(limits, 7);
            if (from.size() > kMostSources) throw nb::value_error("too many sources");
            std::vector<LiveSource> sources;
            for (const Source& source : from) sources.push_back(source_of(source));
            const FieldPicture view{colour.data(), opacity.data(), depth.data(), size, camera_of(camera.data())};
            const VouchLimits vouch{limits[0], limits[1], limits[2], limits[3], limits[4], limits[5], limits[6]};
            const nb::gil_scoped_release released;
            carry_to_view(view, sources.data(), static_cast<int>(sources.size()), vouch, rgb.data(), chosen.data());
        },
        nb::arg("colour"), nb::arg("opacity"), nb::arg("depth"), nb::arg("camera"), nb::arg("sources"),
        nb::arg("limits"), nb::arg("rgb"), nb::arg("chosen"));
    m.def(
        "draw_patch",
        [](InSamples samples, const std::vector<float>& numbers, std::uint8_t source,
           const std::vector<float>& limits, const std::vector<int>& box, const std::vector<float>& camera,
           OutRgb rgb, OutPlane depth, OutBytes chosen, OutPlane nearest) {
            const PictureSize size = size_of(rgb);
            require_size(depth, size);
            require_size(chosen, size);
            require_size(nearest, size);
            require_count(limits, 2);
            require_count(camera, 4);
            const Canvas canvas{rgb.data(),     depth.data(), chosen.data(),
                                nearest.data(), size,         camera_of(camera.data())};
            draw_patch(patch_of(samples, numbers), source, limits[0], limits[1], box_of(box, size), canvas);
        },
        nb::arg("samples"), nb::arg("numbers"), nb::arg("source"), nb::arg("limits"), nb::arg("box"),
        nb::arg("camera"), nb::arg("rgb"), nb::arg("depth"), nb::arg("chosen"), nb::arg("nearest"));
}

}  // namespace rfcore
