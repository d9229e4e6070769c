// The two small networks on chunks of 64 samples: rows of 64 floats in, rows of 64 floats out.
//
// Every sum runs over the inputs (or, for the gradients of the matrices, over the samples) in
// ascending order, one fused multiply-add each, so the tiling changes no bit.
#pragma once

#include "ngp/encode.h"
#include "simd/math.h"

namespace {

using Row = float[kChunk];
constexpr int kVectors = kChunk / kLanes;

// Two wide tiles keep AVX-512's 32 registers busy; AVX2 has 16 half as wide.
template <int kRows>
RF_INLINE void multiply_rows(const float* matrix, int stride, int step, int inputs, const Row* in,
                             Row* out, bool relu) {
    Lanes sum[kRows][kVectors];
    for (int o = 0; o < kRows; ++o) {
        for (int v = 0; v < kVectors; ++v) sum[o][v] = zero();
    }
    for (int k = 0; k < inputs; ++k) {
        Lanes x[kVectors];
        for (int v = 0; v < kVectors; ++v) x[v] = load(in[k] + v * kLanes);
        for (int o = 0; o < kRows; ++o) {
            const Lanes w = splat(matrix[static_cast<size_t>(o) * stride + k * step]);
            for (int v = 0; v < kVectors; ++v) sum[o][v] = fma(w, x[v], sum[o][v]);
        }
    }
    for (int o = 0; o < kRows; ++o) {
        for (int v = 0; v < kVectors; ++v) {
            store(out[o] + v * kLanes, relu ? max(sum[o][v], zero()) : sum[o][v]);
        }
    }
}

// out[o] = sum over k of matrix[o stride + k step] in[k], for all outputs.
static void multiply(const float* matrix, int stride, int step, int outputs, int inputs,
                     const Row* in, Row* out, bool relu) {
    int o = 0;
    const auto at = [&](int row) { return matrix + static_cast<size_t>(row) * stride; };
    for (; o + 6 <= outputs; o += 6) {
        multiply_rows<6>(at(o), stride, step, inputs, in, out + o, relu);
    }
    for (; o + 2 <= outputs; o += 2) {
        multiply_rows<2>(at(o), stride, step, inputs, in, out + o, relu);
    }
    if (o < outputs) multiply_rows<1>(at(o), stride, step, inputs, in, out + o, relu);
}

// Activations of one chunk, kept for the way back.
struct alignas(64) Activations {
    Row density_hidden[kMaxHidden];
    Row colour_in[kColourInputs];  // harmonics, then the outputs of the density network
    Row colour_hidden[2][kMaxHidden];
    Row raw_colour[3];
};

// 1 - exp(-t) for t >= 0, accurate relative to itself: for a thin sample, subtracting would leave
// no correct digit. The series is good to 5e-8 where it is used.
RF_INLINE Lanes one_minus_exp(Lanes t) {
    const Lanes one = splat(1.0f);
    Lanes series = fma(t, splat(-1.0f / 720.0f), splat(1.0f / 120.0f));
    series = fma(t, series, splat(-1.0f / 24.0f));
    series = fma(t, series, splat(1.0f / 6.0f));
    series = fma(t, series, splat(-0.5f));
    series = t * fma(t, series, one);
    return select(gt(splat(0.25f), t), series, one - exp2_accurate(t * splat(-kLog2E)));
}

RF_INLINE void density_network(const Network& n, Chunk* chunk, Activations* a) {
    multiply(n.matrices[0], n.encoded, 1, n.hidden, n.encoded, chunk->encoded, a->density_hidden,
             true);
    multiply(n.matrices[1], n.hidden, 1, kGeometry, n.hidden, a->density_hidden,
             a->colour_in + kHarmonics, false);
    for (int s = 0; s < kChunk; s += kLanes) {
        const Lanes raw = load(a->colour_in[kHarmonics] + s);
        const Lanes density = exp2_accurate(min(raw, splat(kMaxLogDensity)) * splat(kLog2E));
        store(chunk->raw_density + s, raw);
        store(chunk->density + s, density);
        store(chunk->alpha + s, one_minus_exp(density * load(chunk->step + s)));
    }
}

RF_INLINE void colour_network(const Network& n, Chunk* chunk, Activations* a) {
    for (int s = 0; s < kChunk; s += kLanes) {
        Lanes basis[kHarmonics];
        sh_basis<3>(load(chunk->direction[0] + s), load(chunk->direction[1] + s),
                    load(chunk->direction[2] + s), basis);
        for (int k = 0; k < kHarmonics; ++k) store(a->colour_in[k] + s, basis[k]);
    }
    multiply(n.matrices[2], kColourInputs, 1, n.hidden, kColourInputs, a->colour_in,
             a->colour_hidden[0], true);
    multiply(n.matrices[3], n.hidden, 1, n.hidden, n.hidden, a->colour_hidden[0],
             a->colour_hidden[1], true);
    multiply(n.matrices[4], n.hidden, 1, 3, n.hidden, a->colour_hidden[1], a->raw_colour, false);
    for (int c = 0; c < 3; ++c) {
        for (int s = 0; s < kChunk; s += kLanes) {
            store(chunk->colour[c] + s, sigmoid(load(a->raw_colour[c] + s)));
        }
    }
}

static void evaluate(const Field& field, Chunk* chunks, int count, Activations* scratch) {
    encode(field, chunks, count);
    for (int c = 0; c < count; ++c) {
        density_network(field.network, chunks + c, scratch);
        colour_network(field.network, chunks + c, scratch);
    }
}

// `kBlocks` times 16 inputs, samples first: by_sample[s][b] holds inputs 16 b .. 16 b + 15.
template <int kBlocks>
RF_INLINE void turn(const Row* in, Lanes (*by_sample)[kBlocks]) {
    for (int b = 0; b < kBlocks; ++b) {
        for (int v = 0; v < kVectors; ++v) {
            alignas(64) float rows[kLanes * kLanes];
            Lanes turned[kLanes];
            for (int i = 0; i < kLanes; ++i) {
                store(rows + i * kLanes, load(in[b * kLanes + i] + v * kLanes));
            }
            transpose(rows, turned);
            for (int i = 0; i < kLanes; ++i) by_sample[v * kLanes + i][b] = turned[i];
        }
    }
}

// gradient[o][k] += sum over samples of d_out[o] in[k], 16 kBlocks inputs and kRows outputs.
template <int kBlocks, int kRows>
RF_INLINE void add_outer(const Row* d_out, const Lanes (*by_sample)[kBlocks], float* gradient,
                         int stride) {
    Lanes sum[kRows][kBlocks];
    for (int o = 0; o < kRows; ++o) {
        for (int b = 0; b < kBlocks; ++b) sum[o][b] = zero();
    }
    for (int s = 0; s < kChunk; ++s) {
        for (int o = 0; o < kRows; ++o) {
            const Lanes d = splat(d_out[o][s]);
            for (int b = 0; b < kBlocks; ++b) sum[o][b] = fma(d, by_sample[s][b], sum[o][b]);
        }
    }
    for (int o = 0; o < kRows; ++o) {
        float* to = gradient + static_cast<size_t>(o) * stride;
        for (int b = 0; b < kBlocks; ++b) {
            store(to + b * kLanes, load(to + b * kLanes) + sum[o][b]);
        }
    }
}

template <int kBlocks>
RF_INLINE void add_columns(const Row* d_out, int outputs, const Row* in, float* gradient,
                           int stride) {
    Lanes by_sample[kChunk][kBlocks];
    turn<kBlocks>(in, by_sample);
    int o = 0;
    for (; o + 8 <= outputs; o += 8) {
        add_outer<kBlocks, 8>(d_out + o, by_sample, gradient + static_cast<size_t>(o) * stride,
                              stride);
    }
    for (; o < outputs; ++o) {
        add_outer<kBlocks, 1>(d_out + o, by_sample, gradient + static_cast<size_t>(o) * stride,
                              stride);
    }
}

static void add_matrix_gradient(const Row* d_out, int outputs, const Row* in, int inputs,
                                float* gradient) {
    int k = 0;
    for (; k + 2 * kLanes <= inputs; k += 2 * kLanes) {
        add_columns<2>(d_out, outputs, in + k, gradient + k, inputs);
    }
    if (k < inputs) add_columns<1>(d_out, outputs, in + k, gradient + k, inputs);
}

// Zero the gradient where the activation was clipped.
RF_INLINE void mask_relu(const Row* activation, Row* gradient, int rows) {
    for (int k = 0; k < rows; ++k) {
        for (int s = 0; s < kChunk; s += kLanes) {
            const Mask open = gt(load(activation[k] + s), zero());
            store(gradient[k] + s, keep(open, load(gradient[k] + s)));
        }
    }
}

struct alignas(64) Cotangents {
    Row hidden[2][kMaxHidden];
    Row colour_in[kColourInputs];
    Row raw_colour[3];
};

// One matrix on the way back: its own gradient, then that of its inputs (null: not wanted).
RF_INLINE void back_through(const Network& n, int m, const Row* d_out, const Row* in, Row* d_in,
                            float** gradients) {
    const int outputs = outputs_of(m, n.hidden), inputs = inputs_of(m, n.hidden, n.encoded);
    add_matrix_gradient(d_out, outputs, in, inputs, gradients[m]);
    multiply(n.matrices[m], 1, inputs, inputs, outputs, d_out, d_in, false);
}

// From d_colour (in chunk->colour) and d_raw_density (in chunk->raw_density) to the gradients of
// the matrices, and of the encoding, which replaces it. `a` is filled anew.
static void network_backward(const Network& n, Chunk* chunk, Activations* a, Cotangents* d,
                             float** gradients) {
    alignas(64) Row d_colour[3], d_raw_density;
    memcpy(d_colour, chunk->colour, sizeof d_colour);
    memcpy(d_raw_density, chunk->raw_density, sizeof d_raw_density);
    density_network(n, chunk, a);
    colour_network(n, chunk, a);
    for (int c = 0; c < 3; ++c) {
        for (int s = 0; s < kChunk; s += kLanes) {
            const Lanes y = load(chunk->colour[c] + s);
            store(d->raw_colour[c] + s, load(d_colour[c] + s) * y * (splat(1.0f) - y));
        }
    }
    back_through(n, 4, d->raw_colour, a->colour_hidden[1], d->hidden[1], gradients);
    mask_relu(a->colour_hidden[1], d->hidden[1], n.hidden);
    back_through(n, 3, d->hidden[1], a->colour_hidden[0], d->hidden[0], gradients);
    mask_relu(a->colour_hidden[0], d->hidden[0], n.hidden);
    back_through(n, 2, d->hidden[0], a->colour_in, d->colour_in, gradients);
    Row* d_geometry = d->colour_in + kHarmonics;
    for (int s = 0; s < kChunk; s += kLanes) {
        store(d_geometry[0] + s, load(d_geometry[0] + s) + load(d_raw_density + s));
    }
    back_through(n, 1, d_geometry, a->density_hidden, d->hidden[0], gradients);
    mask_relu(a->density_hidden, d->hidden[0], n.hidden);
    Row d_encoded[kMaxEncoded];
    back_through(n, 0, d->hidden[0], chunk->encoded, d_encoded, gradients);
    memcpy(chunk->encoded, d_encoded, sizeof(Row) * static_cast<size_t>(n.encoded));
}

}  // namespace
