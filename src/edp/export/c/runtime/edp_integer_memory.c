/* Integer arithmetic: layers that carry numbers from tick to tick. */
#include "edp_integer.h"

#include <stddef.h>

#define CELL_LIMIT 1073741824 /* 2^30 */

static int32_t cell(int64_t x) {
    return (int32_t)((x > CELL_LIMIT) ? CELL_LIMIT : ((x < -CELL_LIMIT) ? -CELL_LIMIT : x));
}

static int64_t rounded64(int64_t x, uint32_t right) { return ((x >> (right - 1u)) + 1) >> 1; }

static uint32_t next_row(uint32_t at, uint32_t length) { return (at + 1u < length) ? (at + 1u) : 0u; }

void edp_q_difference(const int16_t *x, const int16_t *factor, uint32_t n, bool from_zero, uint32_t right,
                      int16_t *before, edp_ring *ring, int16_t *y) {
    const bool first = (ring->seen == 0u) && !from_zero;
    for (uint32_t i = 0; i < n; i++) {
        const int32_t change = first ? 0 : ((int32_t)x[i] - before[i]);
        y[i] = edp_q_narrow(edp_q_rounded(factor[i] * change, right));
        before[i] = x[i];
    }
    ring->seen = 1u;
}

void edp_q_convolution(const int16_t *x, const edp_q_matrix *w, const int32_t *bias, uint32_t out, uint32_t taps,
                       uint32_t in, uint32_t dilation, int16_t *past, edp_ring *ring, int32_t *sums, int16_t *y) {
    const uint32_t length = (taps - 1u) * dilation;
    edp_q_copy32(bias, out, sums);
    for (uint32_t tap = 0; tap + 1u < taps; tap++) {
        const uint32_t row = (ring->at + tap * dilation) % length;
        edp_q_products(past + row * in, w->weight + tap * out * in, out, in, sums);
    }
    edp_q_products(x, w->weight + (taps - 1u) * out * in, out, in, sums);
    for (uint32_t o = 0; o < out; o++) {
        y[o] = edp_q_narrow(edp_q_scaled(sums[o], w->multiplier[o], w->shift[o]));
    }
    edp_q_copy16(x, in, past + ring->at * in);
    ring->at = next_row(ring->at, length);
}

void edp_q_lstm(const int16_t *x, const edp_q_recurrent *w, uint32_t in, uint32_t units, int16_t *h, int32_t *c,
                int32_t *gates, int16_t *y) {
    const uint32_t wide = 4u * units;
    int32_t *const back = gates + wide;
    edp_q_gates(x, &w->x, wide, in, gates);
    edp_q_gates(h, &w->h, wide, units, back);
    for (uint32_t i = 0; i < wide; i++) {
        gates[i] += w->bias[i] + back[i];
    }
    for (uint32_t i = 0; i < units; i++) {
        const int32_t input = edp_q_sigmoid(gates[i]);
        const int32_t forget = edp_q_sigmoid(gates[units + i]);
        const int32_t fresh = edp_q_tanh(gates[2u * units + i], 16u);
        const int64_t sum = (int64_t)forget * c[i] + (int64_t)input * fresh * 32;
        const int32_t next = cell(rounded64(sum, 15u));
        const int32_t shown = edp_q_rounded(edp_q_sigmoid(gates[3u * units + i]) * edp_q_tanh(next, 20u), 15u);
        c[i] += (int32_t)rounded64((int64_t)w->share * ((int64_t)next - c[i]), 15u);
        h[i] = (int16_t)(h[i] + (int32_t)rounded64((int64_t)w->share * (shown - h[i]), 15u));
        y[i] = h[i];
    }
}

void edp_q_gru(const int16_t *x, const edp_q_recurrent *w, uint32_t in, uint32_t units, int16_t *h, int32_t *gates,
               int16_t *y) {
    const uint32_t wide = 3u * units;
    int32_t *const back = gates + wide;
    edp_q_gates(x, &w->x, wide, in, gates);
    edp_q_gates(h, &w->h, wide, units, back);
    for (uint32_t i = 0; i < wide; i++) {
        gates[i] += w->bias[i];
        back[i] += w->bias_h[i];
    }
    for (uint32_t i = 0; i < units; i++) {
        const int32_t reset = edp_q_sigmoid(gates[i] + back[i]);
        const int32_t keep = edp_q_sigmoid(gates[units + i] + back[units + i]);
        const int32_t part = (int32_t)rounded64((int64_t)reset * back[2u * units + i], 15u);
        const int32_t fresh = edp_q_tanh(gates[2u * units + i] + part, 16u);
        h[i] = (int16_t)(fresh + edp_q_rounded(keep * (h[i] - fresh), 15u));
        y[i] = h[i];
    }
}

void edp_q_min_gru(const int16_t *x, uint32_t units, int32_t given, int32_t *h, int16_t *y) {
    for (uint32_t i = 0; i < units; i++) {
        const int32_t z = edp_q_sigmoid(edp_q_gate(x[i], given));
        const int64_t change = (int64_t)x[units + i] * 16384 - h[i];
        h[i] += (int32_t)rounded64(z * change, 15u);
        y[i] = edp_q_narrow(edp_q_rounded(h[i], 14u));
    }
}

void edp_q_rotation(const int16_t *x, const int32_t *factor, uint32_t states, uint32_t left, uint32_t right, int32_t *h,
                    int16_t *y) {
    const int64_t unit = (int64_t)1 << left;
    for (uint32_t i = 0; i < 2u * states; i += 2u) {
        const int64_t re = h[i];
        const int64_t im = h[i + 1u];
        h[i] = cell(rounded64(factor[i] * re - factor[i + 1u] * im, 30u) + x[i] * unit);
        h[i + 1u] = cell(rounded64(factor[i] * im + factor[i + 1u] * re, 30u) + x[i + 1u] * unit);
        y[i] = edp_q_narrow(edp_q_rounded(h[i], right));
        y[i + 1u] = edp_q_narrow(edp_q_rounded(h[i + 1u], right));
    }
}

/* Brings a ring of `window - 1` ticks on; after this tick, `seen` of its rows and the present are in the window. */
static void bring_on(edp_ring *ring, uint32_t window) {
    if (window > 1u) {
        ring->at = next_row(ring->at, window - 1u);
    }
    if (ring->seen + 1u < window) {
        ring->seen++;
    }
}

void edp_q_trailing_mean(const int16_t *x, uint32_t n, uint32_t window, int16_t *past, edp_ring *ring, int16_t *y) {
    const int32_t count = (int32_t)ring->seen + 1;
    for (uint32_t i = 0; i < n; i++) {
        int32_t sum = x[i];
        for (uint32_t row = 0; row + 1u < window; row++) {
            sum += past[row * n + i];
        }
        const int32_t size = ((sum < 0) ? -sum : sum) + count / 2;
        y[i] = (int16_t)((sum < 0) ? -(size / count) : (size / count));
    }
    if (window > 1u) {
        edp_q_copy16(x, n, past + ring->at * n);
    }
    bring_on(ring, window);
}

void edp_q_attention_pool(const int16_t *x, const edp_q_matrix *score, uint32_t n, uint32_t window, int16_t *past,
                          int32_t *scores, edp_ring *ring, int32_t *weights, int16_t *y) {
    /* The order of the ticks does not matter to a weighted mean, so the ring is read as it lies. */
    int32_t own = 0;
    edp_q_gates(x, score, 1u, n, &own);
    edp_q_copy32(scores, ring->seen, weights);
    weights[ring->seen] = own;
    edp_q_softmax(weights, ring->seen + 1u);
    uint32_t i = 0;
    for (; i + 4u <= n; i += 4u) {
        const int16_t *from = past + i;
        int32_t a0 = weights[ring->seen] * x[i];
        int32_t a1 = weights[ring->seen] * x[i + 1u];
        int32_t a2 = weights[ring->seen] * x[i + 2u];
        int32_t a3 = weights[ring->seen] * x[i + 3u];
        for (uint32_t row = 0; row < ring->seen; row++) {
            const int32_t weight = weights[row];
            a0 += weight * from[0];
            a1 += weight * from[1];
            a2 += weight * from[2];
            a3 += weight * from[3];
            from = &from[n];
        }
        y[i] = edp_q_narrow(edp_q_rounded(a0, 15u));
        y[i + 1u] = edp_q_narrow(edp_q_rounded(a1, 15u));
        y[i + 2u] = edp_q_narrow(edp_q_rounded(a2, 15u));
        y[i + 3u] = edp_q_narrow(edp_q_rounded(a3, 15u));
    }
    for (; i < n; i++) {
        int32_t sum = weights[ring->seen] * x[i];
        for (uint32_t row = 0; row < ring->seen; row++) {
            sum += weights[row] * past[row * n + i];
        }
        y[i] = edp_q_narrow(edp_q_rounded(sum, 15u));
    }
    if (window > 1u) {
        edp_q_copy16(x, n, past + ring->at * n);
        scores[ring->at] = own;
    }
    bring_on(ring, window);
}
