// Bindings of the rasterizer. Shapes and values are checked by rfcore/native/raster.py; here the
// types and contiguity are.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "raster/rasterizer.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using raster::Camera;
using raster::GaussianArrays;
using raster::Kernels;
using raster::Rasterizer;
using raster::Statistics;
using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using FloatsOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

const Kernels& kernels_or_best(const std::string& isa) {
    const Kernels* kernels =
        isa.empty() ? raster::available_kernels()[0] : raster::kernels_named(isa.c_str());
    if (kernels == nullptr) throw std::invalid_argument("no kernels named " + isa);
    return *kernels;
}

std::vector<std::string> available_isas() {
    std::vector<std::string> names;
    for (const Kernels* const* k = raster::available_kernels(); *k != nullptr; ++k) {
        names.emplace_back((*k)->isa);
    }
    return names;
}

GaussianArrays arrays_of(const Floats& means, const Floats& quaternions, const Floats& log_scales,
                         const Floats& opacity_logits, const Floats& sh) {
    const int coefficients = static_cast<int>(sh.shape(1));
    int degree = 0;
    while (raster::coefficients_of(degree) < coefficients) ++degree;
    return {means.data(), quaternions.data(), log_scales.data(), opacity_logits.data(), sh.data(),
            static_cast<int>(means.shape(0)), degree};
}

// `numbers`: rotation 9, translation 3, position 3, fx, fy, cx, cy.
Camera make_camera(const std::vector<double>& numbers, int width, int height) {
    if (numbers.size() != 19) throw std::invalid_argument("a camera is 19 numbers");
    float values[19];
    for (size_t i = 0; i < 19; ++i) values[i] = static_cast<float>(numbers[i]);
    Camera c{};
    for (int i = 0; i < 9; ++i) c.rotation[i] = values[i];
    for (int i = 0; i < 3; ++i) c.translation[i] = values[9 + i];
    for (int i = 0; i < 3; ++i) c.position[i] = values[12 + i];
    c.fx = values[15];
    c.fy = values[16];
    c.cx = values[17];
    c.cy = values[18];
    c.width = width;
    c.height = height;
    return c;
}


}  // namespace

void bind_raster(nb::module_& m) {
    using nb::literals::operator""_a;
    m.def("available_isas", &available_isas, "Instruction sets this machine can run, best first.");

    nb::class_<Camera>(m, "RasterCamera")
        .def("__init__", [](Camera* self, const std::vector<double>& numbers, int width,
                            int height) { new (self) Camera(make_camera(numbers, width, height)); },
             "numbers"_a, "width"_a, "height"_a);

    nb::class_<Rasterizer>(m, "Rasterizer")
        .def("__init__",
             [](Rasterizer* self, const Floats& means, const Floats& quaternions,
                const Floats& log_scales, const Floats& opacity_logits, const Floats& sh,
                int threads, const std::string& isa) {
                 const Kernels& kernels = kernels_or_best(isa);
                 const GaussianArrays arrays =
                     arrays_of(means, quaternions, log_scales, opacity_logits, sh);
                 const nb::gil_scoped_release release;
                 new (self) Rasterizer(arrays, kernels, threads);
             },
             "means"_a, "quaternions"_a, "log_scales"_a, "opacity_logits"_a, "sh"_a, "threads"_a,
             "isa"_a)
        .def_prop_ro("isa", [](const Rasterizer& self) { return self.kernels().isa; })
        .def("render",
             [](Rasterizer& self, const Camera& camera, const FloatsOut& colour,
                const FloatsOut& depth, const FloatsOut& opacity) {
                 const nb::gil_scoped_release release;
                 self.render(camera, colour.data(), depth.data(), opacity.data());
             },
             "camera"_a, "colour"_a, "depth"_a, "opacity"_a)
        .def("render_colour",
             [](Rasterizer& self, const Camera& camera, const FloatsOut& colour) {
                 const nb::gil_scoped_release release;
                 self.render(camera, colour.data(), nullptr, nullptr);
             },
             "camera"_a, "colour"_a)
        .def("statistics",
             [](Rasterizer& self, const Camera& camera) {
                 Statistics s{};
                 {
                     const nb::gil_scoped_release release;
                     s = self.statistics(camera);
                 }
                 return std::make_tuple(s.visible, s.tile_entries, s.tile_entries_visited,
                                        s.useful_blends, s.evaluated_blends);
             },
             "camera"_a);
}

}  // namespace rfcore
