/* Integer arithmetic: scalars, element by element, rows. */
#include "edp_integer.h"
#include "edp_tables.h"

#if defined(__ARM_FEATURE_DSP) && (__ARM_FEATURE_DSP == 1) && !defined(__ARM_BIG_ENDIAN) && !defined(EDP_PORTABLE)
#define EDP_DSP 1
#include <arm_acle.h>
#else
#define EDP_DSP 0
#endif

#define LARGEST 32767
#define GATE_LIMIT 268435456 /* 2^28 */

/* ---- scalars --------------------------------------------------------------------------------------------------- */

int16_t edp_q_narrow(int64_t x) { return (int16_t)((x > LARGEST) ? LARGEST : ((x < -LARGEST) ? -LARGEST : x)); }

static int16_t narrow32(int32_t x) { return (int16_t)((x > LARGEST) ? LARGEST : ((x < -LARGEST) ? -LARGEST : x)); }

static int32_t limited(int64_t x) {
    return (int32_t)((x > GATE_LIMIT) ? GATE_LIMIT : ((x < -GATE_LIMIT) ? -GATE_LIMIT : x));
}

static int32_t size_of(int32_t x) { return (x < 0) ? -x : x; }

int32_t edp_q_rounded(int32_t x, uint32_t right) { return (right == 0u) ? x : (((x >> (right - 1u)) + 1) >> 1); }

int64_t edp_q_scaled(int32_t sum, int32_t multiplier, uint8_t shift) {
    const int64_t product = (int64_t)sum * multiplier;
    if (shift > 32u) { /* the rule; the same number, without shifts of two words */
        const int32_t high = (int32_t)(product >> 32);
        return ((high >> (shift - 33u)) + 1) >> 1;
    }
    return ((product >> (shift - 1u)) + 1) >> 1;
}

int32_t edp_q_gate(int16_t x, int32_t frac) {
    return (frac > 16) ? edp_q_rounded(x, (uint32_t)(frac - 16)) : limited((int64_t)x * ((int64_t)1 << (uint32_t)(16 - frac)));
}

/* A table at x >= 0 with entries 2^step apart, interpolated. */
static int32_t looked_up(const uint16_t *table, int32_t x, uint32_t step) {
    const uint32_t last = ((EDP_TABLE - 1u) << step) - 1u;
    const uint32_t at = ((uint32_t)x < last) ? (uint32_t)x : last;
    const uint32_t entry = at >> step;
    const uint32_t beyond = at - (entry << step);
    const int32_t rest = (int32_t)beyond;
    const int32_t low = table[entry];
    const int32_t high = table[entry + 1u];
    return low + edp_q_rounded((high - low) * rest, step);
}

int32_t edp_q_sigmoid(int32_t x) {
    const int32_t half = looked_up(edp_table_tanh, size_of(x), 11u);
    const int32_t y = edp_q_rounded(65536 + ((x < 0) ? -half : half), 2u);
    return (y < LARGEST) ? y : LARGEST;
}

int32_t edp_q_tanh(int32_t x, uint32_t frac) {
    const int32_t exact = (looked_up(edp_table_tanh, size_of(x), frac - 6u) + 1) >> 1;
    const int32_t y = (exact < LARGEST) ? exact : LARGEST;
    return (x < 0) ? -y : y;
}

void edp_q_softmax(int32_t *scores, uint32_t n) {
    int32_t most = scores[0];
    uint32_t total = 0u;
    for (uint32_t i = 1; i < n; i++) {
        most = (scores[i] > most) ? scores[i] : most;
    }
    for (uint32_t i = 0; i < n; i++) {
        scores[i] = looked_up(edp_table_exp, most - scores[i], 11u);
        total += (uint32_t)scores[i];
    }
    for (uint32_t i = 0; i < n; i++) {
        const uint32_t share = (((uint32_t)scores[i] << 15) + (total >> 1)) / total;
        scores[i] = (int32_t)share;
    }
}

/* ---- element by element ---------------------------------------------------------------------------------------- */

uint32_t edp_q_from_float(const float *x, uint32_t n, float scale, int16_t *y) {
    const float top = (float)LARGEST;
    uint32_t clipped = 0u;
    for (uint32_t i = 0; i < n; i++) {
        float wide = x[i] * scale;
        if (wide > top) {
            wide = top;
            clipped++;
        } else if (!(wide >= -top)) { /* NaN too */
            wide = -top;
            clipped++;
        } else {
            /* within the range */
        }
        y[i] = (int16_t)((wide >= 0.0f) ? (wide + 0.5f) : (wide - 0.5f));
    }
    return clipped;
}

void edp_q_to_float(const int16_t *x, uint32_t n, float scale, float *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (float)x[i] * scale;
    }
}

void edp_q_zero16(uint32_t n, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = 0;
    }
}

void edp_q_fill32(int32_t value, uint32_t n, int32_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = value;
    }
}

void edp_q_copy16(const int16_t *x, uint32_t n, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = x[i];
    }
}

void edp_q_copy32(const int32_t *x, uint32_t n, int32_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = x[i];
    }
}

void edp_q_move(const int16_t *x, uint32_t n, uint32_t right, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (int16_t)edp_q_rounded(x[i], right);
    }
}

void edp_q_gather(const int16_t *x, const uint16_t *columns, uint32_t n, uint32_t right, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (int16_t)edp_q_rounded(x[columns[i]], right);
    }
}

void edp_q_sum(const int16_t *a, const int16_t *b, uint32_t n, int32_t factor_a, int32_t factor_b, uint32_t right,
               int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = narrow32(edp_q_rounded(a[i] * factor_a + b[i] * factor_b, right));
    }
}

void edp_q_multiply(const int16_t *a, const int16_t *b, uint32_t n, uint32_t right, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = narrow32(edp_q_rounded((int32_t)a[i] * b[i], right));
    }
}

void edp_q_scale_shift(const int16_t *x, const int16_t *gain, const int32_t *offset, uint32_t n, uint32_t right,
                       int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = narrow32(edp_q_rounded((int32_t)x[i] * gain[i] + offset[i], right));
    }
}

void edp_q_map_relu(const int16_t *x, uint32_t n, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (x[i] > 0) ? x[i] : (int16_t)0;
    }
}

void edp_q_map_sigmoid(const int16_t *x, uint32_t n, int32_t given, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (int16_t)edp_q_sigmoid(edp_q_gate(x[i], given));
    }
}

void edp_q_map_tanh(const int16_t *x, uint32_t n, int32_t given, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        y[i] = (int16_t)edp_q_tanh(edp_q_gate(x[i], given), 16u);
    }
}

void edp_q_map_gelu(const int16_t *x, uint32_t n, int32_t given, int16_t *y) {
    for (uint32_t i = 0; i < n; i++) {
        const int32_t gate = edp_q_gate(x[i], given);
        const int32_t above = looked_up(edp_table_normal, size_of(gate), 10u);
        y[i] = narrow32(edp_q_rounded(x[i] * ((gate < 0) ? (65536 - above) : above), 16u));
    }
}

void edp_q_map_softplus(const int16_t *x, uint32_t n, int32_t given, int32_t frac, int16_t *y) {
    const int32_t right = 16 - frac;
    for (uint32_t i = 0; i < n; i++) {
        const int32_t gate = edp_q_gate(x[i], given);
        const int32_t sum = ((gate > 0) ? gate : 0) + looked_up(edp_table_log1p_exp, size_of(gate), 11u);
        y[i] = narrow32(edp_q_rounded(sum, (uint32_t)right));
    }
}

/* ---- rows ------------------------------------------------------------------------------------------------------ */

void edp_q_glu(const int16_t *x, uint32_t rows, uint32_t n, int32_t given, int16_t *y) {
    for (uint32_t row = 0; row < rows; row++) {
        for (uint32_t i = 0; i < n; i++) {
            const int32_t gate = edp_q_sigmoid(edp_q_gate(x[(2u * row + 1u) * n + i], given));
            y[row * n + i] = (int16_t)edp_q_rounded(x[2u * row * n + i] * gate, 15u);
        }
    }
}

#if EDP_DSP
/* Four products of a row: bytes 0 and 2 are the weights of the first pair, 1 and 3 those of the second. */
static int32_t four(uint32_t bytes, int16x2_t first, int16x2_t second, int32_t sum) {
    int16x2_t odd;
    /* Turns and widens at once, which no intrinsic says. */
    __asm__("sxtb16 %0, %1, ror #8" : "=r"(odd) : "r"(bytes));
    return __smlad(odd, second, __smlad(__sxtb16((int8x4_t)bytes), first, sum));
}
#else
static int32_t four(const int8_t *weight, const int16_t *x, int32_t sum) {
    return sum + weight[0] * x[0] + weight[2] * x[1] + weight[1] * x[2] + weight[3] * x[3];
}
#endif

void edp_q_products(const int16_t *x, const int8_t *weight, uint32_t out, uint32_t in, int32_t *sums) {
    const int16_t *const end = x + in;
    const int16_t *const left = end - (in & 3u);
    const int8_t *w = weight;
    uint32_t o = 0;
    for (; o + 4u <= out; o += 4u) {
        int32_t a0 = sums[o];
        int32_t a1 = sums[o + 1u];
        int32_t a2 = sums[o + 2u];
        int32_t a3 = sums[o + 3u];
        const int16_t *at = x;
        while (at != left) {
#if EDP_DSP
            uint32_t w0, w1, w2, w3;
            int16x2_t first, second;
            /* Side by side, where each load but the first takes a single cycle; a compiler spreads them. */
            __asm__ volatile("ldr %0, [%6], #16\n\tldr %1, [%6, #-12]\n\tldr %2, [%6, #-8]\n\tldr %3, [%6, #-4]\n\t"
                    "ldr %4, [%7], #8\n\tldr %5, [%7, #-4]"
                    : "=&r"(w0), "=&r"(w1), "=&r"(w2), "=&r"(w3), "=&r"(first), "=&r"(second), "+&r"(w), "+&r"(at)
                    :
                    : "memory");
            a0 = four(w0, first, second, a0);
            a1 = four(w1, first, second, a1);
            a2 = four(w2, first, second, a2);
            a3 = four(w3, first, second, a3);
#else
            a0 = four(w, at, a0);
            a1 = four(w + 4, at, a1);
            a2 = four(w + 8, at, a2);
            a3 = four(w + 12, at, a3);
            w += 16;
            at += 4;
#endif
        }
        for (; at != end; at++) {
            const int32_t value = *at;
            a0 += w[0] * value;
            a1 += w[1] * value;
            a2 += w[2] * value;
            a3 += w[3] * value;
            w += 4;
        }
        sums[o] = a0;
        sums[o + 1u] = a1;
        sums[o + 2u] = a2;
        sums[o + 3u] = a3;
    }
    for (; o < out; o++) {
        int32_t a = sums[o];
        for (uint32_t i = 0; i < in; i++) {
            a += w[i] * (int32_t)x[i];
        }
        w = &w[in];
        sums[o] = a;
    }
}

void edp_q_dense(const int16_t *x, const edp_q_matrix *w, const int32_t *bias, uint32_t rows, uint32_t out, uint32_t in,
                 int32_t *sums, int16_t *y) {
    for (uint32_t row = 0; row < rows; row++) {
        edp_q_copy32(bias, out, sums);
        edp_q_products(x + row * in, w->weight, out, in, sums);
        for (uint32_t o = 0; o < out; o++) {
            y[row * out + o] = edp_q_narrow(edp_q_scaled(sums[o], w->multiplier[o], w->shift[o]));
        }
    }
}

void edp_q_grouped_dense(const int16_t *x, const edp_q_matrix *w, const int32_t *bias, uint32_t rows, uint32_t out,
                         uint32_t in, int32_t *sums, int16_t *y) {
    for (uint32_t row = 0; row < rows; row++) {
        const uint32_t first = row * out;
        const edp_q_matrix own = {w->weight + first * in, w->multiplier + first, w->shift + first};
        edp_q_dense(x + row * in, &own, bias + first, 1u, out, in, sums, y + first);
    }
}

void edp_q_trees(const int16_t *x, const uint16_t *feature, const int16_t *threshold, const int16_t *leaf,
                 uint32_t outputs, uint32_t trees, uint32_t depth, uint32_t right, int16_t *y) {
    const uint32_t nodes = (1u << depth) - 1u;
    for (uint32_t o = 0; o < outputs; o++) {
        int32_t sum = 0;
        for (uint32_t tree = o * trees; tree < (o + 1u) * trees; tree++) {
            const uint16_t *column = feature + tree * nodes;
            const int16_t *split = threshold + tree * nodes;
            uint32_t at = 0;
            for (uint32_t level = 0; level < depth; level++) {
                at = 2u * at + ((x[column[at]] > split[at]) ? 2u : 1u);
            }
            sum += leaf[tree * (nodes + 1u) + at - nodes];
        }
        y[o] = narrow32(edp_q_rounded(sum, right));
    }
}

void edp_q_gates(const int16_t *x, const edp_q_matrix *w, uint32_t out, uint32_t in, int32_t *gates) {
    edp_q_fill32(0, out, gates);
    edp_q_products(x, w->weight, out, in, gates);
    for (uint32_t o = 0; o < out; o++) {
        gates[o] = limited(edp_q_scaled(gates[o], w->multiplier[o], w->shift[o]));
    }
}
