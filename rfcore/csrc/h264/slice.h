// A slice in two passes. The first decides how macroblocks are coded, several rows at a time; the
// second writes slice_data (7.3.4) in raster order.
//
// Decisions need the states of the arithmetic coder. Each row has its own: it starts with the mean
// of what the row above it had kContextLag of a row along and what the row kRowsBack above it ended
// with, and follows its own macroblocks from there. So decisions, and with them all bytes, do not
// depend on the number of threads.
#pragma once

#include "h264/decide.h"
#include "h264/kernels.h"

namespace {

// QP_Y and whether mb_qp_delta was coded. The filter takes 0 for I_PCM (8.7.2.2).
inline void set_quantiser(const Coded& mb, const Around& around, Neighbour& out) {
    const bool pcm = mb.kind == Kind::kPcm;
    const bool residual = mb.cbp_luma || mb.cbp_chroma || mb.kind == Kind::kIntra16;
    out.qp = pcm ? 0 : residual ? mb.qp : static_cast<int8_t>(around.previous_qp);
    out.delta_qp = residual && !pcm && mb.qp != around.previous_qp;
}

inline void remember(const Candidate& c, const Around& around, Neighbour& out) {
    const Coded& mb = c.mb;
    const bool intra = mb.kind >= Kind::kIntra16;
    const bool blocks = mb.kind == Kind::kIntra4 || mb.kind == Kind::kIntra8;
    out.kind = mb.kind;
    out.mode = mb.kind == Kind::kInter ? static_cast<Mode>(kMode16x16 + mb.shape)
                                       : kModeOfKind[static_cast<int>(mb.kind)];
    out.transform8 = mb.transform8;
    out.cbp_luma = mb.cbp_luma;
    out.cbp_chroma = mb.cbp_chroma;
    out.chroma_mode = intra ? mb.chroma_mode : 0;
    set_quantiser(mb, around, out);
    out.coded = mb.coded;
    for (int b = 0; b < 4; ++b) out.reference[b] = intra ? kNoReference : mb.reference[b];
    for (int i = 0; i < 16; ++i) {
        const int block = 2 * (i >> 3) + ((i >> 1) & 1);
        out.mv[i] = intra ? Mv{0, 0} : mb.mv[block];
        out.intra_mode[i] = blocks ? mb.intra_mode[i] : static_cast<int8_t>(kDc);
        out.mvd[i][0] = out.mvd[i][1] = 0;
    }
    if (mb.kind != Kind::kInter) return;
    const auto size = [](int v) {
        const int magnitude = v < 0 ? -v : v;
        return static_cast<uint8_t>(magnitude > 255 ? 255 : magnitude);
    };
    for (int p = 0; p < kPartitionCount[mb.shape]; ++p) {
        const Partition& part = kPartitions[mb.shape][p];
        for (int i = 0; i < 16; ++i) {
            if (!part.covers(2 * (i >> 3) + ((i >> 1) & 1))) continue;
            out.mvd[i][0] = size(mb.mvd[part.block].x);
            out.mvd[i][1] = size(mb.mvd[part.block].y);
        }
    }
}

inline void reconstruct(const SliceJob& job, int mx, int my, const Candidate& c) {
    for (int p = 0; p < 3; ++p) {
        const int side = p ? 8 : 16;
        uint8_t* out = job.reconstruction[p] + my * side * job.reconstruction_stride[p] + mx * side;
        const uint8_t* from = p ? c.chroma[p - 1] : c.luma;
        if (p) {
            copy_block<8>(from, 8, out, job.reconstruction_stride[p], 8);
        } else {
            copy_block<16>(from, 16, out, job.reconstruction_stride[p], 16);
        }
    }
}

// The share of a row, in eighths, that the row below starts behind.
constexpr int kContextLag = 3;
constexpr int kRowsBack = 3;

inline int context_lag(int width_mb) {
    const int columns = kContextLag * width_mb / 8;
    return columns < 2 ? (width_mb < 2 ? width_mb : 2) : columns;
}

// States that a row hands on: at context_lag() and at its end.
struct RowContexts {
    Contexts at_lag, at_end;
};

inline RowContexts& row_contexts(const SliceJob& job, int my) {
    return static_cast<RowContexts*>(job.contexts)[my];
}

// The states half way between: pStateIdx counts down from either side of equal odds.
inline void take_mean(Contexts& contexts, const Contexts& other) {
    const auto odds = [](uint8_t packed) {
        const int distance = 2 * (packed >> 1) + 1;
        return packed & 1 ? distance : -distance;
    };
    for (int i = 0; i < kContexts; ++i) {
        const int mean = (odds(contexts.state[i]) + odds(other.state[i])) / 2;
        const int state = (mean < 0 ? -mean : mean) / 2;
        contexts.state[i] = static_cast<uint8_t>(2 * state + (mean >= 0));
    }
}

// The states that row `my` starts with; waits for the rows that they come from.
inline void start_contexts(const SliceJob& job, int my, Contexts& contexts) {
    if (my == 0) return init_contexts(contexts, job.reference_count > 0, job.slice_qp);
    job.await(job.progress, my - 1, context_lag(job.width_mb));
    contexts = row_contexts(job, my - 1).at_lag;
    if (my < kRowsBack) return;
    job.await(job.progress, my - kRowsBack, job.width_mb);
    take_mean(contexts, row_contexts(job, my - kRowsBack).at_end);
}

inline Around around_of(const SliceJob& job, int mx, int my, bool previous_delta, int previous_qp) {
    const Neighbour* mb = job.macroblocks + my * job.width_mb + mx;
    const int width = job.width_mb;
    return {mx > 0 ? mb - 1 : nullptr,
            my > 0 ? mb - width : nullptr,
            my > 0 && mx < width - 1 ? mb - width + 1 : nullptr,
            my > 0 && mx > 0 ? mb - width - 1 : nullptr,
            previous_delta,
            previous_qp};
}

// Follows the states that writing the macroblock leaves.
inline void follow(ContextTracker& tracker, const Coded& mb, const Around& around,
                   int reference_count) {
    if (mb.kind == Kind::kPcm) {
        write_pcm_type(tracker, around, reference_count > 0);
    } else {
        write_macroblock(tracker, mb, around, reference_count);
    }
}

// Keeps a macroblock for the second pass; one without levels is kept without them.
inline void keep(const Coded& mb, Coded& out) {
    const bool levels = mb.cbp_luma || mb.cbp_chroma || mb.kind == Kind::kIntra16;
    __builtin_memcpy(&out, &mb, levels ? sizeof mb : offsetof(Coded, luma));
}

// First pass: decides on the macroblocks of row `my`, while the rows above may still be going on.
// mb_qp_delta of the row's first macroblock is counted against the quantiser wanted before it.
inline void decide_row(const SliceJob& job, int my) {
    const int width = job.width_mb, first = my * width, lag = context_lag(width);
    Contexts contexts;
    start_contexts(job, my, contexts);
    ContextTracker tracker(contexts);
    MacroblockCoder coder(job, contexts);
    int previous_qp = my > 0 ? job.qp[first - 1] : job.slice_qp;
    bool previous_delta = false;
    for (int mx = 0; mx < width; ++mx) {
        if (my > 0) job.await(job.progress, my - 1, mx + 2 < width ? mx + 2 : width);
        const Around around = around_of(job, mx, my, previous_delta, previous_qp);
        const Candidate& c = coder.decide(mx, my, around);
        follow(tracker, c.mb, around, job.reference_count);
        Neighbour& mb = job.macroblocks[first + mx];
        remember(c, around, mb);
        reconstruct(job, mx, my, c);
        keep(c.mb, static_cast<Coded*>(job.coded)[first + mx]);
        if (c.mb.kind != Kind::kPcm) previous_qp = mb.qp;
        previous_delta = mb.delta_qp;
        if (mx + 1 == lag) row_contexts(job, my).at_lag = contexts;
        if (mx + 1 == width) row_contexts(job, my).at_end = contexts;
        job.reached(job.progress, my, mx + 1);
    }
}

inline void write_samples(CabacWriter& writer, const SliceJob& job, int mx, int my) {
    uint8_t samples[384];
    const auto from = [&](int p, int side) {
        return job.reconstruction[p] + my * side * job.reconstruction_stride[p] + mx * side;
    };
    copy_block<16>(from(0, 16), job.reconstruction_stride[0], samples, 16, 16);
    for (int p = 1; p < 3; ++p) {
        copy_block<8>(from(p, 8), job.reconstruction_stride[p], samples + 192 + 64 * p, 8, 8);
    }
    writer.samples(samples, samples + 256);
}

// Returns false where the macroblock takes more bits than the standard allows.
inline bool write_checked(CabacWriter& writer, const SliceJob& job, int mx, int my,
                          const Around& around) {
    const Coded& mb = static_cast<const Coded*>(job.coded)[my * job.width_mb + mx];
    if (mb.kind == Kind::kPcm) {
        write_pcm_type(writer, around, job.reference_count > 0);
        write_samples(writer, job, mx, my);
        return true;
    }
    const size_t before = writer.bits();
    write_macroblock(writer, mb, around, job.reference_count);
    return writer.bits() - before <= kMaxMacroblockBits;
}

// Second pass. Puts right the quantisers that macroblocks without a residual take from the one
// before them (the filter wants them).
inline size_t write_slice(const SliceJob& job, bool* again) {
    *again = false;
    Contexts contexts;
    init_contexts(contexts, job.reference_count > 0, job.slice_qp);
    CabacWriter writer(contexts, job.out);
    const int width = job.width_mb, count = job.width_mb * job.height_mb;
    int previous_qp = job.slice_qp;
    bool previous_delta = false;
    for (int i = 0; i < count; ++i) {
        if (writer.size() + kMaxMacroblockBytes > job.capacity) return 0;
        const Around around = around_of(job, i % width, i / width, previous_delta, previous_qp);
        if (!write_checked(writer, job, i % width, i / width, around)) {
            job.forced[i] = kModePcm;
            *again = true;
        }
        writer.terminate(i == count - 1);
        const Coded& mb = static_cast<const Coded*>(job.coded)[i];
        set_quantiser(mb, around, job.macroblocks[i]);
        if (mb.kind != Kind::kPcm) previous_qp = job.macroblocks[i].qp;
        previous_delta = job.macroblocks[i].delta_qp;
    }
    return writer.finish();
}

}  // namespace
