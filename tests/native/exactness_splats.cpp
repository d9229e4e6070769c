// Draws and trains one scene of splats and writes every byte that came of it, for
// test_aarch64_splats.py to compare with the bytes of the machine that runs the tests.
//
// usage: exactness_splats ISA THREADS SCENE RESULT
//
// SCENE: int32 count, degree, width, height, steps, antialiased; double camera[16] (make_camera);
// float rates[11]; then float means, quaternions, log_scales, opacity_logits, sh and target
// [H, W, 3].
// RESULT: float colour, depth, opacity; bytes Y, U, V of the colour and RGB of those; double loss
// of every step; float parameters after the last step, in the order of SCENE.
#include <cstdlib>
#include <cstring>

#include "exactness_file.h"
#include "raster/camera.h"
#include "raster/rasterizer.h"
#include "raster/trainable.h"
#include "picture/yuv.h"

namespace {

using namespace rfcore::raster;

struct Parameters {
    int degree;
    std::vector<float> means, quaternions, log_scales, opacity_logits, sh;

    GaussianArrays arrays() const {
        return {means.data(), quaternions.data(), log_scales.data(), opacity_logits.data(),
                sh.data(), static_cast<int>(opacity_logits.size()), degree};
    }
    void write(File& out) const {
        for (const auto* part : {&means, &quaternions, &log_scales, &opacity_logits, &sh}) {
            out.write(*part);
        }
    }
};

struct Scene {
    Camera camera;
    int steps;
    bool antialiased;
    LearningRates rates;
    Parameters parameters;
    std::vector<float> target;
};

Scene read_scene(const char* path) {
    File in(path, "rb");
    const auto header = in.read<int>(6);
    const auto n = static_cast<size_t>(header[0]);
    const auto numbers = in.read<double>(16);
    const auto rates = in.read<float>(11);
    Scene scene{make_camera(numbers.data(), header[2], header[3]), header[4], header[5] != 0, {},
                {},  {}};
    static_assert(sizeof scene.rates == 11 * sizeof(float), "eleven rates");
    std::memcpy(&scene.rates, rates.data(), sizeof scene.rates);
    const auto sh_count = 3 * static_cast<size_t>(coefficients_of(header[1]));
    scene.parameters = {header[1],           in.read<float>(3 * n), in.read<float>(4 * n),
                        in.read<float>(3 * n), in.read<float>(n),     in.read<float>(sh_count * n)};
    scene.target = in.read<float>(3 * static_cast<size_t>(header[2]) * header[3]);
    return scene;
}

void write_yuv(const std::vector<float>& colour, rfcore::PictureSize size, File& out) {
    const auto width = static_cast<size_t>(size.width_px), height = static_cast<size_t>(size.height_px);
    const size_t chroma = ((width + 1) / 2) * ((height + 1) / 2);
    std::vector<std::uint8_t> y(width * height), u(chroma), v(chroma), rgb(3 * width * height);
    if (rfcore::i420_from_colour(colour.data(), size, {y.data(), u.data(), v.data()}) != 0) {
        throw std::runtime_error("the picture is not finite");
    }
    rfcore::rgb_from_i420({y.data(), u.data(), v.data()}, size, rgb.data());
    for (const auto* plane : {&y, &u, &v, &rgb}) out.write(*plane);
}

void draw(const Scene& scene, const Kernels& kernels, int threads, File& out) {
    const size_t pixels = static_cast<size_t>(scene.camera.width) * scene.camera.height;
    std::vector<float> colour(3 * pixels), depth(pixels), opacity(pixels);
    Rasterizer rasterizer(scene.parameters.arrays(), kernels, threads, scene.antialiased);
    rasterizer.render(scene.camera, scene.parameters.degree, colour.data(), depth.data(), opacity.data());
    for (const auto* plane : {&colour, &depth, &opacity}) out.write(*plane);
    write_yuv(colour, {scene.camera.width, scene.camera.height}, out);
}

void train(const Scene& scene, const Kernels& kernels, int threads, File& out) {
    TrainableRasterizer trainable(scene.parameters.arrays(), kernels, threads,
                                  scene.antialiased);
    std::vector<float> colour(scene.target.size());
    std::vector<double> losses;
    for (int step = 0; step < scene.steps; ++step) {
        trainable.forward(scene.camera, trainable.degree(), colour.data(), nullptr, nullptr);
        losses.push_back(trainable.loss(colour.data(), scene.target.data(), 0.2f));
        trainable.backward(colour.data());
        trainable.adam_step(scene.rates);
    }
    out.write(losses);
    Parameters after = scene.parameters;
    trainable.parameters(after.arrays());
    after.write(out);
}

}  // namespace

int main(int argc, char** argv) {
    try {
        if (argc != 5) throw std::runtime_error("usage: exactness_splats ISA THREADS SCENE RESULT");
        const Kernels& kernels = kernels_for(argv[1]);
        const int threads = std::atoi(argv[2]);
        const Scene scene = read_scene(argv[3]);
        File out(argv[4], "wb");
        draw(scene, kernels, threads, out);
        train(scene, kernels, threads, out);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "exactness_splats: %s\n", error.what());
        return 1;
    }
    return 0;
}
