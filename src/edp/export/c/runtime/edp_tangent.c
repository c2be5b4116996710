/* Tangents of layers without memory; those of layers with memory are in edp_tangent_memory.c. */
#include "edp_tangent.h"

#include <math.h>

/* ---- element by element ---------------------------------------------------------------------------------------- */

void edp_fill_tangent(uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_fill(0.0f, n, dy + k * d.stride);
    }
}

void edp_copy_tangent(const float *dx, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_copy(dx + k * d.stride, n, dy + k * d.stride);
    }
}

void edp_gather_tangent(const float *dx, const uint16_t *columns, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_gather(dx + k * d.stride, columns, n, dy + k * d.stride);
    }
}

void edp_standardise_tangent(const float *dx, const float *scale, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_divide(dx + k * d.stride, scale, n, dy + k * d.stride);
    }
}

void edp_scale_tangent(const float *dx, const float *slope, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_multiply(dx + k * d.stride, slope, n, dy + k * d.stride);
    }
}

void edp_add_tangent(const float *da, const float *db, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_add(da + k * d.stride, db + k * d.stride, n, dy + k * d.stride);
    }
}

void edp_subtract_tangent(const float *da, const float *db, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_subtract(da + k * d.stride, db + k * d.stride, n, dy + k * d.stride);
    }
}

void edp_multiply_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n,
                          edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t at = k * d.stride + i;
            dy[at] = da[at] * b[i] + a[i] * db[at];
        }
    }
}

void edp_divide_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n, edp_directions d,
                        float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t at = k * d.stride + i;
            dy[at] = (da[at] - a[i] / b[i] * db[at]) / b[i];
        }
    }
}

void edp_minimum_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n,
                         edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t at = k * d.stride + i;
            dy[at] = (a[i] > b[i]) ? db[at] : da[at];
        }
    }
}

void edp_maximum_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n,
                         edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t at = k * d.stride + i;
            dy[at] = (a[i] < b[i]) ? db[at] : da[at];
        }
    }
}

void edp_clip_tangent(const float *x, const float *dx, const float *low, const float *high, uint32_t n,
                      edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t at = k * d.stride + i;
            dy[at] = ((x[i] < low[i]) || (x[i] > high[i])) ? 0.0f : dx[at];
        }
    }
}

void edp_slope_relu(const float *x, uint32_t n, float *slope) { edp_map_positive(x, n, slope); }

void edp_slope_sigmoid(const float *x, uint32_t n, float *slope) {
    for (uint32_t i = 0; i < n; i++) {
        const float y = edp_sigmoid(x[i]);
        slope[i] = y * (1.0f - y);
    }
}

void edp_slope_tanh(const float *x, uint32_t n, float *slope) {
    for (uint32_t i = 0; i < n; i++) {
        const float y = edp_tanh(x[i]);
        slope[i] = 1.0f - y * y;
    }
}

void edp_slope_gelu(const float *x, uint32_t n, float *slope) {
    for (uint32_t i = 0; i < n; i++) {
        const float density = 0.398942280f * edp_exp(-0.5f * x[i] * x[i]);
        slope[i] = 0.5f * (1.0f + erff(x[i] * 0.707106781f)) + x[i] * density;
    }
}

void edp_slope_softplus(const float *x, uint32_t n, float *slope) { edp_map_sigmoid(x, n, slope); }

void edp_slope_exp(const float *x, uint32_t n, float *slope) { edp_map_exp(x, n, slope); }

void edp_slope_sqrt(const float *x, uint32_t n, float *slope) {
    for (uint32_t i = 0; i < n; i++) {
        slope[i] = 0.5f / sqrtf(x[i]);
    }
}

void edp_slope_sine(const float *x, uint32_t n, float *slope) { edp_map_cosine(x, n, slope); }

void edp_slope_cosine(const float *x, uint32_t n, float *slope) {
    edp_map_sine(x, n, slope);
    for (uint32_t i = 0; i < n; i++) {
        slope[i] = -slope[i];
    }
}

void edp_slope_log(const float *x, uint32_t n, float *slope) {
    for (uint32_t i = 0; i < n; i++) {
        slope[i] = (x[i] > 1.17549435e-38f) ? 1.0f / x[i] : 0.0f;
    }
}

void edp_slope_positive(const float *x, uint32_t n, float *slope) {
    for (uint32_t i = 0; i < n; i++) {
        slope[i] = 0.0f * x[i];
    }
}

/* ---- rows ------------------------------------------------------------------------------------------------------ */

void edp_glu_tangent(const float *x, const float *dx, uint32_t rows, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t row = 0; row < rows; row++) {
        for (uint32_t i = 0; i < n; i++) {
            const uint32_t first = 2u * row * n + i;
            const float gate = edp_sigmoid(x[first + n]);
            const float slope = x[first] * gate * (1.0f - gate);
            for (uint32_t k = 0; k < d.count; k++) {
                const float *const from = dx + k * d.stride + first;
                dy[k * d.stride + row * n + i] = gate * from[0] + slope * from[n];
            }
        }
    }
}

void edp_accumulate_tangent(const float *dx, uint32_t rows, uint32_t n, edp_directions d, float *dy) {
    for (uint32_t k = 0; k < d.count; k++) {
        edp_accumulate(dx + k * d.stride, rows, n, dy + k * d.stride);
    }
}

void edp_dense_tangent(const float *dx, const float *weight, uint32_t rows, uint32_t out, uint32_t in,
                       edp_directions d, float *dy) {
    edp_fill_tangent(rows * out, d, dy);
    for (uint32_t k = 0; k < d.count; k++) {
        for (uint32_t row = 0; row < rows; row++) {
            edp_product(dx + k * d.stride + row * in, weight, 0u, in, out, in, dy + k * d.stride + row * out);
        }
    }
}

void edp_grouped_dense_tangent(const float *dx, const float *weight, uint32_t rows, uint32_t out, uint32_t in,
                               edp_directions d, float *dy) {
    for (uint32_t row = 0; row < rows; row++) {
        edp_dense_tangent(dx + row * in, weight + row * out * in, 1u, out, in, d, dy + row * out);
    }
}

void edp_layer_norm_tangent(const float *x, const float *dx, const float *gain, float epsilon, uint32_t rows, uint32_t n,
                            edp_directions d, float *dy) {
    for (uint32_t row = 0; row < rows; row++) {
        const float *const from = x + row * n;
        float mean = 0.0f;
        float spread = 0.0f;
        for (uint32_t i = 0; i < n; i++) {
            mean += from[i];
        }
        mean /= (float)n;
        for (uint32_t i = 0; i < n; i++) {
            spread += (from[i] - mean) * (from[i] - mean);
        }
        const float scale = 1.0f / sqrtf(spread / (float)n + epsilon);
        for (uint32_t k = 0; k < d.count; k++) {
            const float *const change = dx + k * d.stride + row * n;
            float *const to = dy + k * d.stride + row * n;
            float common = 0.0f;
            float along = 0.0f;
            for (uint32_t i = 0; i < n; i++) {
                common += change[i];
                along += (from[i] - mean) * scale * change[i];
            }
            common /= (float)n;
            along /= (float)n;
            for (uint32_t i = 0; i < n; i++) {
                to[i] = gain[i] * scale * (change[i] - common - (from[i] - mean) * scale * along);
            }
        }
    }
}

void edp_row_attention_tangent(const float *const qkv[3], const float *const dqkv[3], uint32_t rows, uint32_t n,
                               float *scores, float *dscores, edp_directions d, float *dy) {
    const float root = sqrtf((float)n);
    for (uint32_t row = 0; row < rows; row++) {
        const float *const q = qkv[0] + row * n;
        for (uint32_t other = 0; other < rows; other++) {
            scores[other] = edp_dot(q, qkv[1] + other * n, n) / root;
        }
        edp_softmax(scores, rows);
        for (uint32_t k = 0; k < d.count; k++) {
            const float *const dq = dqkv[0] + k * d.stride + row * n;
            const float *const dk = dqkv[1] + k * d.stride;
            const float *const dv = dqkv[2] + k * d.stride;
            float *const ds = dscores + k * d.stride;
            float *const to = dy + k * d.stride + row * n;
            for (uint32_t other = 0; other < rows; other++) {
                const float *const key = qkv[1] + other * n;
                ds[other] = (edp_dot(dq, key, n) + edp_dot(q, dk + other * n, n)) / root;
            }
            edp_softmax_tangent(scores, rows, ds);
            edp_fill(0.0f, n, to);
            for (uint32_t other = 0; other < rows; other++) {
                for (uint32_t i = 0; i < n; i++) {
                    to[i] += ds[other] * qkv[2][other * n + i] + scores[other] * dv[other * n + i];
                }
            }
        }
    }
}

float edp_dot(const float *a, const float *b, uint32_t n) {
    float sum = 0.0f;
    for (uint32_t i = 0; i < n; i++) {
        sum += a[i] * b[i];
    }
    return sum;
}

void edp_softmax_tangent(const float *weights, uint32_t n, float *dscores) {
    const float mean = edp_dot(weights, dscores, n);
    for (uint32_t i = 0; i < n; i++) {
        dscores[i] = weights[i] * (dscores[i] - mean);
    }
}
