#include "h264/slice_coder.h"

#include <algorithm>
#include <cstring>

namespace rfcore::h264 {

void SliceCoder::Padded::resize(int width, int height, int border_samples) {
    border = border_samples;
    stride = (width + 2 * border + 31) / 32 * 32;
    samples.assign(static_cast<size_t>(stride) * static_cast<size_t>(height + 2 * border) + 64, 0);
}

SliceCoder::SliceCoder(int width, int height, const Kernels& kernels, int threads)
    : width_(width),
      height_(height),
      width_mb_((width + 15) / 16),
      height_mb_((height + 15) / 16),
      kernels_(kernels),
      pool_(threads) {
    for (int p = 0; p < 3; ++p) {
        const int side = p ? 8 : 16;
        frame_[p].resize(side * width_mb_, side * height_mb_, 0);
        reconstruction_[p].resize(side * width_mb_, side * height_mb_, 0);
    }
    macroblocks_.resize(static_cast<size_t>(width_mb_) * static_cast<size_t>(height_mb_));
    coded_.resize(macroblocks_.size() * kernels.coded_bytes / 8 + 1);
    contexts_.resize(static_cast<size_t>(height_mb_) * kernels.contexts_bytes / 8 + 1);
}

// Copies a plane, repeats its last column and row up to whole macroblocks, then all edges over the
// border.
void SliceCoder::take(const Picture& from, int plane, uint8_t least, Padded& to) const {
    const int width = plane ? (width_ + 1) / 2 : width_;
    const int height = plane ? (height_ + 1) / 2 : height_;
    const int side = plane ? 8 : 16, whole_height = side * height_mb_;
    const int right = static_cast<int>(to.stride) - to.border - width;
    for (int y = 0; y < height; ++y) {
        const uint8_t* in = from.plane[plane] + y * from.stride[plane];
        uint8_t* out = to.at() + y * to.stride;
        for (int x = 0; x < width; ++x) out[x] = std::max(in[x], least);
        std::memset(out - to.border, out[0], static_cast<size_t>(to.border));
        std::memset(out + width, out[width - 1], static_cast<size_t>(right));
    }
    const size_t row = static_cast<size_t>(to.stride);
    uint8_t* first = to.at() - to.border;
    for (int y = 1; y <= to.border; ++y) std::memcpy(first - y * to.stride, first, row);
    const uint8_t* last = first + (height - 1) * to.stride;
    for (int y = height; y < whole_height + to.border; ++y) {
        std::memcpy(first + y * to.stride, last, row);
    }
}

Reference SliceCoder::reference(const Picture& from, int index) {
    Padded* luma = luma_[index];
    const int width = 16 * width_mb_, height = 16 * height_mb_;
    for (int i = 0; i < 4; ++i) {
        if (luma[i].samples.empty()) luma[i].resize(width, height, kBorder);
    }
    take(from, 0, 1, luma[0]);
    uint8_t* out[3];
    for (int i = 0; i < 3; ++i) out[i] = luma[1 + i].samples.data();
    kernels_.half_samples(luma[0].samples.data(), luma[0].stride, static_cast<int>(luma[0].stride),
                          height + 2 * kBorder, out);
    Reference result;
    for (int i = 0; i < 4; ++i) result.luma[i] = {luma[i].at(), luma[i].stride};
    for (int p = 0; p < 2; ++p) {
        Padded& chroma = chroma_[index][p];
        if (chroma.samples.empty()) chroma.resize(width / 2, height / 2, kBorder / 2);
        take(from, 1 + p, 1, chroma);
        result.chroma[p] = {chroma.at(), chroma.stride};
    }
    return result;
}

SliceJob SliceCoder::begin(const Picture& frame, const Picture* references, int reference_count) {
    SliceJob job = {};
    job.width_mb = width_mb_;
    job.height_mb = height_mb_;
    job.reference_count = reference_count;
    pool_.run(reference_count + 1, [&](int i) {
        if (i < reference_count) {
            job.references[i] = reference(references[i], i);
        } else {
            for (int p = 0; p < 3; ++p) take(frame, p, 0, frame_[p]);
        }
    });
    for (int p = 0; p < 3; ++p) {
        job.frame[p] = {frame_[p].at(), frame_[p].stride};
        job.reconstruction[p] = reconstruction_[p].at();
        job.reconstruction_stride[p] = reconstruction_[p].stride;
    }
    job.macroblocks = macroblocks_.data();
    job.coded = coded_.data();
    job.contexts = contexts_.data();
    job.progress = &wavefront_;
    job.reached = [](void* progress, int row, int columns) {
        static_cast<Wavefront*>(progress)->reached(row, columns);
    };
    job.await = [](void* progress, int row, int columns) {
        static_cast<Wavefront*>(progress)->await(row, columns);
    };
    return job;
}

void SliceCoder::over_rows(const SliceJob& job, void (*row)(const SliceJob&, int)) {
    wavefront_.begin(height_mb_);
    pool_.run(height_mb_, [&](int my) { row(job, my); });
}

// Both passes; the second again with more room until its bytes fit.
size_t SliceCoder::encode_once(SliceJob& job, bool* again) {
    over_rows(job, kernels_.decide_row);
    for (;;) {
        job.out = out_.data();
        job.capacity = out_.size();
        const size_t size = kernels_.write_slice(job, again);
        if (size > 0) return size;
        out_.resize(2 * out_.size());
    }
}

const std::vector<uint8_t>& SliceCoder::encode(const Picture& frame, const Picture* references,
                                               int reference_count, const SliceSettings& settings) {
    SliceJob job = begin(frame, references, reference_count);
    job.slice_qp = settings.slice_qp;
    job.qp = settings.qp;
    forced_.assign(settings.forced, settings.forced + macroblocks_.size());
    job.forced = forced_.data();
    job.vertical_reach = settings.vertical_reach;
    job.lambda_q8 = settings.lambda_q8;
    job.motion_q8 = settings.motion_q8;
    job.effort = settings.effort;
    out_.resize(macroblocks_.size() * 512 + 2 * kMaxMacroblockBytes);
    bool again = true;
    size_t size = 0;
    while (again) size = encode_once(job, &again);
    if (settings.deblocked) over_rows(job, kernels_.deblock_row);
    out_.resize(size);
    return out_;
}

void SliceCoder::reconstruction(int plane, uint8_t* out, ptrdiff_t stride, int width,
                                int height) const {
    const Padded& from = reconstruction_[plane];
    for (int y = 0; y < height; ++y) {
        std::memcpy(out + y * stride, from.samples.data() + y * from.stride,
                    static_cast<size_t>(width));
    }
}

}  // namespace rfcore::h264
