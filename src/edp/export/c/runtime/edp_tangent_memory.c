/* Tangents of layers that carry numbers from tick to tick. */
#include "edp_tangent.h"

#include <math.h>
#include <stddef.h>

void edp_difference_tangent(const float *dx, const float *factor, uint32_t n, bool from_zero, const edp_ring *ring,
                            float *dbefore, edp_directions d, float *dy) {
    const bool first = (ring->seen == 0u) && !from_zero;
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t at = k * d.stride + i;
            dy[at] = first ? 0.0f : (factor[i] * (dx[at] - dbefore[at]));
            dbefore[at] = dx[at];
        }
    }
}

void edp_starting_tangent(const float *dx, uint32_t n, uint32_t ticks, const edp_ring *ring, edp_directions d,
                          float *dy) {
    edp_fill_tangent(n + 1u, d, dy);
    if (ring->seen < ticks) {
        edp_copy_tangent(dx, n, d, dy);
    }
}

void edp_convolution_tangent(const float *dx, const float *weight, uint32_t out, uint32_t taps, uint32_t in,
                             uint32_t dilation, const edp_ring *ring, float *dpast, edp_directions d, float *dy) {
    const uint32_t length = (taps - 1u) * dilation;
    edp_fill_tangent(out, d, dy);
    for (uint32_t k = 0; k < d.count; k++) {
        const float *const from = dx + k * d.stride;
        float *const past = dpast + k * d.stride;
        float *const to = dy + k * d.stride;
        for (uint32_t tap = 0; tap + 1u < taps; tap++) {
            const uint32_t row = (ring->at + tap * dilation) % length;
            edp_product(past + row * in, weight, tap * in, taps * in, out, in, to);
        }
        edp_product(from, weight, (taps - 1u) * in, taps * in, out, in, to);
        edp_copy(from, in, past + ring->at * in);
    }
}

void edp_lstm_gates_tangent(const float *dx, const float *dh, const edp_lstm_weights *w, uint32_t in, uint32_t units,
                            edp_directions d, float *dgates) {
    edp_fill_tangent(4u * units, d, dgates);
    for (uint32_t k = 0; k < d.count; k++) {
        float *const to = dgates + k * d.stride;
        edp_product(dx + k * d.stride, w->weight_x, 0u, in, 4u * units, in, to);
        edp_product(dh + k * d.stride, w->weight_h, 0u, units, 4u * units, units, to);
    }
}

void edp_layer_norm_gates_tangent(const float *x, const float *dx, const float *h, const float *dh,
                                  const edp_lstm_weights *w, const edp_lstm_norms *norms, uint32_t in, uint32_t units,
                                  float *gates, edp_directions d, float *dgates) {
    const uint32_t wide = 4u * units;
    edp_fill(0.0f, 2u * wide, gates);
    edp_product(x, w->weight_x, 0u, in, wide, in, gates);
    edp_product(h, w->weight_h, 0u, units, wide, units, gates + wide);
    edp_dense_tangent(dx, w->weight_x, 1u, wide, in, d, dgates);
    edp_dense_tangent(dh, w->weight_h, 1u, wide, units, d, dgates + wide);
    edp_layer_norm_tangent(gates, dgates, norms->gain_x, norms->epsilon, 1u, wide, d, dgates);
    edp_layer_norm_tangent(gates + wide, dgates + wide, norms->gain_h, norms->epsilon, 1u, wide, d, dgates + wide);
    edp_add_tangent(dgates, dgates + wide, wide, d, dgates);
}

void edp_lstm_cell_tangent(const float *gates, uint32_t units, float share, const edp_lstm_norms *norms, float *old,
                           float *dgates, float *dh, float *dc, edp_directions d, float *dy) {
    /* Changes of the fresh cell take the places of those of the first gate, which nobody reads any more. */
    for (uint32_t i = 0; i < units; i++) {
        const float input = edp_sigmoid(gates[i]);
        const float forget = edp_sigmoid(gates[units + i]);
        const float fresh = edp_tanh(gates[2u * units + i]);
        for (uint32_t k = 0; k < d.count; k++) {
            float *const dg = dgates + k * d.stride + i;
            float *const cell = dc + k * d.stride + i;
            const float kept = forget * *cell + old[i] * forget * (1.0f - forget) * dg[units];
            const float taken = fresh * input * (1.0f - input) * dg[0] + input * (1.0f - fresh * fresh) * dg[2u * units];
            dg[0] = kept + taken;
            *cell += share * (dg[0] - *cell);
        }
        old[i] = forget * old[i] + input * fresh;
    }
    if (norms != NULL) {
        edp_layer_norm_tangent(old, dgates, norms->gain_c, norms->epsilon, 1u, units, d, dgates);
        edp_layer_norm(old, norms->gain_c, norms->shift_c, norms->epsilon, 1u, units, old);
    }
    for (uint32_t i = 0; i < units; i++) {
        const float output = edp_sigmoid(gates[3u * units + i]);
        const float squashed = edp_tanh(old[i]);
        for (uint32_t k = 0; k < d.count; k++) {
            const float *const dg = dgates + k * d.stride + i;
            float *const state = dh + k * d.stride + i;
            const float gated = squashed * output * (1.0f - output) * dg[3u * units];
            *state += share * (gated + output * (1.0f - squashed * squashed) * dg[0] - *state);
            dy[k * d.stride + i] = *state;
        }
    }
}

void edp_gru_tangent(const float *dx, const edp_gru_weights *w, uint32_t in, uint32_t units, const float *gates,
                     const float *old, float *dgates, float *dh, edp_directions d, float *dy) {
    const uint32_t wide = 3u * units;
    const float *const back = gates + wide;
    edp_dense_tangent(dx, w->weight_x, 1u, wide, in, d, dgates);
    edp_dense_tangent(dh, w->weight_h, 1u, wide, units, d, dgates + wide);
    for (uint32_t i = 0; i < units; i++) {
        const float reset = edp_sigmoid(gates[i] + back[i]);
        const float keep = edp_sigmoid(gates[units + i] + back[units + i]);
        const float fresh = edp_tanh(gates[2u * units + i] + reset * back[2u * units + i]);
        for (uint32_t k = 0; k < d.count; k++) {
            const float *const dg = dgates + k * d.stride + i;
            const float *const db = dg + wide;
            float *const state = dh + k * d.stride + i;
            const float dreset = reset * (1.0f - reset) * (dg[0] + db[0]);
            const float dkeep = keep * (1.0f - keep) * (dg[units] + db[units]);
            const float inside = dg[2u * units] + dreset * back[2u * units + i] + reset * db[2u * units];
            const float dfresh = (1.0f - fresh * fresh) * inside;
            *state = dfresh + dkeep * (old[i] - fresh) + keep * (*state - dfresh);
            dy[k * d.stride + i] = *state;
        }
    }
}

void edp_min_gru_tangent(const float *x, const float *dx, uint32_t units, const float *h, float *dh, edp_directions d,
                         float *dy) {
    for (uint32_t i = 0; i < units; i++) {
        const float z = edp_sigmoid(x[i]);
        const float slope = z * (1.0f - z) * (x[units + i] - h[i]);
        for (uint32_t k = 0; k < d.count; k++) {
            const float *const from = dx + k * d.stride + i;
            float *const state = dh + k * d.stride + i;
            *state = (1.0f - z) * *state + slope * from[0] + z * from[units];
            dy[k * d.stride + i] = *state;
        }
    }
}

void edp_rotation_tangent(const float *dx, const float *factor, uint32_t states, float *dh, edp_directions d,
                          float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_rotation(dx + k * d.stride, factor, states, dh + k * d.stride, dy + k * d.stride);
    }
}

void edp_trailing_mean_tangent(const float *dx, uint32_t n, uint32_t window, const edp_ring *ring, float *dpast,
                               edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_ring own = *ring;
        edp_trailing_mean(dx + k * d.stride, n, window, dpast + k * d.stride, &own, dy + k * d.stride);
    }
}

/* Sum over the rows seen and the present, each its weight times its change and its weight's change times itself. */
static void weigh(const edp_attended *held, const float *past, const float *now, const float *dpast, const float *dnow,
                  uint32_t stride, uint32_t n, const float *dw, float *dy) {
    const float *const w = held->weights;
    const uint32_t seen = held->ring->seen;
    for (uint32_t i = 0; i < n; i++) {
        dy[i] = w[seen] * dnow[i] + dw[seen] * now[i];
    }
    for (uint32_t row = 0; row < seen; row++) {
        for (uint32_t i = 0; i < n; i++) {
            dy[i] += w[row] * dpast[row * stride + i] + dw[row] * past[row * stride + i];
        }
    }
}

void edp_attention_pool_tangent(const float *x, const float *dx, const float *score, float bias, uint32_t n,
                                const edp_attended *held, edp_directions d, float *dy) {
    const uint32_t seen = held->ring->seen;
    edp_copy(held->past[1], seen, held->weights);
    held->weights[seen] = edp_dot(score, x, n) + bias;
    edp_softmax(held->weights, seen + 1u);
    for (uint32_t k = 0; k < d.count; k++) {
        const float *const from = dx + k * d.stride;
        float *const dpast = held->dpast[0] + k * d.stride;
        float *const dscores = held->dpast[1] + k * d.stride;
        float *const dw = held->dweights + k * d.stride;
        const float own = edp_dot(score, from, n);
        edp_copy(dscores, seen, dw);
        dw[seen] = own;
        edp_softmax_tangent(held->weights, seen + 1u, dw);
        weigh(held, held->past[0], x, dpast, from, n, n, dw, dy + k * d.stride);
        if (held->window > 1u) {
            edp_copy(from, n, dpast + held->ring->at * n);
            dscores[held->ring->at] = own;
        }
    }
}

/* The changes of one head's result along one direction; the weights are known. */
static void attend(const float *const qkv[3], const float *const dqkv[3], uint32_t n, uint32_t size,
                   const edp_attended *held, const float *const dpast[2], float *dw) {
    const uint32_t seen = held->ring->seen;
    const float root = sqrtf((float)size);
    for (uint32_t row = 0; row < seen; row++) {
        const float moved = edp_dot(dqkv[0], held->past[0] + row * n, size);
        dw[row] = (moved + edp_dot(qkv[0], dpast[0] + row * n, size)) / root;
    }
    dw[seen] = (edp_dot(dqkv[0], qkv[1], size) + edp_dot(qkv[0], dqkv[1], size)) / root;
    edp_softmax_tangent(held->weights, seen + 1u, dw);
}

void edp_window_attention_tangent(const float *const qkv[3], const float *const dqkv[3], uint32_t n, uint32_t heads,
                                  const edp_attended *held, edp_directions d, float *dy) {
    const uint32_t size = n / heads;
    const uint32_t seen = held->ring->seen;
    const float root = sqrtf((float)size);
    for (uint32_t first = 0; first < n; first += size) {
        const float *const own[3] = {qkv[0] + first, qkv[1] + first, qkv[2] + first};
        edp_attended part = *held;
        part.past[0] = held->past[0] + first;
        for (uint32_t row = 0; row < seen; row++) {
            part.weights[row] = edp_dot(own[0], part.past[0] + row * n, size) / root;
        }
        part.weights[seen] = edp_dot(own[0], own[1], size) / root;
        edp_softmax(part.weights, seen + 1u);
        for (uint32_t k = 0; k < d.count; k++) {
            const uint32_t at = k * d.stride + first;
            const float *const changes[3] = {dqkv[0] + at, dqkv[1] + at, dqkv[2] + at};
            const float *const dpast[2] = {held->dpast[0] + at, held->dpast[1] + at};
            float *const dw = held->dweights + k * d.stride;
            attend(own, changes, n, size, &part, dpast, dw);
            weigh(&part, held->past[1] + first, own[2], dpast[1], changes[2], n, size, dw, dy + at);
        }
    }
    if (held->window > 1u) {
        edp_copy_tangent(dqkv[1], n, d, held->dpast[0] + held->ring->at * n);
        edp_copy_tangent(dqkv[2], n, d, held->dpast[1] + held->ring->at * n);
    }
}

bool edp_prefix_tangent(const float *x, const float *dx, const edp_prefix_weights *w, uint32_t in, const float *total,
                        float *dtotal, const edp_ring *ring, float *work, float *dwork, edp_directions d) {
    const bool due = (ring->seen + 1u) == w->ticks;
    const float ticks = (float)w->ticks;
    float *const hidden = work + 2u * in;
    float *const dhidden = dwork + 2u * in;
    if (ring->seen < w->ticks) {
        edp_add_tangent(dtotal, dx, in, d, dtotal);
    }
    if (due) {
        for (uint32_t i = 0; i < in; i++) {
            work[i] = (total[i] + x[i]) / ticks;
            work[in + i] = x[i];
            for (uint32_t k = 0; k < d.count; k++) {
                dwork[k * d.stride + i] = dtotal[k * d.stride + i] / ticks;
                dwork[k * d.stride + in + i] = dx[k * d.stride + i];
            }
        }
        edp_dense(work, w->first_weight, w->first_bias, 1u, w->hidden, 2u * in, hidden);
        edp_slope_tanh(hidden, w->hidden, hidden);
        edp_dense_tangent(dwork, w->first_weight, 1u, w->hidden, 2u * in, d, dhidden);
        edp_scale_tangent(dhidden, hidden, w->hidden, d, dhidden);
        edp_dense_tangent(dhidden, w->second_weight, 1u, w->out, w->hidden, d, dhidden + w->hidden);
    }
    return due;
}
