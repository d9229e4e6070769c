// Carries one picture to another pose and writes every byte that came of it, for
// test_aarch64_warp.py to compare with the bytes of the machine that runs the tests.
//
// usage: exactness_warp ISA THREADS SCENE RESULT (the first two are as for the other programs;
// the compiler alone vectorises here)
//
// SCENE: int32 width, height, doubt; float rotation[9], translation[3], fx, fy, cx, cy; bytes Y, U, V
// of the previous picture, of the render and of the previous render; float previous depth, depth.
// RESULT: bytes Y, U, V carried, corrected and relit; int32 SATD and SSD of the previous picture's blocks
// against the render.
#include "exactness_file.h"
#include "picture/light_grid.h"
#include "picture/warp.h"

namespace {

using namespace rfcore;

struct Planes {
    std::vector<std::uint8_t> y, u, v;

    Planes(PictureSize size)
        : y(static_cast<size_t>(size.width_px) * size.height_px),
          u(static_cast<size_t>((size.width_px + 1) / 2) * ((size.height_px + 1) / 2)),
          v(u.size()) {}
    ConstI420Planes view() const { return {y.data(), u.data(), v.data()}; }
    I420Planes out() { return {y.data(), u.data(), v.data()}; }
};

Planes read_planes(File& in, PictureSize size) {
    Planes planes(size);
    planes.y = in.read<std::uint8_t>(planes.y.size());
    planes.u = in.read<std::uint8_t>(planes.u.size());
    planes.v = in.read<std::uint8_t>(planes.v.size());
    return planes;
}

void write_planes(File& out, const Planes& planes) {
    for (const auto* plane : {&planes.y, &planes.u, &planes.v}) out.write(*plane);
}

void run(const char* scene, const char* result) {
    File in(scene, "rb"), out(result, "wb");
    const auto header = in.read<std::int32_t>(3);
    const PictureSize size{header[0], header[1]};
    const auto geometry = in.read<WarpGeometry>(1);
    const Planes previous = read_planes(in, size), render = read_planes(in, size);
    const Planes previous_render = read_planes(in, size);
    const auto previous_depth = in.read<float>(previous.y.size());
    const auto depth = in.read<float>(previous.y.size());
    Planes carried(size), corrected(size);
    const WarpInputs plain{previous.view(), previous_depth.data(), depth.data(),
                           render.view(),   {nullptr, nullptr, nullptr}, 0};
    warp_i420(plain, geometry[0], size, carried.out());
    WarpInputs correction = plain;
    correction.previous_render = previous_render.view();
    correction.doubt = header[2];
    warp_i420(correction, geometry[0], size, corrected.out());
    Planes relit(size);
    relight_i420(previous.view(), previous_render.view(), render.view(), size, relit.out());
    for (const Planes* made : {&carried, &corrected, &relit}) write_planes(out, *made);
    const size_t blocks = static_cast<size_t>(size.width_px / 8) * (size.height_px / 8);
    std::vector<std::int32_t> satd(blocks), ssd(blocks);
    block_costs(previous.y.data(), render.y.data(), size, satd.data(), ssd.data());
    out.write(satd);
    out.write(ssd);
}

}  // namespace

int main(int argc, char** argv) {
    try {
        if (argc != 5) throw std::runtime_error("usage: exactness_warp ISA THREADS SCENE RESULT");
        run(argv[3], argv[4]);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "exactness_warp: %s\n", error.what());
        return 1;
    }
    return 0;
}
