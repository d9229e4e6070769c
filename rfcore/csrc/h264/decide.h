// How a macroblock is coded: candidates by prediction, the least J = D + lambda R of them.
#pragma once

#include "h264/motion.h"

namespace {

// The picture's own samples around the macroblock, and room for its blocks while they are coded
// one after the other: row 0 above, column 7 left, from column 8 on the macroblock and 8 more.
struct Canvas {
    static constexpr ptrdiff_t kStride = 40;
    alignas(32) uint8_t sample[17 * 40];
    uint8_t* at(int x, int y) { return sample + kStride * (y + 1) + 8 + x; }
};

// Partitions are not tried where 16x16 is predicted this well, in bits: they would cost as much.
constexpr uint32_t kWholeBits = 100;
// Above this difference, in bits, something is surely left to code, so that no test for an empty
// residual is made.
constexpr uint32_t kSkipBits = 100;

// What the plainest intra macroblock takes, in bits. Where inter prediction costs less, it is not
// tried. Trying it wherever prediction leaves nothing to code, but errors, saves 1 to 1.8 % of the
// bits, in rain 8 %, and takes 15 % more instructions.
constexpr uint32_t kIntraBits = 8;

// What an I_PCM macroblock takes in 1/256 bits: samples, type, alignment and the coder's new start.
constexpr uint32_t kPcmBits = 256 * (8 * 384 + 16);
// Added to the cost of a candidate of another mode than the forced one.
constexpr Cost kForbidden = Cost{1} << 56;

// Cost of a vector in a reference that was left out.
constexpr uint32_t kNotSearched = UINT32_MAX;

class MacroblockCoder {
public:
    MacroblockCoder(const SliceJob& job, const Contexts& contexts)
        : job_(job), contexts_(contexts) {
        for (int r = 0; r < job.reference_count; ++r) planes_[r].begin(job.references[r]);
    }

    // Decides on macroblock (mx, my); the result is valid until the next call.
    const Candidate& decide(int mx, int my, const Around& around) {
        begin(mx, my, around);
        best_ = nullptr;
        forced_ = static_cast<Mode>(job_.forced[my * job_.width_mb + mx]);
        if (forced_ != kModePcm) {
            if (job_.reference_count > 0) {
                try_inter();
                refine_by_cost();
            }
            if (best_ == nullptr || forced_ >= kModeIntra16 || wants_intra()) try_intra();
        }
        if (best_ == nullptr || (free() && quality_.cost(0, kPcmBits) < best_->cost)) {
            take_samples();
        }
        return *best_;
    }

private:
    // No mode is forced, so that what seems not to pay need not be tried.
    bool free() const { return forced_ == kAnyMode; }

    bool allowed(const Coded& mb) const {
        const bool inter = mb.kind == Kind::kInter;
        return free() || forced_ == (inter ? kMode16x16 + mb.shape
                                           : kModeOfKind[static_cast<int>(mb.kind)]);
    }

    // I_PCM, of the source's samples.
    void take_samples() {
        Candidate& c = spare();
        start(c, Kind::kPcm);
        c.mb.cbp_luma = 15;
        c.mb.cbp_chroma = 2;
        c.mb.coded = (1u << 27) - 1;
        copy_block<16>(source_[0].at, source_[0].stride, c.luma, 16, 16);
        for (int p = 0; p < 2; ++p) {
            copy_block<8>(source_[1 + p].at, source_[1 + p].stride, c.chroma[p], 8, 8);
        }
        best_ = &c;
    }

    void begin(int mx, int my, const Around& around) {
        around_ = &around;
        x_ = 16 * mx;
        y_ = 16 * my;
        for (int p = 0; p < 3; ++p) {
            const Plane& plane = job_.frame[p];
            const int shift = p > 0;
            source_[p] = {plane.at + (y_ >> shift) * plane.stride + (x_ >> shift), plane.stride};
            picture_[p] = job_.reconstruction[p] +
                          (y_ >> shift) * job_.reconstruction_stride[p] + (x_ >> shift);
        }
        rates_.begin(contexts_);
        quality_.rates = &rates_;
        quality_.around = around_;
        quality_.qp = job_.qp[my * job_.width_mb + mx];
        quality_.lambda_q8 = job_.lambda_q8[quality_.qp];
        motion_q8_ = job_.motion_q8[quality_.qp];
        const int right = 16 * job_.width_mb - x_, below = 16 * job_.height_mb - y_;
        const auto limit = [](int v, int most) {
            return static_cast<int16_t>(v < -most ? -most : v > most ? most : v);
        };
        // Vectors stay within 24 samples of the picture, and within the level's range.
        range_ = {limit(-4 * (x_ + 24), 2000), limit(4 * (right + 8), 2000),
                  limit(-4 * (y_ + 24), job_.vertical_reach),
                  limit(4 * (below + 8), job_.vertical_reach)};
    }

    Candidate& spare() { return &candidates_[0] == best_ ? candidates_[1] : candidates_[0]; }

    void start(Candidate& c, Kind kind) {
        c.mb.kind = kind;
        c.mb.transform8 = false;
        c.mb.shape = 0;
        c.mb.cbp_luma = c.mb.cbp_chroma = c.mb.chroma_mode = 0;
        c.mb.coded = 0;
        c.luma_bits = c.chroma_bits = 0;
        c.mb.qp = static_cast<int8_t>(quality_.qp);
    }

    uint32_t bits(const Candidate& c) const {
        CabacCounter counter(contexts_);
        write_macroblock(counter, c.mb, *around_, job_.reference_count);
        return counter.cost() + c.luma_bits + c.chroma_bits;
    }

    // Weighs a finished candidate against the best one.
    void weigh(Candidate& c) {
        c.cost = quality_.cost(c.luma_error + c.chroma_error, bits(c));
        if (!allowed(c.mb)) c.cost += kForbidden;
        if (best_ == nullptr || c.cost < best_->cost) best_ = &c;
    }

    // --- inter ---

    void predict(const Coded& mb, uint8_t* luma, uint8_t (*chroma)[64]) {
        alignas(32) uint8_t scratch[256];
        for (int p = 0; p < kPartitionCount[mb.shape]; ++p) {
            const Partition& part = kPartitions[mb.shape][p];
            const int x = 8 * (part.block & 1), y = 8 * (part.block >> 1);
            const int width = 4 * part.width, height = 4 * part.height;
            const int index = mb.reference[part.block];
            const Mv mv = mb.mv[part.block];
            const Block block =
                luma_prediction(planes_[index], x_ + x, y_ + y, mv, width, height, scratch);
            uint8_t* out = luma + 16 * y + x;
            if (width == 16) {
                copy_block<16>(block.at, block.stride, out, 16, height);
            } else {
                copy_block<8>(block.at, block.stride, out, 16, height);
            }
            for (int c = 0; c < 2; ++c) {
                const Plane& plane = job_.references[index].chroma[c];
                uint8_t* to = chroma[c] + 4 * y + x / 2;
                if (width == 16) {
                    predict_chroma<8>(plane, (x_ + x) / 2, (y_ + y) / 2, mv, height / 2, to);
                } else {
                    predict_chroma<4>(plane, (x_ + x) / 2, (y_ + y) / 2, mv, height / 2, to);
                }
            }
        }
    }

    // Completes an inter candidate whose shape, references, vectors and differences are set;
    // `smaller`: whether with 4x4 transforms, too.
    void finish_inter(Candidate& c, bool smaller = true) {
        alignas(32) uint8_t luma[256], chroma[2][64];
        predict(c.mb, luma, chroma);
        code_chroma(quality_, &source_[1], chroma, c);
        const Cost most = most_for_luma(c);
        if (most <= 0) return;
        LumaCosts costs;
        const bool whole = code_luma8(quality_, source_[0], luma, most, c, costs);
        if (whole) weigh(c);
        if (!smaller || (whole && c.mb.cbp_luma == 0)) return;
        Candidate& other = scratch_;
        other = c;
        if (!code_luma4(quality_, source_[0], luma, costs, most, other)) return;
        weigh(other);
        if (best_ == &other) {
            c = other;
            best_ = &c;
        }
    }

    // What the luma of a candidate may cost, so that all of it may still be the least.
    Cost most_for_luma(const Candidate& c) const {
        if (best_ == nullptr) return kWorst;
        return best_->cost - quality_.cost(c.chroma_error, c.chroma_bits);
    }

    void set_partition(Coded& mb, const Partition& part, int index, Mv mv, Mv predicted) {
        for (int b = 0; b < 4; ++b) {
            if (!part.covers(b)) continue;
            mb.reference[b] = static_cast<int8_t>(index);
            mb.mv[b] = mv;
        }
        mb.mvd[part.block] = {static_cast<int16_t>(mv.x - predicted.x),
                              static_cast<int16_t>(mv.y - predicted.y)};
    }

    // Skips where the skipped macroblock's prediction leaves nothing to code; true if so.
    bool try_skip() {
        const Mv mv = skip_vector(field_);
        skip_vector_ = mv;
        if (!range_.holds(mv)) return false;
        Candidate& c = spare();
        start(c, Kind::kSkip);
        set_partition(c.mb, kPartitions[0][0], 0, mv, mv);
        alignas(32) uint8_t luma[256], chroma[2][64];
        predict(c.mb, luma, chroma);
        const bool nothing = comes_near(luma) && leaves_nothing(luma, chroma);
        __builtin_memcpy(c.luma, luma, sizeof luma);
        __builtin_memcpy(c.chroma, chroma, sizeof chroma);
        c.luma_error = squared_error<16>(source_[0].at, source_[0].stride, luma, 16);
        c.chroma_error = squared_error<8>(source_[1].at, source_[1].stride, chroma[0], 8) +
                         squared_error<8>(source_[2].at, source_[2].stride, chroma[1], 8);
        weigh(c);
        return nothing;
    }

    bool comes_near(const uint8_t* luma) const {
        const uint32_t difference =
            transformed_difference<16>(source_[0].at, source_[0].stride, luma, 16, 16);
        return 256 * uint64_t{difference} < uint64_t{kSkipBits} * motion_q8_;
    }

    // Whether nothing beside this prediction would be worth its bits.
    bool leaves_nothing(const uint8_t* luma, const uint8_t (*chroma)[64]) {
        Candidate& c = scratch_;
        start(c, Kind::kInter);
        for (int b = 0; b < 4; ++b) {
            const int x = 8 * (b & 1), y = 8 * (b >> 1), at = 16 * y + x;
            if (code_block8(quality_, source_[0].at + y * source_[0].stride + x, source_[0].stride,
                            luma + at, 16, c.mb.luma, c.luma + at, 16)) {
                return false;
            }
        }
        code_chroma(quality_, &source_[1], chroma, c);
        return c.mb.cbp_chroma == 0;
    }

    Search search_of(int index, int shape, const Partition& part) const {
        return search_of(index, part, predicted_vector(field_, shape, part, index));
    }

    Search search_of(int index, const Partition& part, Mv predicted) const {
        const int x = 8 * (part.block & 1), y = 8 * (part.block >> 1);
        const int width = 4 * part.width, height = 4 * part.height;
        return {planes_[index], source_[0].at + y * source_[0].stride + x,
                source_[0].stride, transformed_.rows(x, y, width), x_ + x, y_ + y, width, height,
                predicted, motion_q8_, range_};
    }

    Found started(const Search& search, int index, const Mv* starts, int count) const {
        Mv all[6] = {search.predicted, {0, 0}};
        int used = 2;
        for (int i = 0; i < count; ++i) all[used++] = starts[i];
        Found found = search.first_of(all, used);
        found.cost += reference_cost(index);
        return found;
    }

    Found refined(const Search& search, int index, Found found) const {
        found.cost -= reference_cost(index);
        found = search.refined(found, job_.effort);
        found.cost += reference_cost(index);
        return found;
    }

    uint32_t reference_cost(int index) const {
        return job_.reference_count < 2 ? 0 : motion_q8_ * static_cast<uint32_t>(index + 1);
    }

    bool best_alone() const { return job_.effort.references_reach == 100; }

    int least_of(const Found* found) const {
        int least = 0;
        for (int r = 1; r < job_.reference_count; ++r) {
            if (found[r].cost < found[least].cost) least = r;
        }
        return least;
    }

    // Refines a partition's vectors in the best reference and in those that come near to it.
    void refine_near(const Partition& part, const Mv* predicted, Found* found) const {
        const int best = least_of(found), reach = job_.effort.references_reach;
        const uint64_t near = uint64_t{found[best].cost} * unsigned(reach) / 100;
        const uint64_t most = reach == 0 ? kNotSearched : near;
        for (int r = 0; r < job_.reference_count; ++r) {
            if (found[r].cost == kNotSearched || found[r].cost > most) continue;
            if (best_alone() && r != best) continue;
            found[r] = refined(search_of(r, part, predicted[r]), r, found[r]);
        }
    }

    void try_inter() {
        field_.begin(*around_);
        if (try_skip() && free()) return;
        transformed_.begin(source_[0].at, source_[0].stride);
        Found whole[kMaxReferences];
        const Mv starts[3] = {field_.mv[1][0], field_.mv[0][1], skip_vector_};
        for (int r = 0; r < job_.reference_count; ++r) {
            const Search search = search_of(r, 0, kPartitions[0][0]);
            whole[r] = started(search, r, starts, 3);
        }
        const auto order = [&](int& best, int& second) {
            best = second = 0;
            for (int r = 1; r < job_.reference_count; ++r) {
                if (whole[r].cost < whole[best].cost) {
                    second = best;
                    best = r;
                } else if (second == best || whole[r].cost < whole[second].cost) {
                    second = r;
                }
            }
        };
        int best, second;
        order(best, second);
        for (int r = 0; r < job_.reference_count; ++r) {
            if (r != best && r != second && best_alone()) continue;
            whole[r] = refined(search_of(r, 0, kPartitions[0][0]), r, whole[r]);
        }
        order(best, second);
        inter_cost_ = whole[best].cost;
        code_whole(best, whole[best].mv);
        if (job_.effort.whole_trials > 0) {
            const Mv predicted = predicted_vector(field_, 0, kPartitions[0][0], best);
            const bool differs = !(whole[best].mv == predicted);
            if (differs && range_.holds(predicted)) code_whole(best, predicted);
        }
        if (job_.effort.whole_trials > 1 && second != best) code_whole(second, whole[second].mv);
        if (free() && best_->mb.kind == Kind::kInter && best_->mb.cbp_luma == 0) return;
        if (free() && inter_cost_ < kWholeBits * motion_q8_) return;
        try_parts(whole);
    }

    // The macroblock as one partition.
    void code_whole(int index, Mv mv) {
        const Partition& all = kPartitions[0][0];
        Candidate& c = spare();
        start(c, Kind::kInter);
        set_partition(c.mb, all, index, mv, predicted_vector(field_, 0, all, index));
        finish_inter(c);
    }

    // Moves the best candidate's vectors by a quarter sample, one at a time, while its cost falls.
    void refine_by_cost() {
        for (int round = 0; round < job_.effort.cost_rounds; ++round) {
            if (best_->mb.kind != Kind::kInter) return;
            const Cost before = best_->cost;
            for (int p = 0; p < kPartitionCount[best_->mb.shape]; ++p) code_around(p);
            if (best_->cost == before) return;
        }
    }

    // The best candidate with the vector of partition `p` moved in each of four directions.
    void code_around(int p) {
        Coded from;
        __builtin_memcpy(&from, &best_->mb, offsetof(Coded, luma));
        const Mv centre = from.mv[kPartitions[from.shape][p].block];
        const bool smaller = from.cbp_luma != 0 && !from.transform8;
        for (int i = 0; i < 4; ++i) {
            const Mv mv = Search::neighbour(centre, 1, i);
            if (!range_.holds(mv)) continue;
            Candidate& c = spare();
            start(c, Kind::kInter);
            move_partition(from, p, mv, c.mb);
            finish_inter(c, smaller);
        }
    }

    // The partitions of `from` with another vector for number `moved`; those after it may be
    // predicted from that.
    void move_partition(const Coded& from, int moved, Mv mv, Coded& out) {
        out.shape = from.shape;
        field_.forget();
        for (int p = 0; p < kPartitionCount[from.shape]; ++p) {
            const Partition& part = kPartitions[from.shape][p];
            const int index = from.reference[part.block];
            const Mv vector = p == moved ? mv : from.mv[part.block];
            const Mv predicted = predicted_vector(field_, from.shape, part, index);
            set_partition(out, part, index, vector, predicted);
            field_.fill(part, static_cast<int8_t>(index), vector);
        }
    }

    // Four 8x8 blocks, then the halves that agree with them; the cheapest of these are coded.
    void try_parts(const Found* whole) {
        Coded parts[3];
        uint32_t costs[3];
        costs[2] = search_shape(3, whole, nullptr, parts[2]);
        if (free() && far_behind(costs[2])) return;
        costs[0] = search_shape(1, whole, &parts[2], parts[0]);
        costs[1] = search_shape(2, whole, &parts[2], parts[1]);
        int least = 0;
        for (int i = 1; i < 3; ++i) {
            if (costs[i] < costs[least]) least = i;
        }
        if (forced_ >= kMode16x8 && forced_ <= kMode8x8) least = forced_ - kMode16x8;
        if (free() && costs[least] >= inter_cost_) return;
        inter_cost_ = costs[least];
        for (int i = 0; i < 3; ++i) {
            if (i == least || (free() && nearly_least(costs[i], costs[least]))) code_parts(parts[i]);
        }
    }

    bool nearly_least(uint32_t cost, uint32_t least) const {
        return 100 * uint64_t{cost} < uint64_t{least} * unsigned(job_.effort.shapes_reach);
    }

    void code_parts(const Coded& parts) {
        Candidate& c = spare();
        start(c, Kind::kInter);
        c.mb.shape = parts.shape;
        for (int b = 0; b < 4; ++b) {
            c.mb.reference[b] = parts.reference[b];
            c.mb.mv[b] = parts.mv[b];
            c.mb.mvd[b] = parts.mvd[b];
        }
        finish_inter(c);
    }

    // Where 8x8 blocks are predicted this badly, halves would not be better than the whole either.
    bool far_behind(uint32_t cost) const {
        const int reach = job_.effort.halves_reach;
        return reach > 0 && 100 * uint64_t{cost} > uint64_t{inter_cost_} * unsigned(reach);
    }

    // Vectors for every partition of `shape`; `from`, if there, has those of 8x8 blocks to start
    // from. Returns the cost of all.
    uint32_t search_shape(int shape, const Found* whole, const Coded* from, Coded& out) {
        out.shape = static_cast<uint8_t>(shape);
        field_.forget();
        uint32_t total = motion_q8_ * (shape == 3 ? 6u : 2u);
        for (int p = 0; p < kPartitionCount[shape]; ++p) {
            const Partition& part = kPartitions[shape][p];
            const int last = part.block + (part.width == 4) + 2 * (part.height == 4);
            Found found[kMaxReferences];
            Mv predicted[kMaxReferences];
            for (int r = 0; r < job_.reference_count; ++r) {
                found[r] = {{0, 0}, kNotSearched};
                if (from && r != from->reference[part.block] && r != from->reference[last]) {
                    continue;
                }
                const Search search = search_of(r, shape, part);
                predicted[r] = search.predicted;
                Mv starts[4] = {whole[r].mv, search.predicted};
                if (from) {
                    starts[2] = from->mv[part.block];
                    starts[3] = from->mv[last];
                }
                found[r] = search.first_of(starts, from ? 4 : 2);
                found[r].cost += reference_cost(r);
            }
            if (!from || !best_alone()) refine_near(part, predicted, found);
            const int index = least_of(found);
            const Found least = found[index];
            set_partition(out, part, index, least.mv, predicted[index]);
            field_.fill(part, static_cast<int8_t>(index), least.mv);
            total += least.cost;
        }
        return total;
    }

    // --- intra ---

    bool wants_intra() {
        return free() && best_->cost > quality_.cost(0, 256 * kIntraBits);
    }

    // Inter prediction leaves no luma to code: smaller blocks, each with its mode, would not pay.
    bool wants_whole_intra() const {
        return free() && best_ != nullptr && best_->mb.cbp_luma == 0;
    }

    bool beyond_reach(uint32_t difference) const {
        const int reach = job_.effort.intra_reach;
        return free() && reach > 0 && 1024 * uint64_t{difference} > uint64_t{inter_cost_} * unsigned(reach);
    }

    void try_intra() {
        alignas(32) uint8_t luma[256], least[256];
        uint32_t lowest = UINT32_MAX;
        int mode16 = 2;
        for (int mode = 0; mode < 4; ++mode) {
            if (!predict_luma16(mode, picture_[0], job_.reconstruction_stride[0], *around_, luma)) {
                continue;
            }
            const uint32_t cost =
                transformed_difference<16>(source_[0].at, source_[0].stride, luma, 16, 16);
            if (cost < lowest) {
                lowest = cost;
                mode16 = mode;
                __builtin_memcpy(least, luma, sizeof luma);
            }
        }
        if (best_ != nullptr && beyond_reach(lowest)) return;
        const bool whole = wants_whole_intra();
        Candidate& c = spare();
        start(c, Kind::kIntra16);
        c.mb.intra16_mode = static_cast<uint8_t>(mode16);
        intra_chroma(c);
        if (best_ == nullptr || whole || worth_16(lowest)) {
            code_luma16(quality_, source_[0], least, c);
            weigh(c);
        }
        if (whole) return;
        // c may have become the best; the chroma of all three kinds is the same.
        Candidate& next = &c == best_ ? spare() : c;
        if (&next != &c) copy_chroma(c, next);
        if (!try_blocks<8>(next) && free()) return;
        Candidate& last = best_ == &next ? spare() : next;
        if (&last != &next) copy_chroma(next, last);
        try_blocks<4>(last);
    }

    // One mode for all of the macroblock beats inter prediction only where it comes near to it.
    bool worth_16(uint32_t difference) const {
        return !free() || job_.effort.intra_reach == 0 || 256 * uint64_t{difference} <= inter_cost_;
    }

    static void copy_chroma(const Candidate& from, Candidate& to) {
        to.mb = from.mb;
        to.chroma_bits = from.chroma_bits;
        to.chroma_error = from.chroma_error;
        __builtin_memcpy(to.chroma, from.chroma, sizeof to.chroma);
    }

    void intra_chroma(Candidate& c) {
        alignas(32) uint8_t prediction[2][64], least[2][64] = {};
        uint32_t lowest = UINT32_MAX;
        for (int mode = 0; mode < 4; ++mode) {
            uint32_t cost = 0;
            bool possible = true;
            for (int p = 0; p < 2; ++p) {
                possible = possible && predict_chroma8(mode, picture_[1 + p],
                                                       job_.reconstruction_stride[1 + p], *around_,
                                                       prediction[p]);
                if (possible) {
                    cost += transformed_difference<8>(source_[1 + p].at, source_[1 + p].stride,
                                                      prediction[p], 8, 8);
                }
            }
            if (!possible || cost >= lowest) continue;
            lowest = cost;
            c.mb.chroma_mode = static_cast<uint8_t>(mode);
            __builtin_memcpy(least, prediction, sizeof least);
        }
        code_chroma(quality_, &source_[1], least, c);
    }

    void begin_canvas() {
        const ptrdiff_t stride = job_.reconstruction_stride[0];
        const uint8_t* at = picture_[0];
        if (around_->above) copy_block<16>(at - stride, 0, canvas_.at(0, -1), 0, 1);
        if (around_->above_right) copy_block<8>(at - stride + 16, 0, canvas_.at(16, -1), 0, 1);
        if (around_->above_left) *canvas_.at(-1, -1) = at[-stride - 1];
        for (int y = 0; around_->left && y < 16; ++y) *canvas_.at(-1, y) = at[y * stride - 1];
    }

    // Intra_4x4 (8.3.1.1) and Intra_8x8 (8.3.2.1): the smaller of the modes to the left and above.
    int predicted_mode(const Coded& mb, int raster) const {
        const int x = raster & 3, y = raster >> 2;
        if ((x == 0 && !around_->left) || (y == 0 && !around_->above)) return kDc;
        const int left = x ? mb.intra_mode[raster - 1] : around_->left->intra_mode[raster + 3];
        const int above = y ? mb.intra_mode[raster - 4] : around_->above->intra_mode[raster + 12];
        return left < above ? left : above;
    }

    template <int side>
    bool above_right_known(int x, int y) const {  // in blocks of `side`
        constexpr int kAcross = 16 / side;
        if (y == 0) return (x < kAcross - 1 ? around_->above : around_->above_right) != nullptr;
        if (side == 8) return x == 0;
        return !(x == 3 || (x == 1 && y != 2));
    }

    // Gives up where the luma alone costs more than the best candidate; false if that was in the
    // upper half, so that smaller blocks would not pay either.
    template <int side>
    bool try_blocks(Candidate& c) {
        constexpr int kAcross = 16 / side, kSteps = side / 4;
        c.mb.kind = side == 8 ? Kind::kIntra8 : Kind::kIntra4;
        c.mb.transform8 = side == 8;
        c.mb.cbp_luma = 0;
        c.mb.coded &= ~0x1FFFFu;
        c.luma_bits = c.luma_error = 0;
        const Cost most = most_for_luma(c);
        begin_canvas();
        for (int i = 0; i < kAcross * kAcross; ++i) {
            const int raster = kRasterOfBlk[i * (side == 8 ? 4 : 1)];
            const int x = raster & 3, y = raster >> 2;
            const int predicted = predicted_mode(c.mb, raster);
            const int mode = choose_mode<side>(4 * x, 4 * y, predicted);
            for (int j = 0; j < kSteps; ++j) {
                for (int k = 0; k < kSteps; ++k) {
                    c.mb.intra_mode[raster + 4 * j + k] = static_cast<int8_t>(mode);
                }
            }
            c.mb.predicted_mode[raster] = static_cast<int8_t>(predicted);
            code_intra_block<side>(c, i, raster, strip<side>().of(mode));
            if (quality_.cost(c.luma_error, c.luma_bits) > most) return 2 * i >= kAcross * kAcross;
        }
        copy_block<16>(canvas_.at(0, 0), Canvas::kStride, c.luma, 16, 16);
        weigh(c);
        return true;
    }

    template <int side>
    void code_intra_block(Candidate& c, int i, int raster, const uint8_t* prediction) {
        const int x = 4 * (raster & 3), y = 4 * (raster >> 2);
        const uint8_t* source = source_[0].at + y * source_[0].stride + x;
        constexpr ptrdiff_t kStride = ModeStrip<side>::kStride;
        uint8_t* out = canvas_.at(x, y);
        if (side == 8) {
            const uint32_t bits =
                code_block8(quality_, source, source_[0].stride, prediction, kStride,
                            c.mb.luma + 64 * i, out, Canvas::kStride);
            c.luma_bits += bits;
            c.luma_error += squared_error<8>(source, source_[0].stride, out, Canvas::kStride);
            if (bits) {
                c.mb.cbp_luma |= static_cast<uint8_t>(1 << i);
                c.mb.coded |= 0x33u << raster;
            }
            return;
        }
        const int context =
            kFlagContext[kLuma4] + luma_flag_context(c.mb, *around_, raster, c.mb.coded);
        const uint32_t bits = code_block4(quality_, context, source, source_[0].stride, prediction,
                                          kStride, c.mb.luma + 16 * i, out, Canvas::kStride);
        c.luma_bits += bits;
        c.luma_error += squared_error<4>(source, source_[0].stride, out, Canvas::kStride);
        if (bits) {
            c.mb.cbp_luma |= static_cast<uint8_t>(1 << (i >> 2));
            c.mb.coded |= 1u << raster;
        }
    }

    template <int side>
    int choose_mode(int x, int y, int predicted) {
        const bool left = x > 0 || around_->left, above = y > 0 || around_->above;
        const Neighbour* beyond_corner = x > 0 ? around_->above
                                         : y > 0 ? around_->left
                                                 : around_->above_left;
        const bool corner = (x > 0 && y > 0) || beyond_corner != nullptr;
        Edge<side> edge;
        read_edge<side>(canvas_.at(x, y), Canvas::kStride, left, above, corner,
                        above_right_known<side>(x / side, y / side), edge);
        if constexpr (side == 8) {
            Edge<8> filtered;
            filter_edge(edge, filtered);
            edge = filtered;
        }
        const uint8_t* source = source_[0].at + y * source_[0].stride + x;
        ModeStrip<side>& modes = strip<side>();
        EdgeMeans<side> means;
        means.measure(edge);
        for (int mode = 0; mode < kBlockModes; ++mode) {
            if (mode_available(mode, edge)) {
                predict_block<side>(mode, edge, means, modes.of(mode), ModeStrip<side>::kStride);
            }
        }
        uint32_t differences[ModeStrip<side>::kVectors * ModeStrip<side>::kPerVector];
        strip_differences(source, source_[0].stride, modes, differences);
        uint32_t lowest = UINT32_MAX;
        int chosen = kDc;
        for (int mode = 0; mode < kBlockModes; ++mode) {
            if (!mode_available(mode, edge)) continue;
            const uint32_t cost =
                256 * differences[mode] + motion_q8_ * (mode == predicted ? 1u : 4u);
            if (cost < lowest) {
                lowest = cost;
                chosen = mode;
            }
        }
        return chosen;
    }

    template <int side>
    ModeStrip<side>& strip() {
        if constexpr (side == 8) {
            return strip8_;
        } else {
            return strip4_;
        }
    }

    const SliceJob& job_;
    const Contexts& contexts_;
    const Around* around_ = nullptr;
    int x_ = 0, y_ = 0;
    Plane source_[3];
    QuarterPlanes planes_[kMaxReferences];
    TransformedSource transformed_;
    uint8_t* picture_[3];
    Rates rates_;
    Quality quality_;
    uint32_t motion_q8_ = 0;
    Mode forced_ = kModeSkip;
    Range range_;
    MotionField field_;
    Mv skip_vector_ = {0, 0};
    uint32_t inter_cost_ = 0;
    Candidate candidates_[2];
    Candidate scratch_;
    Candidate* best_ = nullptr;
    Canvas canvas_;
    ModeStrip<4> strip4_ = {};
    ModeStrip<8> strip8_ = {};
};

}  // namespace
