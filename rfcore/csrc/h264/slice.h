// slice_data (7.3.4): every macroblock in raster order, its reconstruction, what neighbours need.
#pragma once

#include "h264/decide.h"
#include "h264/kernels.h"

namespace {

inline void remember(const Candidate& c, const Around& around, Neighbour& out) {
    const Coded& mb = c.mb;
    const bool intra = mb.kind >= Kind::kIntra16;
    const bool blocks = mb.kind == Kind::kIntra4 || mb.kind == Kind::kIntra8;
    const bool residual = mb.cbp_luma || mb.cbp_chroma || mb.kind == Kind::kIntra16;
    out.kind = mb.kind;
    out.transform8 = mb.transform8;
    out.cbp_luma = mb.cbp_luma;
    out.cbp_chroma = mb.cbp_chroma;
    out.chroma_mode = intra ? mb.chroma_mode : 0;
    out.qp = residual ? mb.qp : static_cast<int8_t>(around.previous_qp);
    out.delta_qp = residual && mb.qp != around.previous_qp;
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
        copy_block(from, side, out, job.reconstruction_stride[p], side, side);
    }
}

inline size_t encode_slice_data(const SliceJob& job) {
    Contexts contexts;
    init_contexts(contexts, job.reference_count > 0, job.slice_qp);
    CabacWriter writer(contexts, job.out);
    MacroblockCoder coder(job, contexts);
    const int width = job.width_mb, count = job.width_mb * job.height_mb;
    int previous_qp = job.slice_qp;
    bool previous_delta = false;
    for (int i = 0; i < count; ++i) {
        const int mx = i % width, my = i / width;
        if (writer.size() + kMaxMacroblockBytes > job.capacity) return 0;
        const Neighbour* mbs = job.macroblocks;
        const Around around = {mx > 0 ? &mbs[i - 1] : nullptr,
                               my > 0 ? &mbs[i - width] : nullptr,
                               my > 0 && mx < width - 1 ? &mbs[i - width + 1] : nullptr,
                               my > 0 && mx > 0 ? &mbs[i - width - 1] : nullptr,
                               previous_delta,
                               previous_qp};
        const Candidate& c = coder.decide(mx, my, around);
        write_macroblock(writer, c.mb, around, job.reference_count);
        writer.terminate(i == count - 1);
        remember(c, around, job.macroblocks[i]);
        reconstruct(job, mx, my, c);
        previous_qp = job.macroblocks[i].qp;
        previous_delta = job.macroblocks[i].delta_qp;
    }
    return writer.finish();
}

}  // namespace
