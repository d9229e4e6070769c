#include "raster/front_end.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>

namespace rfcore::raster {
namespace {

constexpr int kBlocksPerTask = 128;
constexpr int kMinItemsPerPart = 2048;
constexpr uint64_t kMaxEntries = 1ull << 28;
constexpr int kReadableBehind = 64;  // the kernels read past the end of a list

// The groups, with those beyond them that a footprint in the lower right corner may reach.
size_t slots_of(const Camera& camera) {
    return static_cast<size_t>(camera.groups()) + static_cast<size_t>(camera.groups_x()) + 2;
}

// Append the entries of a footprint of up to four groups; return how many.
int place_window(const Footprint& f, uint32_t splat, uint32_t groups_x, uint32_t* counts,
                 GroupEntry* out) {
    const uint32_t first = f.row * groups_x + f.column;
    const uint32_t groups[4] = {first, first + 1, first + groups_x, first + groups_x + 1};
    const uint32_t tiles[4] = {f.upper & kLeftTiles, f.upper >> 4 & kLeftTiles,
                               f.lower & kLeftTiles, f.lower >> 4 & kLeftTiles};
    int count = 0;
    for (int i = 0; i < 4; ++i) {
        out[count] = {groups[i], splat, tiles[i]};
        counts[groups[i]] += tiles[i] != 0;
        count += tiles[i] != 0;
    }
    return count;
}

}  // namespace

void FrontEnd::run(const Kernels& kernels, ThreadPool& pool, ProjectJob job, int blocks,
                   bool keep_positions) {
    const size_t most = static_cast<size_t>(blocks) * kLanes;
    splats_.reserve(most);
    footprints_.reserve(most);
    projected_.reserve(most);
    items_.reserve(most);
    block_splats_.reserve(static_cast<size_t>(blocks));
    job.splats = splats_.data();
    job.footprints = footprints_.data();
    job.items = projected_.data();
    job.block_splats = block_splats_.data();
    project(kernels, pool, job, blocks);
    sort_.sort(pool, items_, all_);

    const Camera& camera = *job.camera;
    const int parts = std::clamp(all_.count / kMinItemsPerPart, 1, pool.threads());
    placed_.resize(std::max(placed_.size(), static_cast<size_t>(parts)));
    part_entries_.assign(static_cast<size_t>(parts), 0);
    next_.reserve(slots_of(camera) * static_cast<size_t>(parts));
    pool.run(parts, [&](int part) { place(kernels, camera, part, parts); });
    count_to_offsets(camera, parts);
    if (!keep_positions) {
        pool.run(parts, [&](int part) { scatter(camera, part); });
        return;
    }
    positions_.reserve(size_t{entry_count_} + kReadableBehind);
    ranges_.reserve(most);
    std::memset(ranges_.data(), 0, most * sizeof(EntryRange));
    pool.run(parts, [&](int part) { scatter_with_positions(camera, part); });
}

void FrontEnd::project(const Kernels& kernels, ThreadPool& pool, const ProjectJob& job,
                       int blocks) {
    const auto kernel = kernels.project[job.parameters != nullptr][job.antialiased][job.degree];
    const int tasks = (blocks + kBlocksPerTask - 1) / kBlocksPerTask;
    std::vector<Projected> parts(static_cast<size_t>(tasks));
    pool.run(tasks, [&](int task) {
        const int begin = task * kBlocksPerTask;
        parts[static_cast<size_t>(task)] =
            kernel(job, begin, std::min(blocks, begin + kBlocksPerTask));
    });
    all_ = {};
    for (size_t task = 0; task < parts.size(); ++task) {
        const Projected& part = parts[task];
        if (part.count == 0) continue;
        const SortItem* from = projected_.data() + task * kBlocksPerTask * kLanes;
        std::memcpy(items_.data() + all_.count, from,
                    static_cast<size_t>(part.count) * sizeof(SortItem));
        all_.nearest = all_.count == 0 ? part.nearest : std::min(all_.nearest, part.nearest);
        all_.farthest = std::max(all_.farthest, part.farthest);
        all_.count += part.count;
    }
}

// List the entries of a part of the items and count them per group.
void FrontEnd::place(const Kernels& kernels, const Camera& camera, int part, int parts) {
    constexpr int kAhead = 16;  // items; hides the latency of a random read
    const size_t most = static_cast<size_t>(camera.groups()) + 4;
    const auto groups_x = static_cast<uint32_t>(camera.groups_x());
    uint32_t* counts = next_.data() + static_cast<size_t>(part) * slots_of(camera);
    std::memset(counts, 0, slots_of(camera) * sizeof(uint32_t));
    std::vector<GroupEntry>& placed = placed_[static_cast<size_t>(part)];
    size_t used = 0;
    const int end = share_begin(all_.count, part + 1, parts);
    for (int i = share_begin(all_.count, part, parts); i < end; ++i) {
        if (placed.size() < used + most) placed.resize(2 * placed.size() + most);
        __builtin_prefetch(&footprints_[items_[std::min(i + 2 * kAhead, end - 1)].splat]);
        const uint32_t ahead = items_[std::min(i + kAhead, end - 1)].splat;
        if (footprints_[ahead].column == kLargeFootprint) __builtin_prefetch(&splats_[ahead]);
        const uint32_t splat = items_[i].splat;
        const Footprint& footprint = footprints_[splat];
        GroupEntry* out = placed.data() + used;
        if (footprint.column != kLargeFootprint) {
            used += place_window(footprint, splat, groups_x, counts, out);
            continue;
        }
        const int count = kernels.place_large(camera, splats_.data(), splat, out);
        for (int k = 0; k < count; ++k) ++counts[out[k].group];
        used += count;
        if (used > kMaxEntries) break;  // count_to_offsets refuses
    }
    part_entries_[static_cast<size_t>(part)] = static_cast<uint32_t>(used);
}

// Turn the counts of each part into the position of its first entry in every group.
void FrontEnd::count_to_offsets(const Camera& camera, int parts) {
    const size_t groups = static_cast<size_t>(camera.groups()), slots = slots_of(camera);
    uint64_t total = 0;
    for (const uint32_t count : part_entries_) total += count;
    if (total > kMaxEntries) {
        throw std::length_error("more than " + std::to_string(kMaxEntries) +
                                " overlaps of Gaussians and 64x64 pixels; the Gaussians are too "
                                "large or too many for this picture size");
    }
    offsets_.reserve(groups + 1);
    uint32_t next = 0;
    for (size_t group = 0; group < groups; ++group) {
        offsets_[group] = next;
        for (size_t part = 0; part < static_cast<size_t>(parts); ++part) {
            next += std::exchange(next_[part * slots + group], next);
        }
    }
    offsets_[groups] = entry_count_ = next;
    entry_splats_.reserve(size_t{next} + kReadableBehind);
    entry_tiles_.reserve(size_t{next} + kReadableBehind);
    std::memset(entry_tiles_.data() + next, 0, kReadableBehind * sizeof(uint32_t));
}

void FrontEnd::scatter(const Camera& camera, int part) {
    uint32_t* next = next_.data() + static_cast<size_t>(part) * slots_of(camera);
    const GroupEntry* placed = placed_[static_cast<size_t>(part)].data();
    const GroupEntry* const end = placed + part_entries_[static_cast<size_t>(part)];
    for (; placed != end; ++placed) {
        const uint32_t at = next[placed->group]++;
        entry_splats_[at] = placed->splat;
        entry_tiles_[at] = placed->tiles;
    }
}

void FrontEnd::scatter_with_positions(const Camera& camera, int part) {
    uint32_t* next = next_.data() + static_cast<size_t>(part) * slots_of(camera);
    const std::vector<GroupEntry>& placed = placed_[static_cast<size_t>(part)];
    uint32_t position = 0;
    for (int p = 0; p < part; ++p) position += part_entries_[static_cast<size_t>(p)];
    const uint32_t count = part_entries_[static_cast<size_t>(part)];
    for (uint32_t k = 0; k < count; ++k, ++position) {
        const GroupEntry& entry = placed[k];
        const uint32_t at = next[entry.group]++;
        entry_splats_[at] = entry.splat;
        entry_tiles_[at] = entry.tiles;
        positions_[position] = at;
        EntryRange& range = ranges_[entry.splat];
        if (k == 0 || placed[k - 1].splat != entry.splat) range.begin = position;
        range.end = position + 1;
    }
}

uint32_t FrontEnd::tile_entry_count() const {
    uint32_t count = 0;
    for (uint32_t i = 0; i < entry_count_; ++i) {
        count += static_cast<uint32_t>(__builtin_popcount(entry_tiles_[i]));
    }
    return count;
}

}  // namespace rfcore::raster
