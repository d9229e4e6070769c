// The deblocking filter (8.7) on a coded picture: macroblock after macroblock in raster order, in
// each the vertical edges from left to right, then the horizontal ones from top to bottom.
#pragma once

#include "h264/edge_filter.h"

namespace {

inline bool intra(const Neighbour& mb) { return mb.kind >= Kind::kIntra16; }

// 8.7.2.1 for two 4x4 blocks of inter macroblocks. Each reference index is another picture, as the
// receiver puts a picture that serves twice into its buffer twice.
inline uint8_t inter_strength(const Neighbour& p, int i, const Neighbour& q, int j) {
    if (((p.coded >> i) | (q.coded >> j)) & 1) return 2;
    const auto reference = [](const Neighbour& mb, int block) {
        return mb.reference[2 * (block >> 3) + ((block >> 1) & 1)];
    };
    const auto far = [](int a, int b) { return a - b >= 4 || b - a >= 4; };
    return reference(p, i) != reference(q, j) || far(p.mv[i].x, q.mv[j].x) ||
           far(p.mv[i].y, q.mv[j].y);
}

// bS along one edge of macroblock `q`, 0 its own left or upper border, with `p` on the other side;
// false where all are 0.
inline bool edge_strengths(const Neighbour& p, const Neighbour& q, bool down, int edge,
                           uint8_t* strength) {
    if (intra(p) || intra(q)) {
        __builtin_memset(strength, edge ? 3 : 4, 4);
        return true;
    }
    const int across = down ? 4 : 1, along = down ? 1 : 4;
    const int first = edge * across, before = edge ? first - across : 3 * across;
    int any = 0;
    for (int i = 0; i < 4; ++i) {
        strength[i] = inter_strength(p, before + i * along, q, first + i * along);
        any |= strength[i];
    }
    return any != 0;
}

inline void filter_edge_of(const SliceJob& job, int mx, int my, const Neighbour& p,
                           const Neighbour& q, bool down, int edge) {
    uint8_t strength[4];
    if (!edge_strengths(p, q, down, edge, strength)) return;
    uint8_t* planes[3];
    for (int i = 0; i < 3; ++i) {
        const int side = i ? 8 : 16, inside = i ? 2 * edge : 4 * edge;
        const ptrdiff_t stride = job.reconstruction_stride[i];
        planes[i] = job.reconstruction[i] + (side * my + (down ? inside : 0)) * stride +
                    side * mx + (down ? 0 : inside);
    }
    EdgeLimits limits;
    if (set_limits(strength, (p.qp + q.qp + 1) >> 1, limits)) {
        filter_luma_edge(planes[0], job.reconstruction_stride[0], down, limits);
    }
    const int chroma_qp = (kChromaQp[p.qp] + kChromaQp[q.qp] + 1) >> 1;
    if (edge % 2 == 0 && set_limits(strength, chroma_qp, limits)) {
        filter_chroma_edge(planes[1], planes[2], job.reconstruction_stride[1], down, limits);
    }
}

inline void deblock_macroblock(const SliceJob& job, int mx, int my) {
    const Neighbour* mb = job.macroblocks + my * job.width_mb + mx;
    for (int down = 0; down < 2; ++down) {
        const Neighbour* before = down ? my > 0 ? mb - job.width_mb : nullptr
                                       : mx > 0 ? mb - 1 : nullptr;
        if (before) filter_edge_of(job, mx, my, *before, *mb, down, 0);
        // Inside, 8x8 transforms have but one edge.
        for (int edge = mb->transform8 ? 2 : 1; edge < 4; edge += mb->transform8 ? 2 : 1) {
            filter_edge_of(job, mx, my, *mb, *mb, down, edge);
        }
    }
}

inline void deblock_row(const SliceJob& job, int my) {
    const int width = job.width_mb;
    for (int mx = 0; mx < width; ++mx) {
        if (my > 0) job.await(job.progress, my - 1, mx + 2 < width ? mx + 2 : width);
        deblock_macroblock(job, mx, my);
        job.reached(job.progress, my, mx + 1);
    }
}

}  // namespace
