// Codes one picture and writes every byte that came of it, for test_aarch64_slices.py to compare
// with the bytes of the machine that runs the tests.
//
// usage: exactness_slices ISA THREADS SCENE RESULT
//
// SCENE: int32 width, height, references, qp, effort[8], deblocked; uint32 lambda_q8[52], motion_q8[52]; int8
// quantiser of every macroblock; bytes Y, U, V of the picture, then of every reference.
// RESULT: slice data; bytes Y, U, V of the reconstruction.
#include <algorithm>
#include <cstdint>
#include <cstdlib>

#include "exactness_file.h"
#include "h264/slice_coder.h"

namespace {

using namespace rfcore::h264;

struct Planes {
    std::vector<std::uint8_t> samples[3];

    Planes(File& in, int width, int height) : width_(width), height_(height) {
        for (int p = 0; p < 3; ++p) samples[p] = in.read<std::uint8_t>(wide(p) * high(p));
    }
    size_t wide(int p) const { return static_cast<size_t>(p ? (width_ + 1) / 2 : width_); }
    size_t high(int p) const { return static_cast<size_t>(p ? (height_ + 1) / 2 : height_); }
    Picture view() const {
        Picture picture;
        for (int p = 0; p < 3; ++p) {
            picture.plane[p] = samples[p].data();
            picture.stride[p] = static_cast<ptrdiff_t>(wide(p));
        }
        return picture;
    }

  private:
    int width_, height_;
};

void run(const char* isa, int threads, const char* scene, const char* result) {
    File in(scene, "rb"), out(result, "wb");
    const auto header = in.read<std::int32_t>(13);
    const int width = header[0], height = header[1], references = header[2];
    SliceCoder coder(width, height, kernels_for(isa), threads);
    SliceSettings settings = {};
    settings.slice_qp = header[3];
    settings.effort = {header[4], header[5], header[6], header[7], header[8], header[9], header[10], header[11]};
    settings.deblocked = header[12] != 0;
    const auto weights = in.read<std::uint32_t>(104);
    std::copy_n(weights.data(), 52, settings.lambda_q8);
    std::copy_n(weights.data() + 52, 52, settings.motion_q8);
    const auto qp = in.read<std::int8_t>(static_cast<size_t>(coder.width_mb() * coder.height_mb()));
    settings.qp = qp.data();
    const std::vector<std::int8_t> forced(qp.size(), kAnyMode);
    settings.forced = forced.data();
    settings.vertical_reach = 252;
    Planes frame(in, width, height);
    std::vector<Planes> pictures;
    for (int i = 0; i < references; ++i) pictures.emplace_back(in, width, height);
    std::vector<Picture> views;
    for (const Planes& planes : pictures) views.push_back(planes.view());
    out.write(coder.encode(frame.view(), views.data(), references, settings));
    for (int p = 0; p < 3; ++p) {
        coder.reconstruction(p, frame.samples[p].data(), static_cast<ptrdiff_t>(frame.wide(p)),
                             static_cast<int>(frame.wide(p)), static_cast<int>(frame.high(p)));
        out.write(frame.samples[p]);
    }
}

}  // namespace

int main(int argc, char** argv) {
    try {
        if (argc != 5) throw std::runtime_error("usage: exactness_slices ISA THREADS SCENE RESULT");
        run(argv[1], std::atoi(argv[2]), argv[3], argv[4]);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "exactness_slices: %s\n", error.what());
        return 1;
    }
    return 0;
}
