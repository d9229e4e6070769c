// Codes pictures of one size as slices against given pictures.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "h264/kernels.h"
#include "threads/thread_pool.h"
#include "threads/wavefront.h"

namespace rfcore::h264 {

// Planes Y, Cb, Cr of 4:2:0; chroma has (width + 1) / 2 by (height + 1) / 2 samples.
struct Picture {
    const uint8_t* plane[3];
    ptrdiff_t stride[3];
};

struct SliceSettings {
    int slice_qp;
    const int8_t* qp;      // of each macroblock
    const int8_t* forced;  // Mode of each macroblock or kAnyMode
    int vertical_reach;
    uint32_t lambda_q8[52];
    uint32_t motion_q8[52];
    Effort effort;
    bool deblocked;  // whether decoders filter the picture
};

class SliceCoder {
public:
    // Rows of macroblocks are shared among `threads`; the bytes do not depend on how many.
    SliceCoder(int width, int height, const Kernels& kernels, int threads = 1);

    int width_mb() const { return width_mb_; }
    int height_mb() const { return height_mb_; }

    // The bytes of slice_data; `references[0]` is reference index 0, none makes an I slice.
    // Reference samples are raised to at least 1, as I_PCM pictures hold them.
    const std::vector<uint8_t>& encode(const Picture& frame, const Picture* references,
                                       int reference_count, const SliceSettings& settings);
    // How a macroblock of the last slice was coded.
    Mode mode(int macroblock) const { return macroblocks_[static_cast<size_t>(macroblock)].mode; }
    // What decoders make of the last slice; width and height in samples of the plane.
    void reconstruction(int plane, uint8_t* out, ptrdiff_t stride, int width, int height) const;

private:
    struct Padded {
        std::vector<uint8_t> samples;
        ptrdiff_t stride = 0;
        int border = 0;
        void resize(int width, int height, int border_samples);
        uint8_t* at() { return samples.data() + border * stride + border; }
    };

    void take(const Picture& from, int plane, uint8_t least, Padded& to) const;
    Reference reference(const Picture& from, int index);
    // A job of both passes but for the settings; takes the pictures.
    SliceJob begin(const Picture& frame, const Picture* references, int reference_count);
    size_t encode_once(SliceJob& job, bool* again);
    void over_rows(const SliceJob& job, void (*row)(const SliceJob&, int));

    int width_, height_, width_mb_, height_mb_;
    const Kernels& kernels_;
    ThreadPool pool_;
    Wavefront wavefront_;
    Padded frame_[3];
    Padded luma_[kMaxReferences][4];
    Padded chroma_[kMaxReferences][2];
    Padded reconstruction_[3];
    std::vector<Neighbour> macroblocks_;
    std::vector<int8_t> forced_;
    std::vector<uint64_t> coded_, contexts_;  // of the kernels' own types
    std::vector<uint8_t> out_;
};

}  // namespace rfcore::h264
