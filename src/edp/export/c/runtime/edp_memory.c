/* Layers that carry numbers from tick to tick. */
#include "edp_runtime.h"

#include <math.h>
#include <stddef.h>

static float dot(const float *a, const float *b, uint32_t n) {
    float sum = 0.0f;
    for (uint32_t i = 0; i < n; i++) {
        sum += a[i] * b[i];
    }
    return sum;
}

static uint32_t after(uint32_t at, uint32_t length) { return (at + 1u < length) ? (at + 1u) : 0u; }

void edp_difference(const float *x, const float *factor, uint32_t n, bool from_zero, float *before, edp_ring *ring,
                    float *y) {
    const bool first = (ring->seen == 0u) && !from_zero;
    for (uint32_t i = 0; i < n; i++) {
        const float change = first ? 0.0f : (x[i] - before[i]);
        y[i] = factor[i] * change;
        before[i] = x[i];
    }
    ring->seen = 1u;
}

void edp_starting(const float *x, const float *mean, uint32_t n, uint32_t ticks, edp_ring *ring, float *y) {
    const bool read = ring->seen < ticks;
    edp_copy(read ? x : mean, n, y);
    y[n] = read ? 1.0f : 0.0f;
    if (read) {
        ring->seen++;
    }
}

void edp_convolution(const float *x, const float *weight, const float *bias, uint32_t out, uint32_t taps, uint32_t in,
                     uint32_t dilation, float *past, edp_ring *ring, float *y) {
    const uint32_t length = (taps - 1u) * dilation;
    edp_copy(bias, out, y);
    for (uint32_t tap = 0; tap + 1u < taps; tap++) {
        const uint32_t row = (ring->at + tap * dilation) % length;
        edp_product(past + row * in, weight, tap * in, taps * in, out, in, y);
    }
    edp_product(x, weight, (taps - 1u) * in, taps * in, out, in, y);
    edp_copy(x, in, past + ring->at * in);
    ring->at = after(ring->at, length);
}

/* Gates to the new state; `work` holds units numbers. */
static void lstm_cell(const float *gates, uint32_t units, float share, const edp_lstm_norms *norms, float *work,
                      float *h, float *c) {
    for (uint32_t i = 0; i < units; i++) {
        const float input = edp_sigmoid(gates[i]);
        const float forget = edp_sigmoid(gates[units + i]);
        work[i] = forget * c[i] + input * edp_tanh(gates[2u * units + i]);
        c[i] += share * (work[i] - c[i]);
    }
    if (norms != NULL) {
        edp_layer_norm(work, norms->gain_c, norms->shift_c, norms->epsilon, 1u, units, work);
    }
    for (uint32_t i = 0; i < units; i++) {
        h[i] += share * (edp_sigmoid(gates[3u * units + i]) * edp_tanh(work[i]) - h[i]);
    }
}

void edp_lstm(const float *x, const edp_lstm_weights *w, uint32_t in, uint32_t units, float *h, float *c, float *gates,
              float *y) {
    edp_copy(w->bias, 4u * units, gates);
    edp_product(x, w->weight_x, 0u, in, 4u * units, in, gates);
    edp_product(h, w->weight_h, 0u, units, 4u * units, units, gates);
    lstm_cell(gates, units, w->share, NULL, y, h, c);
    edp_copy(h, units, y);
}

void edp_layer_norm_lstm(const float *x, const edp_lstm_weights *w, const edp_lstm_norms *norms, uint32_t in,
                         uint32_t units, float *h, float *c, float *gates, float *y) {
    const uint32_t wide = 4u * units;
    float *const back = gates + wide;

    edp_fill(0.0f, 2u * wide, gates);
    edp_product(x, w->weight_x, 0u, in, wide, in, gates);
    edp_layer_norm(gates, norms->gain_x, w->bias, norms->epsilon, 1u, wide, gates);
    edp_product(h, w->weight_h, 0u, units, wide, units, back);
    edp_layer_norm(back, norms->gain_h, gates, norms->epsilon, 1u, wide, gates);
    lstm_cell(gates, units, w->share, norms, y, h, c);
    edp_copy(h, units, y);
}

void edp_gru(const float *x, const edp_gru_weights *w, uint32_t in, uint32_t units, float *h, float *gates, float *y) {
    const uint32_t wide = 3u * units;
    float *const back = gates + wide;
    edp_copy(w->bias_x, wide, gates);
    edp_copy(w->bias_h, wide, back);
    edp_product(x, w->weight_x, 0u, in, wide, in, gates);
    edp_product(h, w->weight_h, 0u, units, wide, units, back);
    for (uint32_t i = 0; i < units; i++) {
        const float reset = edp_sigmoid(gates[i] + back[i]);
        const float keep = edp_sigmoid(gates[units + i] + back[units + i]);
        const float fresh = edp_tanh(gates[2u * units + i] + reset * back[2u * units + i]);
        h[i] = fresh + keep * (h[i] - fresh);
    }
    edp_copy(h, units, y);
}

void edp_min_gru(const float *x, uint32_t units, float *h, float *y) {
    for (uint32_t i = 0; i < units; i++) {
        const float z = edp_sigmoid(x[i]);
        h[i] = (1.0f - z) * h[i] + z * x[units + i];
        y[i] = h[i];
    }
}

void edp_rotation(const float *x, const float *factor, uint32_t states, float *h, float *y) {
    for (uint32_t i = 0; i < 2u * states; i += 2u) {
        const float re = h[i];
        const float im = h[i + 1u];
        h[i] = factor[i] * re - factor[i + 1u] * im + x[i];
        h[i + 1u] = factor[i] * im + factor[i + 1u] * re + x[i + 1u];
        y[i] = h[i];
        y[i + 1u] = h[i + 1u];
    }
}

/* Brings a ring of `window - 1` ticks on; after this tick, `seen` of its rows and the present are in the window. */
static void advance(edp_ring *ring, uint32_t window) {
    if (window > 1u) {
        ring->at = after(ring->at, window - 1u);
    }
    if (ring->seen + 1u < window) {
        ring->seen++;
    }
}

void edp_trailing_mean(const float *x, uint32_t n, uint32_t window, float *past, edp_ring *ring, float *y) {
    /* A sum of the whole ring at each tick: a running sum would drift over hours. Rows not yet seen are zero. */
    edp_copy(x, n, y);
    for (uint32_t row = 0; row + 1u < window; row++) {
        for (uint32_t i = 0; i < n; i++) {
            y[i] += past[row * n + i];
        }
    }
    const uint32_t count = ring->seen + 1u;
    for (uint32_t i = 0; i < n; i++) {
        y[i] /= (float)count;
    }
    if (window > 1u) {
        edp_copy(x, n, past + ring->at * n);
    }
    advance(ring, window);
}

/* Eight columns of `weigh`, whose sums stay in registers. */
static void weigh_eight(const float *present, const float *past, const float *weights, uint32_t seen, uint32_t stride,
                        float *y) {
    const float own = weights[seen];
    const float *from = past;
    float a0 = own * present[0];
    float a1 = own * present[1];
    float a2 = own * present[2];
    float a3 = own * present[3];
    float a4 = own * present[4];
    float a5 = own * present[5];
    float a6 = own * present[6];
    float a7 = own * present[7];
    for (uint32_t row = 0; row < seen; row++) {
        const float weight = weights[row];
        a0 += weight * from[0];
        a1 += weight * from[1];
        a2 += weight * from[2];
        a3 += weight * from[3];
        a4 += weight * from[4];
        a5 += weight * from[5];
        a6 += weight * from[6];
        a7 += weight * from[7];
        from = &from[stride];
    }
    y[0] = a0;
    y[1] = a1;
    y[2] = a2;
    y[3] = a3;
    y[4] = a4;
    y[5] = a5;
    y[6] = a6;
    y[7] = a7;
}

/* Sum of the rows seen of a ring and of the present, each times its weight; the present has the last one. */
static void weigh(const float *present, const float *past, const float *weights, uint32_t seen, uint32_t stride,
                  uint32_t n, float *y) {
    uint32_t i = 0;
    for (; i + 8u <= n; i += 8u) {
        weigh_eight(present + i, past + i, weights, seen, stride, y + i);
    }
    for (; i < n; i++) {
        float a = weights[seen] * present[i];
        for (uint32_t row = 0; row < seen; row++) {
            a += weights[row] * past[row * stride + i];
        }
        y[i] = a;
    }
}

void edp_attention_pool(const float *x, const float *score, float bias, uint32_t n, uint32_t window, float *past,
                        float *scores, edp_ring *ring, float *weights, float *y) {
    /* The order of the ticks does not matter to a weighted mean, so the ring is read as it lies. */
    const float own = dot(score, x, n) + bias;
    edp_copy(scores, ring->seen, weights);
    weights[ring->seen] = own;
    edp_softmax(weights, ring->seen + 1u);
    weigh(x, past, weights, ring->seen, n, n, y);
    if (window > 1u) {
        edp_copy(x, n, past + ring->at * n);
        scores[ring->at] = own;
    }
    advance(ring, window);
}

void edp_window_attention(const float *q, const float *k, const float *v, uint32_t n, uint32_t heads, uint32_t window,
                          float *keys, float *values, edp_ring *ring, float *weights, float *y) {
    const uint32_t size = n / heads;
    const float root = sqrtf((float)size);
    for (uint32_t head = 0; head < heads; head++) {
        const uint32_t first = head * size;
        for (uint32_t row = 0; row < ring->seen; row++) {
            weights[row] = dot(q + first, keys + row * n + first, size) / root;
        }
        weights[ring->seen] = dot(q + first, k + first, size) / root;
        edp_softmax(weights, ring->seen + 1u);
        weigh(v + first, values + first, weights, ring->seen, n, size, y + first);
    }
    if (window > 1u) {
        edp_copy(k, n, keys + ring->at * n);
        edp_copy(v, n, values + ring->at * n);
    }
    advance(ring, window);
}

bool edp_prefix(const float *x, const edp_prefix_weights *w, uint32_t in, float *total, edp_ring *ring, float *work,
                float *correction) {
    bool due = false;
    if (ring->seen < w->ticks) {
        ring->seen++;
        edp_add(total, x, in, total);
        due = ring->seen == w->ticks;
    }
    if (due) {
        float *const hidden = work + 2u * in;
        for (uint32_t i = 0; i < in; i++) {
            work[i] = total[i] / (float)w->ticks;
            work[in + i] = x[i];
        }
        edp_dense(work, w->first_weight, w->first_bias, 1u, w->hidden, 2u * in, hidden);
        edp_map_tanh(hidden, w->hidden, hidden);
        edp_dense(hidden, w->second_weight, w->second_bias, 1u, w->out, w->hidden, correction);
    }
    return due;
}
