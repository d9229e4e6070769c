// Bindings of the rasterizer. Shapes and values are checked by rfcore/native/raster.py; here the
// types and contiguity are.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "raster/camera.h"
#include "raster/rasterizer.h"
#include "raster/trainable.h"
#include "simd/isa.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using raster::Camera;
using raster::GaussianArrays;
using raster::LearningRates;
using raster::Rasterizer;
using raster::Statistics;
using raster::TrainableRasterizer;
using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using DoublesOut = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using FloatsOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

std::vector<std::string> isa_names() {
    std::vector<std::string> names;
    for (const char* const* name = available_isas(); *name != nullptr; ++name) {
        names.emplace_back(*name);
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

Camera camera_of(const std::vector<double>& numbers, int width, int height) {
    if (numbers.size() != raster::kCameraNumbers) {
        throw std::invalid_argument("a camera is 16 numbers");
    }
    return raster::make_camera(numbers.data(), width, height);
}


void bind_rasterizer(nb::module_& m) {
    using nb::literals::operator""_a;
    m.def("available_isas", &isa_names, "Instruction sets this machine can run, best first.");

    nb::class_<Camera>(m, "RasterCamera")
        .def("__init__", [](Camera* self, const std::vector<double>& numbers, int width,
                            int height) { new (self) Camera(camera_of(numbers, width, height)); },
             "numbers"_a, "width"_a, "height"_a);

    nb::class_<Rasterizer>(m, "Rasterizer")
        .def("__init__",
             [](Rasterizer* self, const Floats& means, const Floats& quaternions,
                const Floats& log_scales, const Floats& opacity_logits, const Floats& sh,
                int threads, const std::string& isa, bool antialiased) {
                 const raster::Kernels& kernels = raster::kernels_for(isa.c_str());
                 const GaussianArrays arrays =
                     arrays_of(means, quaternions, log_scales, opacity_logits, sh);
                 const nb::gil_scoped_release release;
                 new (self) Rasterizer(arrays, kernels, threads, antialiased);
             },
             "means"_a, "quaternions"_a, "log_scales"_a, "opacity_logits"_a, "sh"_a, "threads"_a,
             "isa"_a, "antialiased"_a)
        .def_prop_ro("isa", [](const Rasterizer& self) { return self.kernels().isa; })
        .def("with_threads",
             [](const Rasterizer& self, int threads) {
                 return std::make_unique<Rasterizer>(self, threads);
             },
             "threads"_a)
        .def("render",
             [](Rasterizer& self, const Camera& camera, int degree, const FloatsOut& colour,
                const FloatsOut& depth, const FloatsOut& opacity) {
                 const nb::gil_scoped_release release;
                 self.render(camera, degree, colour.data(), depth.data(), opacity.data());
             },
             "camera"_a, "degree"_a, "colour"_a, "depth"_a, "opacity"_a)
        .def("render_colour",
             [](Rasterizer& self, const Camera& camera, int degree, const FloatsOut& colour) {
                 const nb::gil_scoped_release release;
                 self.render(camera, degree, colour.data(), nullptr, nullptr);
             },
             "camera"_a, "degree"_a, "colour"_a)
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

// The five parameter arrays as writable floats, for results in the same layout.
GaussianArrays writable_arrays_of(const TrainableRasterizer& self, const FloatsOut& means,
                                  const FloatsOut& quaternions, const FloatsOut& log_scales,
                                  const FloatsOut& opacity_logits, const FloatsOut& sh) {
    return {means.data(), quaternions.data(), log_scales.data(), opacity_logits.data(), sh.data(),
            self.count(), self.degree()};
}

GaussianArrays writable_arrays_of(const TrainableRasterizer& self,
                                  const std::vector<FloatsOut>& arrays) {
    if (arrays.size() != 5) throw std::invalid_argument("five arrays");
    return writable_arrays_of(self, arrays[0], arrays[1], arrays[2], arrays[3], arrays[4]);
}

GaussianArrays arrays_of(const std::vector<Floats>& arrays) {
    if (arrays.size() != 5) throw std::invalid_argument("five arrays");
    return arrays_of(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4]);
}

using Trainable = nb::class_<TrainableRasterizer>;

// Density control, and what a checkpoint keeps.
void bind_density(Trainable& trainable) {
    using nb::literals::operator""_a;
    trainable.def_prop_ro("count", &TrainableRasterizer::count)
        .def("keep_scores", &TrainableRasterizer::keep_scores, "keep"_a)
        .def("control_density",
             [](TrainableRasterizer& self, float dead_logit, int added, bool by_gradient,
                bool in_place, uint64_t seed) {
                 const raster::DensityPlan plan{
                     dead_logit, added,
                     by_gradient ? raster::SourceRule::kGradient : raster::SourceRule::kOpacity,
                     in_place ? raster::SplitRule::kInPlace : raster::SplitRule::kLongAxis, seed};
                 const nb::gil_scoped_release release;
                 return self.control_density(plan);
             },
             "dead_logit"_a, "added"_a, "by_gradient"_a, "in_place"_a, "seed"_a)
        .def("perturb", &TrainableRasterizer::perturb, "strength"_a, "seed"_a,
             nb::call_guard<nb::gil_scoped_release>())
        .def("remove_dead", &TrainableRasterizer::remove_dead, "dead_logit"_a,
             nb::call_guard<nb::gil_scoped_release>())
        .def("order_along_curve", &TrainableRasterizer::order_along_curve,
             nb::call_guard<nb::gil_scoped_release>())
        .def("moments",
             [](const TrainableRasterizer& self, const std::vector<FloatsOut>& first,
                const std::vector<FloatsOut>& second, const DoublesOut& beta_powers) {
                 const GaussianArrays a = writable_arrays_of(self, first), b =
                     writable_arrays_of(self, second);
                 const nb::gil_scoped_release release;
                 self.moments(a, b, beta_powers.data());
             },
             "first"_a, "second"_a, "beta_powers"_a)
        .def("set_moments",
             [](TrainableRasterizer& self, const std::vector<Floats>& first,
                const std::vector<Floats>& second, const std::vector<double>& beta_powers) {
                 if (beta_powers.size() != 2) throw std::invalid_argument("two powers of beta");
                 const GaussianArrays a = arrays_of(first), b = arrays_of(second);
                 const nb::gil_scoped_release release;
                 self.set_moments(a, b, beta_powers.data());
             },
             "first"_a, "second"_a, "beta_powers"_a)
        .def("scores",
             [](const TrainableRasterizer& self, const FloatsOut& out) {
                 const nb::gil_scoped_release release;
                 self.scores(out.data());
             },
             "out"_a)
        .def("set_scores",
             [](TrainableRasterizer& self, const Floats& scores) {
                 const nb::gil_scoped_release release;
                 self.set_scores(scores.data());
             },
             "scores"_a);
}

void bind_trainable(nb::module_& m) {
    using nb::literals::operator""_a;
    Trainable trainable(m, "TrainableRasterizer");
    bind_density(trainable);
    trainable
        .def("__init__",
             [](TrainableRasterizer* self, const Floats& means, const Floats& quaternions,
                const Floats& log_scales, const Floats& opacity_logits, const Floats& sh,
                int threads, const std::string& isa, bool antialiased) {
                 const raster::Kernels& kernels = raster::kernels_for(isa.c_str());
                 const GaussianArrays arrays =
                     arrays_of(means, quaternions, log_scales, opacity_logits, sh);
                 const nb::gil_scoped_release release;
                 new (self) TrainableRasterizer(arrays, kernels, threads, antialiased);
             },
             "means"_a, "quaternions"_a, "log_scales"_a, "opacity_logits"_a, "sh"_a, "threads"_a,
             "isa"_a, "antialiased"_a)
        .def("forward",
             [](TrainableRasterizer& self, const Camera& camera, int degree,
                const FloatsOut& colour, const FloatsOut& depth, const FloatsOut& opacity) {
                 const nb::gil_scoped_release release;
                 self.forward(camera, degree, colour.data(), depth.data(), opacity.data());
             },
             "camera"_a, "degree"_a, "colour"_a, "depth"_a, "opacity"_a)
        .def("forward_colour",
             [](TrainableRasterizer& self, const Camera& camera, int degree,
                const FloatsOut& colour) {
                 const nb::gil_scoped_release release;
                 self.forward(camera, degree, colour.data(), nullptr, nullptr);
             },
             "camera"_a, "degree"_a, "colour"_a)
        .def("loss",
             [](TrainableRasterizer& self, const Floats& colour, const Floats& target,
                float dssim_weight) {
                 const nb::gil_scoped_release release;
                 return self.loss(colour.data(), target.data(), dssim_weight);
             },
             "colour"_a, "target"_a, "dssim_weight"_a)
        .def("exposed_loss",
             [](TrainableRasterizer& self, const Floats& colour, const Floats& target,
                float dssim_weight, const Floats& affine, const DoublesOut& d_affine) {
                 const nb::gil_scoped_release release;
                 return self.exposed_loss(colour.data(), target.data(), dssim_weight,
                                          affine.data(), d_affine.data());
             },
             "colour"_a, "target"_a, "dssim_weight"_a, "affine"_a, "d_affine"_a)
        .def("set_colour_gradient",
             [](TrainableRasterizer& self, const Floats& d_colour) {
                 const nb::gil_scoped_release release;
                 self.set_colour_gradient(d_colour.data());
             },
             "d_colour"_a)
        .def("backward",
             [](TrainableRasterizer& self, const Floats& colour) {
                 const nb::gil_scoped_release release;
                 self.backward(colour.data());
             },
             "colour"_a)
        .def("adam_step",
             [](TrainableRasterizer& self, const std::vector<float>& rates) {
                 if (rates.size() != 11) throw std::invalid_argument("rates are 11 numbers");
                 const LearningRates r{rates[0], rates[1], rates[2], rates[3], rates[4], rates[5],
                                       rates[6], rates[7], rates[8], rates[9], rates[10]};
                 const nb::gil_scoped_release release;
                 self.adam_step(r);
             },
             "rates"_a)
        .def("gradients",
             [](TrainableRasterizer& self, const FloatsOut& means, const FloatsOut& quaternions,
                const FloatsOut& log_scales, const FloatsOut& opacity_logits,
                const FloatsOut& sh) {
                 const GaussianArrays out = writable_arrays_of(self, means, quaternions,
                                                               log_scales, opacity_logits, sh);
                 const nb::gil_scoped_release release;
                 self.gradients(out);
             },
             "means"_a, "quaternions"_a, "log_scales"_a, "opacity_logits"_a, "sh"_a)
        .def("parameters",
             [](const TrainableRasterizer& self, const FloatsOut& means,
                const FloatsOut& quaternions, const FloatsOut& log_scales,
                const FloatsOut& opacity_logits, const FloatsOut& sh) {
                 const GaussianArrays out = writable_arrays_of(self, means, quaternions,
                                                               log_scales, opacity_logits, sh);
                 const nb::gil_scoped_release release;
                 self.parameters(out);
             },
             "means"_a, "quaternions"_a, "log_scales"_a, "opacity_logits"_a, "sh"_a);
}

}  // namespace

void bind_raster(nb::module_& m) {
    bind_rasterizer(m);
    bind_trainable(m);
}

}  // namespace rfcore
