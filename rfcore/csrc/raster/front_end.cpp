#include "raster/front_end.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>

namespace rfcore::raster {
namespace {

constexpr int kBlocksPerTask = 128;
constexpr int kItemsPerCall = 1024;
constexpr int kMinItemsPerPart = 2048;
constexpr uint64_t kMaxEntries = 1ull << 30;
constexpr int kReadableBehind = 64;  // the kernels prefetch past the end of a list

// Tiles and one more per row of tiles, where the counts of the last tile end.
size_t slots_of(const Camera& camera) {
    return (static_cast<size_t>(camera.tiles_x()) + 1) * camera.tiles_y();
}

}  // namespace

void FrontEnd::run(const Kernels& kernels, ThreadPool& pool, ProjectJob job, int blocks,
                   bool keep_positions) {
    splats_.reserve(static_cast<size_t>(blocks) * kLanes);
    job.splats = splats_.data();
    project(kernels, pool, job, blocks);
    sort_.sort(pool, items_, visible_);

    const Camera& camera = *job.camera;
    const int parts = std::clamp(visible_ / kMinItemsPerPart, 1, pool.threads());
    spans_.resize(std::max(spans_.size(), static_cast<size_t>(parts)));
    part_entries_.assign(static_cast<size_t>(parts), 0);
    tile_next_.reserve(slots_of(camera) * static_cast<size_t>(parts));
    pool.run(parts, [&](int part) { find_spans(kernels, camera, part, parts); });
    count_to_offsets(camera, parts);
    if (keep_positions) {
        const size_t count = static_cast<size_t>(blocks) * kLanes;
        positions_.reserve(size_t{entry_count_} + kReadableBehind);
        std::memset(positions_.data() + entry_count_, 0, kReadableBehind * sizeof(uint32_t));
        ranges_.reserve(count);
        std::memset(ranges_.data(), 0xff, count * sizeof(EntryRange));  // kNotVisible
    }
    pool.run(parts, [&](int part) { scatter(camera, part, parts, keep_positions); });
}

void FrontEnd::project(const Kernels& kernels, ThreadPool& pool, const ProjectJob& job, int blocks) {
    projected_.reserve(static_cast<size_t>(blocks) * kLanes);
    items_.reserve(static_cast<size_t>(blocks) * kLanes);
    const auto kernel = kernels.project[job.parameters != nullptr][job.antialiased][job.degree];
    const int tasks = (blocks + kBlocksPerTask - 1) / kBlocksPerTask;
    std::vector<int> counts(static_cast<size_t>(tasks));
    pool.run(tasks, [&](int task) {
        const int begin = task * kBlocksPerTask, end = std::min(blocks, begin + kBlocksPerTask);
        counts[static_cast<size_t>(task)] =
            kernel(job, begin, end, projected_.data() + static_cast<size_t>(begin) * kLanes);
    });
    visible_ = 0;
    for (int task = 0; task < tasks; ++task) {
        const SortItem* from = projected_.data() + static_cast<size_t>(task) * kBlocksPerTask * kLanes;
        const int count = counts[static_cast<size_t>(task)];
        std::memcpy(items_.data() + visible_, from, static_cast<size_t>(count) * sizeof(SortItem));
        visible_ += count;
    }
}

void FrontEnd::find_spans(const Kernels& kernels, const Camera& camera, int part, int parts) {
    const size_t slots = slots_of(camera);
    const SpanJob job{&camera, splats_.data(),
                      tile_next_.data() + static_cast<size_t>(part) * slots};
    std::memset(job.tile_steps, 0, slots * sizeof(uint32_t));
    std::vector<uint32_t>& words = spans_[static_cast<size_t>(part)];
    const size_t most = static_cast<size_t>(kItemsPerCall) * (1 + camera.tiles_y());
    size_t used = 0;
    const int end = share_begin(visible_, part + 1, parts);
    for (int i = share_begin(visible_, part, parts); i < end; i += kItemsPerCall) {
        if (words.size() < used + most) words.resize(2 * words.size() + most);
        const int count = std::min(kItemsPerCall, end - i);
        used += kernels.find_spans(job, items_.data() + i, count, words.data() + used);
    }
}

// Turn the steps of each part into counts, and those into the position of its first entry.
void FrontEnd::count_to_offsets(const Camera& camera, int parts) {
    const size_t tiles = static_cast<size_t>(camera.tiles_x()) * camera.tiles_y();
    tile_offsets_.reserve(tiles + 1);
    const size_t slots = slots_of(camera);
    const int tiles_x = camera.tiles_x();
    std::vector<uint32_t> counts(static_cast<size_t>(parts));
    uint64_t next = 0;
    for (int row = 0; row < camera.tiles_y(); ++row) {
        std::fill(counts.begin(), counts.end(), 0);
        for (int column = 0; column < tiles_x; ++column) {
            const size_t slot = static_cast<size_t>(row) * (tiles_x + 1) + column;
            tile_offsets_[static_cast<size_t>(row) * tiles_x + column] =
                static_cast<uint32_t>(next);
            for (size_t part = 0; part < counts.size(); ++part) {
                uint32_t& step = tile_next_[part * slots + slot];
                counts[part] += std::exchange(step, static_cast<uint32_t>(next));
                part_entries_[part] += counts[part];
                next += counts[part];
            }
        }
        if (next > kMaxEntries) {
            throw std::length_error("more than " + std::to_string(kMaxEntries) +
                                    " overlaps of Gaussians and 16x16 tiles; the Gaussians are too "
                                    "large or too many for this picture size");
        }
    }
    entry_count_ = static_cast<uint32_t>(next);
    tile_offsets_[tiles] = entry_count_;
    entries_.reserve(next + kReadableBehind);
    std::memset(entries_.data() + next, 0, kReadableBehind * sizeof(uint32_t));
}

void FrontEnd::scatter(const Camera& camera, int part, int parts, bool keep_positions) {
    const size_t stride = static_cast<size_t>(camera.tiles_x()) + 1;
    uint32_t* next = tile_next_.data() + static_cast<size_t>(part) * slots_of(camera);
    const uint32_t* word = spans_[static_cast<size_t>(part)].data();
    uint32_t position = 0;
    for (int p = 0; p < part; ++p) position += part_entries_[static_cast<size_t>(p)];
    const int end = share_begin(visible_, part + 1, parts);
    for (int i = share_begin(visible_, part, parts); i < end; ++i) {
        const uint32_t id = items_[static_cast<size_t>(i)].id;
        const uint32_t first_position = position;
        for (uint32_t left = *word++; left != 0; --left) {
            const uint32_t span = *word++;
            uint32_t* row = next + span_row(span) * stride;
            for (uint32_t x = span_first(span); x <= span_last(span); ++x) {
                const uint32_t at = row[x]++;
                entries_[at] = id;
                if (keep_positions) positions_[position++] = at;
            }
        }
        if (keep_positions) ranges_[id] = {first_position, position};
    }
}

}  // namespace rfcore::raster
