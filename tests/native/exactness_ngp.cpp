// Draws and trains one hash grid field and writes every byte that came of it, for
// test_aarch64_ngp.py to compare with the bytes of the machine that runs the tests.
//
// usage: exactness_ngp ISA THREADS SCENE RESULT
//
// SCENE: int32 levels, hidden, T, occupancy cells x, y, z, marching steps, unbounded, width, height,
// samples a ray when drawing, rays, rays a block, samples a ray when training, training steps; float
// centre[3], half[3], camera[16], rates[6], peak decay; then int32 level cells, uint32 occupancy,
// float edges, table, matrices, peaks, origins, directions, jitter, targets.
// RESULT: float colour, depth, opacity; double loss of every step; float table and matrices and
// uint32 occupancy after the last step.
#include <cstdlib>

#include "exactness_file.h"
#include "ngp/trainer.h"

namespace {

using namespace rfcore::ngp;

struct Sizes {
    int levels, hidden, hashed_entries, occupancy_cells[3], steps, unbounded;
    int width, height, samples_drawing, rays, rays_per_block, samples_training, training_steps;
};
struct Numbers {
    float centre[3], half[3], camera[16], rates[6], peak_decay;
};

struct Scene {
    Sizes sizes;
    Numbers numbers;
    std::vector<int32_t> level_cells;
    std::vector<uint32_t> occupancy;
    std::vector<float> edges, table, matrices, peaks, origins, directions, jitter, targets;

    FieldArrays arrays() const {
        FieldArrays a{};
        a.levels = sizes.levels;
        a.hidden = sizes.hidden;
        a.hashed_entries = static_cast<uint32_t>(sizes.hashed_entries);
        a.level_cells = level_cells.data();
        for (int i = 0; i < 3; ++i) {
            a.centre[i] = numbers.centre[i];
            a.half[i] = numbers.half[i];
            a.occupancy_cells[i] = sizes.occupancy_cells[i];
        }
        a.unbounded = sizes.unbounded != 0;
        a.occupancy = occupancy.data();
        a.edges = edges.data();
        a.steps = sizes.steps;
        a.table = table.data();
        a.matrices = matrices.data();
        return a;
    }
    Camera camera() const {
        Camera c{};
        const float* n = numbers.camera;
        for (int i = 0; i < 9; ++i) c.rotation[i] = n[i];
        for (int i = 0; i < 3; ++i) c.position[i] = n[9 + i];
        c.fx = n[12];
        c.fy = n[13];
        c.cx = n[14];
        c.cy = n[15];
        c.width = sizes.width;
        c.height = sizes.height;
        return c;
    }
};

Scene read_scene(const char* path) {
    File in(path, "rb");
    Scene s;
    s.sizes = in.read<Sizes>(1)[0];
    s.numbers = in.read<Numbers>(1)[0];
    const int* cells = s.sizes.occupancy_cells;
    const size_t cell_count = static_cast<size_t>(cells[0]) * cells[1] * cells[2];
    const auto rays = static_cast<size_t>(s.sizes.rays);
    s.level_cells = in.read<int32_t>(3 * static_cast<size_t>(s.sizes.levels));
    s.occupancy = in.read<uint32_t>((cell_count + 31) / 32);
    s.edges = in.read<float>(static_cast<size_t>(s.sizes.steps) + 1);
    s.table = in.read<float>(kFeatures * table_entries(s.sizes.levels, s.level_cells.data(),
                                                       static_cast<uint32_t>(s.sizes.hashed_entries)));
    s.matrices = in.read<float>(weight_count(s.sizes.levels, s.sizes.hidden));
    s.peaks = in.read<float>(cell_count);
    s.origins = in.read<float>(3 * rays);
    s.directions = in.read<float>(3 * rays);
    s.jitter = in.read<float>(rays);
    s.targets = in.read<float>(3 * rays);
    return s;
}

void draw(const Scene& scene, const Kernels& kernels, int threads, File& out) {
    const size_t pixels = static_cast<size_t>(scene.sizes.width) * scene.sizes.height;
    std::vector<float> colour(3 * pixels), depth(pixels), opacity(pixels);
    Renderer renderer(scene.arrays(), kernels, threads);
    renderer.render(scene.camera(), scene.sizes.samples_drawing, colour.data(), depth.data(),
                    opacity.data());
    for (const auto* plane : {&colour, &depth, &opacity}) out.write(*plane);
}

void train(const Scene& scene, const Kernels& kernels, int threads, File& out) {
    Trainer trainer(scene.arrays(), scene.peaks.data(), kernels, threads);
    const Sizes& sizes = scene.sizes;
    const Batch batch{scene.origins.data(), scene.directions.data(), scene.jitter.data(),
                      scene.targets.data(), sizes.rays,              sizes.rays_per_block,
                      sizes.samples_training};
    const float* r = scene.numbers.rates;
    const Rates rates{r[0], r[1], r[2], r[3], r[4], r[5]};
    std::vector<double> losses;
    for (int step = 0; step < sizes.training_steps; ++step) {
        losses.push_back(trainer.accumulate(batch) / (3.0 * sizes.rays));
        trainer.update(rates, scene.numbers.peak_decay);
        trainer.rebuild_occupancy(0.01f);
    }
    out.write(losses);
    GridField& field = trainer.field();
    out.write(field.table(), kFeatures * field.entries());
    out.write(field.matrices(), field.weights());
    out.write(field.occupancy(), field.words());
}

}  // namespace

int main(int argc, char** argv) {
    try {
        if (argc != 5) throw std::runtime_error("usage: exactness_ngp ISA THREADS SCENE RESULT");
        const Kernels& kernels = kernels_for(argv[1]);
        const Scene scene = read_scene(argv[3]);
        File out(argv[4], "wb");
        draw(scene, kernels, std::atoi(argv[2]), out);
        train(scene, kernels, std::atoi(argv[2]), out);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "exactness_ngp: %s\n", error.what());
        return 1;
    }
    return 0;
}
