/* Products of a matrix with several lanes, and what is made of them. */
#include "edp_lanes.h"

#define LANES 4u

/* Four rows of a panel and four lanes: sixteen sums in registers, eight numbers read for sixteen products. */
static void tile(const float *x, uint32_t xs, const float *weight, const float *bias, uint32_t in, float *y, uint32_t ys) {
    const float *w = weight;
    const float *const x1 = x + xs;
    const float *const x2 = x1 + xs;
    const float *const x3 = x2 + xs;
    float *const y1 = y + ys;
    float *const y2 = y1 + ys;
    float *const y3 = y2 + ys;
    float a00 = bias[0];
    float a01 = bias[1];
    float a02 = bias[2];
    float a03 = bias[3];
    float a10 = bias[0];
    float a11 = bias[1];
    float a12 = bias[2];
    float a13 = bias[3];
    float a20 = bias[0];
    float a21 = bias[1];
    float a22 = bias[2];
    float a23 = bias[3];
    float a30 = bias[0];
    float a31 = bias[1];
    float a32 = bias[2];
    float a33 = bias[3];
    for (uint32_t i = 0; i < in; i++) {
        const float w0 = w[0];
        const float w1 = w[1];
        const float w2 = w[2];
        const float w3 = w[3];
        const float v0 = x[i];
        const float v1 = x1[i];
        const float v2 = x2[i];
        const float v3 = x3[i];
        a00 += w0 * v0;
        a01 += w1 * v0;
        a02 += w2 * v0;
        a03 += w3 * v0;
        a10 += w0 * v1;
        a11 += w1 * v1;
        a12 += w2 * v1;
        a13 += w3 * v1;
        a20 += w0 * v2;
        a21 += w1 * v2;
        a22 += w2 * v2;
        a23 += w3 * v2;
        a30 += w0 * v3;
        a31 += w1 * v3;
        a32 += w2 * v3;
        a33 += w3 * v3;
        w = &w[EDP_PANEL];
    }
    y[0] = a00;
    y[1] = a01;
    y[2] = a02;
    y[3] = a03;
    y1[0] = a10;
    y1[1] = a11;
    y1[2] = a12;
    y1[3] = a13;
    y2[0] = a20;
    y2[1] = a21;
    y2[2] = a22;
    y2[3] = a23;
    y3[0] = a30;
    y3[1] = a31;
    y3[2] = a32;
    y3[3] = a33;
}

/* A row of its own and four lanes. */
static void line(const float *x, uint32_t xs, const float *weight, float bias, uint32_t in, float *y, uint32_t ys) {
    float a0 = bias;
    float a1 = bias;
    float a2 = bias;
    float a3 = bias;
    for (uint32_t i = 0; i < in; i++) {
        const float w = weight[i];
        a0 += w * x[i];
        a1 += w * x[xs + i];
        a2 += w * x[2u * xs + i];
        a3 += w * x[3u * xs + i];
    }
    y[0] = a0;
    y[ys] = a1;
    y[2u * ys] = a2;
    y[3u * ys] = a3;
}

void edp_dense_lanes(const float *x, uint32_t x_stride, const float *weight, const float *bias, uint32_t out, uint32_t in,
                     float *y, uint32_t y_stride, uint32_t lanes) {
    uint32_t lane = 0;
    for (; lane + LANES <= lanes; lane += LANES) {
        const float *const from = x + lane * x_stride;
        float *const to = y + lane * y_stride;
        uint32_t o = 0;
        for (; o + EDP_PANEL <= out; o += EDP_PANEL) {
            for (uint32_t part = 0; part < EDP_PANEL; part += 4u) {
                tile(from, x_stride, weight + o * in + part, bias + o + part, in, to + o + part, y_stride);
            }
        }
        for (; o < out; o++) {
            line(from, x_stride, weight + o * in, bias[o], in, to + o, y_stride);
        }
    }
    for (; lane < lanes; lane++) {
        edp_dense(x + lane * x_stride, weight, bias, 1u, out, in, y + lane * y_stride);
    }
}

/* The rational function of Eigen and XLA, within 3e-7 of tanh: no branch and one division, where an exponential would
   take twice as long. */
static float squashed(float x) {
    const float b = (x < -7.90531110763549805f) ? -7.90531110763549805f
                                                : ((x > 7.90531110763549805f) ? 7.90531110763549805f : x);
    const float s = b * b;
    float top = s * -2.76076847742355e-16f + 2.00018790482477e-13f;
    top = s * top + -8.60467152213735e-11f;
    top = s * top + 5.12229709037114e-08f;
    top = s * top + 1.48572235717979e-05f;
    top = s * top + 6.37261928875436e-04f;
    top = s * top + 4.89352455891786e-03f;
    float under = s * 1.19825839466702e-06f + 1.18534705686654e-04f;
    under = s * under + 2.26843463243900e-03f;
    under = s * under + 4.89352518554385e-03f;
    return b * top / under;
}

void edp_gru_lanes(const float *x, const edp_gru_weights *w, uint32_t in, uint32_t units, float *h, uint32_t h_stride,
                   float *gates, float *y, uint32_t stride, uint32_t lanes) {
    const uint32_t wide = 3u * units;
    edp_dense_lanes(x, stride, w->weight_x, w->bias_x, wide, in, gates, stride, lanes);
    edp_dense_lanes(h, h_stride, w->weight_h, w->bias_h, wide, units, gates + wide, stride, lanes);
    for (uint32_t lane = 0; lane < lanes; lane++) {
        const float *const own = gates + lane * stride;
        const float *const back = own + wide;
        float *const memory = h + lane * h_stride;
        for (uint32_t i = 0; i < units; i++) {
            const float reset = 0.5f * squashed(0.5f * (own[i] + back[i])) + 0.5f;
            const float keep = 0.5f * squashed(0.5f * (own[units + i] + back[units + i])) + 0.5f;
            const float fresh = squashed(own[2u * units + i] + reset * back[2u * units + i]);
            memory[i] = fresh + keep * (memory[i] - fresh);
        }
        edp_copy(memory, units, y + lane * stride);
    }
}
