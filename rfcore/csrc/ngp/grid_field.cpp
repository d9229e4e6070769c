#include "ngp/grid_field.h"

#include <cstring>

namespace rfcore::ngp {
namespace {

constexpr uint32_t kPrimes[3] = {1u, 2654435761u, 805459861u};  // Mueller et al. 2022, eq. 4

uint64_t vertices_of(const int32_t* cells) {
    uint64_t count = 1;
    for (int i = 0; i < 3; ++i) count *= static_cast<uint64_t>(cells[i]) + 1;
    return count;
}

bool is_dense(const int32_t* cells, uint32_t hashed_entries) {
    return vertices_of(cells) <= hashed_entries;
}

uint32_t entries_of(const int32_t* cells, uint32_t hashed_entries) {
    const uint64_t count = vertices_of(cells);
    if (count > hashed_entries) return hashed_entries;
    return static_cast<uint32_t>((count + kLanes - 1) / kLanes * kLanes);
}

Level level_of(const int32_t* cells, uint32_t hashed_entries, size_t first) {
    Level level{};
    level.dense = is_dense(cells, hashed_entries);
    level.first = first;
    level.entries = entries_of(cells, hashed_entries);
    level.mask = hashed_entries - 1;
    uint32_t stride = 1;
    for (int i = 0; i < 3; ++i) {
        level.cells[i] = static_cast<float>(cells[i]);
        level.factor[i] = level.dense ? stride : kPrimes[i];
        stride *= static_cast<uint32_t>(cells[i]) + 1;
    }
    return level;
}

template <class T>
void copy_into(AlignedBuffer<T>& to, const T* from, size_t count, size_t padding = 0) {
    to.reserve(count + padding);
    std::memcpy(to.data(), from, count * sizeof(T));
    std::memset(static_cast<void*>(to.data() + count), 0, padding * sizeof(T));
}

}  // namespace

size_t weight_count(int levels, int hidden) {
    size_t count = 0;
    for (int m = 0; m < kMatrices; ++m) {
        count += static_cast<size_t>(outputs_of(m, hidden)) *
                 inputs_of(m, hidden, encoded_inputs(levels));
    }
    return count;
}

size_t table_entries(int levels, const int32_t* level_cells, uint32_t hashed_entries) {
    size_t count = 0;
    for (int l = 0; l < levels; ++l) count += entries_of(level_cells + 3 * l, hashed_entries);
    return count;
}

GridField::GridField(const FieldArrays& a) {
    entries_ = table_entries(a.levels, a.level_cells, a.hashed_entries);
    weights_ = weight_count(a.levels, a.hidden);
    copy_into(table_, a.table, kFeatures * entries_);
    copy_into(matrices_, a.matrices, weights_, kLanes);
    copy_into(edges_, a.edges, static_cast<size_t>(a.steps) + 1, kEdgePad);

    cells_ = 1;
    for (int i = 0; i < 3; ++i) {
        field_.occupancy.cells[i] = static_cast<float>(a.occupancy_cells[i]);
        field_.occupancy.factor[i] = static_cast<uint32_t>(cells_);
        cells_ *= static_cast<size_t>(a.occupancy_cells[i]);
        field_.space.centre[i] = a.centre[i];
        field_.space.inverse_half[i] = 1.0f / a.half[i];
    }
    copy_into(occupancy_, a.occupancy, words());
    field_.occupancy.bits = occupancy_.data();
    field_.space.unbounded = a.unbounded;

    size_t first = 0;
    for (int l = 0; l < a.levels; ++l) {
        field_.level[l] = level_of(a.level_cells + 3 * l, a.hashed_entries, first);
        first += field_.level[l].entries;
    }
    field_.network.levels = a.levels;
    field_.network.hidden = a.hidden;
    field_.network.encoded = encoded_inputs(a.levels);
    const float* next = matrices_.data();
    for (int m = 0; m < kMatrices; ++m) {
        field_.network.matrices[m] = next;
        next += static_cast<size_t>(outputs_of(m, a.hidden)) *
                inputs_of(m, a.hidden, field_.network.encoded);
    }
    field_.table = table_.data();
    field_.edges = edges_.data();
    field_.steps = a.steps;
}

Renderer::Renderer(const FieldArrays& arrays, const Kernels& kernels, int threads)
    : kernels_(kernels), threads_(threads), field_(arrays) {}

uint64_t Renderer::render(const Camera& camera, int samples_per_ray, float* colour, float* depth,
                          float* opacity) {
    const int tiles = (camera.width + kTileSide - 1) / kTileSide *
                      ((camera.height + kTileSide - 1) / kTileSide);
    std::vector<uint64_t> samples(static_cast<size_t>(tiles));
    const RenderJob job{&field_.view(), &camera, samples_per_ray, colour,
                        depth,          opacity, samples.data()};
    auto* kernel = kernels_.render_tile[field_.view().space.unbounded];
    const auto pool = pools_.take([this] { return std::make_unique<ThreadPool>(threads_); });
    pool->run(tiles, [&](int tile) {
        thread_local AlignedBuffer<Chunk> chunks;
        chunks.reserve(kRenderChunks);
        kernel(job, tile, chunks.data());
    });
    uint64_t total = 0;
    for (const uint64_t count : samples) total += count;
    return total;
}

}  // namespace rfcore::ngp
