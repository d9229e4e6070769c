// Bindings of the hash grid. Shapes and values are checked by rfcore/ngp/native.py; here the types
// and contiguity are.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "ngp/trainer.h"

namespace nb = nanobind;

namespace rfcore {
namespace {

using ngp::FieldArrays;
using ngp::Renderer;
using ngp::Trainer;
using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using FloatsOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Words = nb::ndarray<const uint32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using WordsOut = nb::ndarray<uint32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using LevelCells = nb::ndarray<const int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

// `box`: centre 3, half sides 3, 1 if unbounded. `grid`: hidden units, T, occupancy cells 3.
FieldArrays arrays_of(const std::vector<double>& box, const std::vector<int>& grid,
                      const LevelCells& level_cells, const Words& occupancy, const Floats& edges,
                      const Floats& table, const Floats& matrices) {
    if (box.size() != 7 || grid.size() != 5) throw std::invalid_argument("a field is 7 + 5 numbers");
    FieldArrays a{};
    a.levels = static_cast<int>(level_cells.shape(0));
    a.hidden = grid[0];
    a.hashed_entries = static_cast<uint32_t>(grid[1]);
    a.level_cells = level_cells.data();
    for (size_t i = 0; i < 3; ++i) {
        a.centre[i] = static_cast<float>(box[i]);
        a.half[i] = static_cast<float>(box[3 + i]);
        a.occupancy_cells[i] = grid[2 + i];
    }
    a.unbounded = box[6] != 0.0;
    a.occupancy = occupancy.data();
    a.edges = edges.data();
    a.steps = static_cast<int>(edges.shape(0)) - 1;
    a.table = table.data();
    a.matrices = matrices.data();
    return a;
}

// `numbers`: rotation 9 (world_from_cam), position 3, fx, fy, cx, cy.
ngp::Camera make_camera(const std::vector<double>& numbers, int width, int height) {
    if (numbers.size() != 16) throw std::invalid_argument("a camera is 16 numbers");
    ngp::Camera c{};
    for (size_t i = 0; i < 9; ++i) c.rotation[i] = static_cast<float>(numbers[i]);
    for (size_t i = 0; i < 3; ++i) c.position[i] = static_cast<float>(numbers[9 + i]);
    c.fx = static_cast<float>(numbers[12]);
    c.fy = static_cast<float>(numbers[13]);
    c.cx = static_cast<float>(numbers[14]);
    c.cy = static_cast<float>(numbers[15]);
    c.width = width;
    c.height = height;
    return c;
}

void bind_renderer(nb::module_& m) {
    using nb::literals::operator""_a;
    nb::class_<ngp::Camera>(m, "NgpCamera")
        .def("__init__",
             [](ngp::Camera* self, const std::vector<double>& numbers, int width, int height) {
                 new (self) ngp::Camera(make_camera(numbers, width, height));
             },
             "numbers"_a, "width"_a, "height"_a);
    m.def("ngp_table_entries",
          [](const LevelCells& cells, int hashed_entries) {
              return ngp::table_entries(static_cast<int>(cells.shape(0)), cells.data(),
                                        static_cast<uint32_t>(hashed_entries));
          },
          "level_cells"_a, "hashed_entries"_a);

    nb::class_<Renderer>(m, "NgpRenderer")
        .def("__init__",
             [](Renderer* self, const std::vector<double>& box, const std::vector<int>& grid,
                const LevelCells& level_cells, const Words& occupancy, const Floats& edges,
                const Floats& table, const Floats& matrices, int threads,
                const std::string& isa) {
                 new (self) Renderer(
                     arrays_of(box, grid, level_cells, occupancy, edges, table, matrices),
                     ngp::kernels_for(isa.c_str()), threads);
             },
             "box"_a, "grid"_a, "level_cells"_a, "occupancy"_a, "edges"_a, "table"_a, "matrices"_a,
             "threads"_a, "isa"_a)
        .def_prop_ro("isa", [](const Renderer& self) { return self.kernels().isa; })
        .def("render",
             [](Renderer& self, const ngp::Camera& camera, int samples_per_ray,
                const FloatsOut& colour, const FloatsOut& depth, const FloatsOut& opacity) {
                 const nb::gil_scoped_release release;
                 return self.render(camera, samples_per_ray, colour.data(), depth.data(),
                                    opacity.data());
             },
             "camera"_a, "samples_per_ray"_a, "colour"_a, "depth"_a, "opacity"_a)
        .def("render_colour",
             [](Renderer& self, const ngp::Camera& camera, int samples_per_ray,
                const FloatsOut& colour) {
                 const nb::gil_scoped_release release;
                 return self.render(camera, samples_per_ray, colour.data(), nullptr, nullptr);
             },
             "camera"_a, "samples_per_ray"_a, "colour"_a);
}

// The arrays of a trainer by number: table, matrices, then first and second moments of the table
// and of the matrices, then the peaks of the cells.
struct Span {
    float* data;
    size_t count;
};
Span array_of(Trainer& trainer, int which) {
    const size_t table = ngp::kFeatures * trainer.field().entries();
    const size_t weights = trainer.field().weights();
    switch (which) {
        case 0: return {trainer.field().table(), table};
        case 1: return {trainer.field().matrices(), weights};
        case 2: return {trainer.moments(0), table};
        case 3: return {trainer.moments(1), table};
        case 4: return {trainer.moments(2), weights};
        case 5: return {trainer.moments(3), weights};
        case 6: return {trainer.peaks(), trainer.field().cells()};
        default: throw std::invalid_argument("a trainer has arrays 0..6");
    }
}
void require_size(size_t got, size_t wanted) {
    if (got != wanted) throw std::invalid_argument("the array has another size");
}

void bind_trainer(nb::module_& m) {
    using nb::literals::operator""_a;
    nb::class_<Trainer>(m, "NgpTrainer")
        .def("__init__",
             [](Trainer* self, const std::vector<double>& box, const std::vector<int>& grid,
                const LevelCells& level_cells, const Words& occupancy, const Floats& edges,
                const Floats& table, const Floats& matrices, const Floats& peaks, int threads,
                const std::string& isa) {
                 new (self) Trainer(
                     arrays_of(box, grid, level_cells, occupancy, edges, table, matrices),
                     peaks.data(), ngp::kernels_for(isa.c_str()), threads);
             },
             "box"_a, "grid"_a, "level_cells"_a, "occupancy"_a, "edges"_a, "table"_a, "matrices"_a,
             "peaks"_a, "threads"_a, "isa"_a)
        .def("accumulate",
             [](Trainer& self, const Floats& origins, const Floats& directions,
                const Floats& jitter, const Floats& targets, int rays_per_block,
                int samples_per_ray) {
                 const ngp::Batch batch{origins.data(),  directions.data(),
                                        jitter.data(),   targets.data(),
                                        static_cast<int>(jitter.shape(0)),
                                        rays_per_block,  samples_per_ray};
                 const nb::gil_scoped_release release;
                 return self.accumulate(batch);
             },
             "origins"_a, "directions"_a, "jitter"_a, "targets"_a, "rays_per_block"_a,
             "samples_per_ray"_a)
        .def("update",
             [](Trainer& self, const std::vector<float>& rates, float peak_decay) {
                 if (rates.size() != 6) throw std::invalid_argument("rates are 6 numbers");
                 const ngp::Rates r{rates[0], rates[1], rates[2], rates[3], rates[4], rates[5]};
                 const nb::gil_scoped_release release;
                 self.update(r, peak_decay);
             },
             "rates"_a, "peak_decay"_a)
        .def("gradients",
             [](Trainer& self, const FloatsOut& table, const FloatsOut& matrices) {
                 const nb::gil_scoped_release release;
                 self.gradients(table.data(), matrices.data());
             },
             "table"_a, "matrices"_a)
        .def("rebuild_occupancy",
             [](Trainer& self, float threshold) {
                 const nb::gil_scoped_release release;
                 return self.rebuild_occupancy(threshold);
             },
             "threshold"_a)
        .def_prop_ro("samples", [](const Trainer& self) { return self.samples(); })
        .def_prop_ro("steps", [](const Trainer& self) { return self.steps(); })
        .def("set_steps", &Trainer::set_steps, "steps"_a)
        .def("read",
             [](Trainer& self, int which, const FloatsOut& out) {
                 const Span span = array_of(self, which);
                 require_size(out.size(), span.count);
                 std::memcpy(out.data(), span.data, span.count * sizeof(float));
             },
             "which"_a, "out"_a)
        .def("write",
             [](Trainer& self, int which, const Floats& values) {
                 const Span span = array_of(self, which);
                 require_size(values.size(), span.count);
                 std::memcpy(span.data, values.data(), span.count * sizeof(float));
             },
             "which"_a, "values"_a)
        .def("read_occupancy",
             [](Trainer& self, const WordsOut& out) {
                 require_size(out.size(), self.field().words());
                 std::memcpy(out.data(), self.field().occupancy(), 4 * self.field().words());
             },
             "out"_a)
        .def("write_occupancy",
             [](Trainer& self, const Words& words) {
                 require_size(words.size(), self.field().words());
                 std::memcpy(self.field().occupancy(), words.data(), 4 * self.field().words());
             },
             "words"_a);
}

}  // namespace

void bind_ngp(nb::module_& m) {
    bind_renderer(m);
    bind_trainer(m);
}

}  // namespace rfcore
