/* Element-wise functions, checks and linear maps; what has a memory is in edp_memory.c. */
#include "edp_runtime.h"

#include <math.h>
#include <string.h>

/* ---- checks ---------------------------------------------------------------------------------------------------- */

static uint32_t bits_of(float x) {
    uint32_t bits;
    (void)memcpy(&bits, &x, sizeof bits);
    return bits;
}

bool edp_finite(float x) { return (bits_of(x) & 0x7F800000u) != 0x7F800000u; }

bool edp_valid(const float *x, const float *low, const float *high, uint32_t n) {
    bool valid = true;
    for (uint32_t i = 0; i < n; i++) {
        if (!edp_finite(x[i]) || (x[i] < low[i]) || (x[i] > high[i])) {
            valid = false;
        }
    }
    return valid;
}

bool edp_all_finite(const float *x, uint32_t n) {
    bool finite = true;
    for (uint32_t i = 0; i < n; i++) {
        if (!edp_finite(x[i])) {
            finite = false;
        }
    }
    return finite;
}

/* A number of 1, 2 or 4 bytes as it lies in memory. */
static uint32_t bits_at(const uint8_t *from, uint32_t width) {
    uint32_t bits = from[0];
    if (width == 2u) {
        uint16_t half;
        (void)memcpy(&half, from, sizeof half);
        bits = half;
    } else if (width == 4u) {
        (void)memcpy(&bits, from, sizeof bits);
    } else {
        /* one byte */
    }
    return bits;
}

uint32_t edp_crc(const edp_table *tables, uint32_t count) {
    uint32_t crc = 0xFFFFFFFFu;
    for (uint32_t t = 0; t < count; t++) {
        const uint8_t *const from = tables[t].values;
        const uint32_t width = tables[t].width;
        for (uint32_t i = 0; i < tables[t].count; i++) {
            uint32_t bits = bits_at(from + i * width, width);
            for (uint32_t bit = 0; bit < 8u * width; bit++) {
                const uint32_t low = (crc ^ bits) & 1u;
                crc = (crc >> 1) ^ (0xEDB88320u & (0u - low));
                bits >>= 1;
            }
        }
    }
    return crc ^ 0xFFFFFFFFu;
}

/* ---- element by element ---------------------------------------------------------------------------------------- */

/* exp(r) - 1 for |r| <= ln 2 / 2: its series; what is left out is below 1e-8 of r. */
static float small_expm1(float r) {
    const float tail =
        1.0f / 6.0f + r * (1.0f / 24.0f + r * (1.0f / 120.0f + r * (1.0f / 720.0f + r * (1.0f / 5040.0f))));
    return r + r * r * (0.5f + r * tail);
}

/* 2^n e^r with n an integer; relative error about 2e-7. Beyond the range of float32 the nearest end of it. NaN stays
 * NaN here and in what follows, and never becomes an integer: so it reaches the output, where it is seen. */
float edp_exp(float x) {
    const float limited = (x > 88.0f) ? 88.0f : ((x < -87.0f) ? -87.0f : x);
    const float turns = limited * 1.44269504f;
    const float nearest = (turns >= 0.0f) ? (turns + 0.5f) : (turns - 0.5f);
    const int32_t n = (nearest >= -126.0f) ? (int32_t)nearest : -126;
    /* ln 2 in two parts, of which n times the first is exact. */
    const float r = (limited - (float)n * 0.693359375f) - (float)n * -2.12194440e-4f;
    const int32_t exponent = n + 127;
    const uint32_t bits = (uint32_t)exponent << 23;
    float power;
    (void)memcpy(&power, &bits, sizeof power);
    return (1.0f + small_expm1(r)) * power;
}

float edp_tanh(float x) {
    const float size = fabsf(x);
    float y;
    if (size < 0.17f) {
        const float e = small_expm1(2.0f * size);
        y = e / (e + 2.0f);
    } else if (size >= 10.0f) {
        y = 1.0f;
    } else {
        y = 1.0f - 2.0f / (edp_exp(2.0f * size) + 1.0f);
    }
    return (x < 0.0f) ? -y : y;
}

float edp_sigmoid(float x) {
    const float small = edp_exp(-fabsf(x));
    return ((x >= 0.0f) ? 1.0f : small) / (1.0f + small);
}

/* The sine of x and of so many quarter turns more, by series; beyond 8192 rad as at 8192. NaN stays NaN. */
static float turned(float x, uint32_t quarters) {
    const float limited = (x > 8192.0f) ? 8192.0f : ((x < -8192.0f) ? -8192.0f : x);
    const float turns = limited * 0.636619772f;
    const float nearest = (turns >= 0.0f) ? (turns + 0.5f) : (turns - 0.5f);
    const int32_t n = (nearest >= -6000.0f) ? (int32_t)nearest : 0;
    /* pi / 2 in three parts, of which n times the first and the second is exact. */
    const float whole = (float)n;
    const float r = ((limited - whole * 1.5703125f) - whole * 4.83751297e-4f) - whole * 7.54978995e-8f;
    const float q = r * r;
    const uint32_t quarter = ((uint32_t)n + quarters) & 3u;
    float y;
    if ((quarter & 1u) == 0u) {
        y = r + r * q * (-1.0f / 6.0f + q * (1.0f / 120.0f + q * (-1.0f / 5040.0f + q * (1.0f / 362880.0f))));
    } else {
        y = 1.0f +
            q * (-0.5f + q * (1.0f / 24.0f + q * (-1.0f / 720.0f + q * (1.0f / 40320.0f + q * (-1.0f / 3628800.0f)))));
    }
    return (quarter >= 2u) ? -y : y;
}

/* log(1 + x) for x in [0, 1]: 2 artanh(x / (2 + x)) by its series. */
static float small_log1p(float x) {
    const float s = x / (2.0f + x);
    const float q = s * s;
    const float far = 1.0f / 11.0f + q * (1.0f / 13.0f + q * (1.0f / 15.0f));
    const float tail = 1.0f / 3.0f + q * (1.0f / 5.0f + q * (1.0f / 7.0f + q * (1.0f / 9.0f + q * far)));
    return 2.0f * (s + s * q * tail);
}

/* The natural logarithm of x above 0; less than the least normal number counts as that. */
static float natural_log(float x) {
    const float value = (x < 1.17549435e-38f) ? 1.17549435e-38f : x;
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof bits);
    int32_t n = (int32_t)(bits >> 23) - 127;
    bits = (bits & 0x7fffffu) | 0x3f800000u;
    float mantissa;
    (void)memcpy(&mantissa, &bits, sizeof mantissa);
    /* Between 0.71 and 1.41 the logarithm of a number near 1 keeps its digits; the series holds there, too. */
    if (mantissa > 1.41421354f) {
        mantissa *= 0.5f;
        n++;
    }
    const float whole = (float)n;
    const float y = whole * 0.693359375f + (whole * -2.12194440e-4f + small_log1p(mantissa - 1.0f));
    return (value == value) ? y : value;
}

void edp_fill(float value, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = value;
    }
}

void edp_copy(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = x[i];
    }
}

void edp_gather(const float *x, const uint16_t *columns, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = x[columns[i]];
    }
}

void edp_standardise(const float *x, const float *offset, const float *scale, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (x[i] - offset[i]) / scale[i];
    }
}

void edp_scale_shift(const float *x, const float *gain, const float *shift, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = x[i] * gain[i] + shift[i];
    }
}

void edp_add(const float *a, const float *b, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = a[i] + b[i];
    }
}

void edp_subtract(const float *a, const float *b, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = a[i] - b[i];
    }
}

void edp_multiply(const float *a, const float *b, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = a[i] * b[i];
    }
}

void edp_divide(const float *a, const float *b, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = a[i] / b[i];
    }
}

void edp_minimum(const float *a, const float *b, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (a[i] > b[i]) ? b[i] : a[i];
    }
}

void edp_maximum(const float *a, const float *b, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (a[i] < b[i]) ? b[i] : a[i];
    }
}

/* The larger of x and 0 is one instruction of a processor, without a branch that it guesses wrong half of the time; it
   makes 0 of NaN, so that is looked at apart. */
void edp_map_relu(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        const float value = x[i];
        const float larger = (value > 0.0f) ? value : 0.0f;
        y[i] = (value == value) ? larger : value;
    }
}

void edp_map_sigmoid(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = edp_sigmoid(x[i]);
    }
}

void edp_map_tanh(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = edp_tanh(x[i]);
    }
}

void edp_map_gelu(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = 0.5f * x[i] * (1.0f + erff(x[i] * 0.707106781f));
    }
}

void edp_map_softplus(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = ((x[i] > 0.0f) ? x[i] : 0.0f) + small_log1p(edp_exp(-fabsf(x[i])));
    }
}

void edp_map_exp(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = edp_exp(x[i]);
    }
}

void edp_map_sqrt(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = sqrtf(x[i]);
    }
}

void edp_map_sine(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = turned(x[i], 0u);
    }
}

void edp_map_cosine(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = turned(x[i], 1u);
    }
}

void edp_map_log(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = natural_log(x[i]);
    }
}

void edp_map_positive(const float *x, uint32_t n, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (x[i] > 0.0f) ? 1.0f : 0.0f;
    }
}

/* ---- rows ------------------------------------------------------------------------------------------------------ */

void edp_glu(const float *x, uint32_t rows, uint32_t n, float *y) {
    for (uint32_t row = 0; row < rows; row++) {
        for (uint32_t i = 0; i < n; i++) {
            y[row * n + i] = x[2u * row * n + i] * edp_sigmoid(x[(2u * row + 1u) * n + i]);
        }
    }
}

void edp_accumulate(const float *x, uint32_t rows, uint32_t n, float *y) {
    edp_copy(x, n, y);
    for (uint32_t i = n; i < rows * n; i++) {
        y[i] = y[i - n] + x[i];
    }
}

/* EDP_PANEL rows side by side: their sums stay in registers, and each x is read once. Every sum is in the order of the
   columns, so vectors of the processor change no bit. */
static void panel(const float *x, const float *weight, uint32_t in, float *y) {
    const float *w = weight;
    float a0 = y[0];
    float a1 = y[1];
    float a2 = y[2];
    float a3 = y[3];
    float a4 = y[4];
    float a5 = y[5];
    float a6 = y[6];
    float a7 = y[7];
    float a8 = y[8];
    float a9 = y[9];
    float a10 = y[10];
    float a11 = y[11];
    float a12 = y[12];
    float a13 = y[13];
    float a14 = y[14];
    float a15 = y[15];
    for (uint32_t i = 0; i < in; i++) {
        const float value = x[i];
        a0 += w[0] * value;
        a1 += w[1] * value;
        a2 += w[2] * value;
        a3 += w[3] * value;
        a4 += w[4] * value;
        a5 += w[5] * value;
        a6 += w[6] * value;
        a7 += w[7] * value;
        a8 += w[8] * value;
        a9 += w[9] * value;
        a10 += w[10] * value;
        a11 += w[11] * value;
        a12 += w[12] * value;
        a13 += w[13] * value;
        a14 += w[14] * value;
        a15 += w[15] * value;
        w = &w[EDP_PANEL];
    }
    y[0] = a0;
    y[1] = a1;
    y[2] = a2;
    y[3] = a3;
    y[4] = a4;
    y[5] = a5;
    y[6] = a6;
    y[7] = a7;
    y[8] = a8;
    y[9] = a9;
    y[10] = a10;
    y[11] = a11;
    y[12] = a12;
    y[13] = a13;
    y[14] = a14;
    y[15] = a15;
}

void edp_product(const float *x, const float *weight, uint32_t first, uint32_t columns, uint32_t out, uint32_t in,
                 float *y) {
    uint32_t o = 0;
    for (; o + EDP_PANEL <= out; o += EDP_PANEL) {
        panel(x, weight + o * columns + first * EDP_PANEL, in, y + o);
    }
    for (; o + 4u <= out; o += 4u) {
        const float *w0 = weight + o * columns + first;
        const float *w1 = w0 + columns;
        const float *w2 = w1 + columns;
        const float *w3 = w2 + columns;
        float a0 = y[o];
        float a1 = y[o + 1u];
        float a2 = y[o + 2u];
        float a3 = y[o + 3u];
        for (uint32_t i = 0; i < in; i++) {
            const float value = x[i];
            a0 += w0[i] * value;
            a1 += w1[i] * value;
            a2 += w2[i] * value;
            a3 += w3[i] * value;
        }
        y[o] = a0;
        y[o + 1u] = a1;
        y[o + 2u] = a2;
        y[o + 3u] = a3;
    }
    for (; o < out; o++) {
        const float *w = weight + o * columns + first;
        float a = y[o];
        for (uint32_t i = 0; i < in; i++) {
            a += w[i] * x[i];
        }
        y[o] = a;
    }
}

void edp_dense(const float *x, const float *weight, const float *bias, uint32_t rows, uint32_t out, uint32_t in,
               float *y) {
    for (uint32_t row = 0; row < rows; row++) {
        edp_copy(bias, out, y + row * out);
        edp_product(x + row * in, weight, 0u, in, out, in, y + row * out);
    }
}

void edp_grouped_dense(const float *x, const float *weight, const float *bias, uint32_t rows, uint32_t out, uint32_t in,
                       float *y) {
    for (uint32_t row = 0; row < rows; row++) {
        edp_copy(bias + row * out, out, y + row * out);
        edp_product(x + row * in, weight + row * out * in, 0u, in, out, in, y + row * out);
    }
}

void edp_trees(const float *x, const uint16_t *feature, const float *threshold, const float *leaf, uint32_t outputs,
               uint32_t trees, uint32_t depth, float *y) {
    const uint32_t nodes = (1u << depth) - 1u;
    for (uint32_t o = 0; o < outputs; o++) {
        float sum = 0.0f;
        for (uint32_t tree = o * trees; tree < (o + 1u) * trees; tree++) {
            const uint16_t *column = feature + tree * nodes;
            const float *split = threshold + tree * nodes;
            uint32_t at = 0;
            for (uint32_t level = 0; level < depth; level++) {
                at = 2u * at + ((x[column[at]] > split[at]) ? 2u : 1u);
            }
            sum += leaf[tree * (nodes + 1u) + at - nodes];
        }
        y[o] = sum;
    }
}

void edp_layer_norm(const float *x, const float *gain, const float *shift, float epsilon, uint32_t rows, uint32_t n,
                    float *y) {
    for (uint32_t row = 0; row < rows; row++) {
        const float *from = x + row * n;
        float *to = y + row * n;
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
        for (uint32_t i = 0; i < n; i++) {
            to[i] = (from[i] - mean) * scale * gain[i] + shift[i];
        }
    }
}

void edp_softmax(float *scores, uint32_t n) {
    float most = scores[0];
    float total = 0.0f;
    for (uint32_t i = 1; i < n; i++) {
        most = (scores[i] > most) ? scores[i] : most;
    }
    for (uint32_t i = 0; i < n; i++) {
        scores[i] = edp_exp(scores[i] - most);
        total += scores[i];
    }
    for (uint32_t i = 0; i < n; i++) {
        scores[i] /= total;
    }
}

void edp_row_attention(const float *q, const float *k, const float *v, uint32_t rows, uint32_t n, float *scores,
                       float *y) {
    const float root = sqrtf((float)n);
    for (uint32_t row = 0; row < rows; row++) {
        for (uint32_t other = 0; other < rows; other++) {
            float sum = 0.0f;
            for (uint32_t i = 0; i < n; i++) {
                sum += q[row * n + i] * k[other * n + i];
            }
            scores[other] = sum / root;
        }
        edp_softmax(scores, rows);
        edp_fill(0.0f, n, y + row * n);
        for (uint32_t other = 0; other < rows; other++) {
            for (uint32_t i = 0; i < n; i++) {
                y[row * n + i] += scores[other] * v[other * n + i];
            }
        }
    }
}
