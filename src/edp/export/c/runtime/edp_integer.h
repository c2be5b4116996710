/* Integer arithmetic of exported predictors: C99, 8-bit weights, 16-bit values, no heap, no globals.
 *
 * A value is q 2^-frac with q in [-32767, 32767]. Accumulators are 32-bit; multiplier and shift of an output take them to
 * the format of the result: sum * multiplier * 2^-shift, rounded half up, saturated. Gates and scores have 16 fractional
 * bits in 32. The results are the same bits on every machine. Otherwise as edp_runtime.h.
 * EDP_PORTABLE takes the plain loops where the processor has DSP instructions (Armv7E-M, Armv8-M): the same bits.
 */
#ifndef EDP_INTEGER_H
#define EDP_INTEGER_H

#include "edp_runtime.h"

#if (-2 >> 1) != -1
#error "right shifts of negative numbers must be arithmetic"
#endif

/* Rows of 8-bit weights, and what takes the sum of a row to its format. */
typedef struct {
    const int8_t *weight;      /* (out, in), in the order of edp_q_products */
    const int32_t *multiplier; /* (out) */
    const uint8_t *shift;      /* (out), 1 to 62 */
} edp_q_matrix;

/* Weights of an LSTM, gates in the order i, f, g, o, or of a GRU, gates in the order r, z, n. */
typedef struct {
    edp_q_matrix x;        /* (gates, in) */
    edp_q_matrix h;        /* (gates, units) */
    const int32_t *bias;   /* (gates), of the first matrix */
    const int32_t *bias_h; /* (gates), of the second one; GRU only */
    int32_t share;         /* LSTM only: of the new h and c that is taken, in 2^-15 */
} edp_q_recurrent;

/* ---- scalars --------------------------------------------------------------------------------------------------- */

int16_t edp_q_narrow(int64_t x);
/* x 2^-right, rounded half up, right at most 31. */
int32_t edp_q_rounded(int32_t x, uint32_t right);
/* sum * multiplier * 2^-shift, rounded half up. */
int64_t edp_q_scaled(int32_t sum, int32_t multiplier, uint8_t shift);
/* x of `frac` fractional bits to 16 of them. */
int32_t edp_q_gate(int16_t x, int32_t frac);
/* In 2^-15, of x in 2^-16. */
int32_t edp_q_sigmoid(int32_t x);
/* In 2^-15, of x in 2^-frac, frac at least 6. */
int32_t edp_q_tanh(int32_t x, uint32_t frac);
/* Scores in 2^-16 to weights in 2^-15, in place. */
void edp_q_softmax(int32_t *scores, uint32_t n);

/* ---- element by element; y may be x unless said otherwise -------------------------------------------------------- */

/* Returns how many numbers were beyond the range. */
uint32_t edp_q_from_float(const float *x, uint32_t n, float scale, int16_t *y);
void edp_q_to_float(const int16_t *x, uint32_t n, float scale, float *y);
void edp_q_zero16(uint32_t n, int16_t *y);
void edp_q_fill32(int32_t value, uint32_t n, int32_t *y);
void edp_q_copy16(const int16_t *x, uint32_t n, int16_t *y);
void edp_q_copy32(const int32_t *x, uint32_t n, int32_t *y);
/* Copies and takes away `right` bits. */
void edp_q_move(const int16_t *x, uint32_t n, uint32_t right, int16_t *y);
/* The same of chosen columns; y must not be x. */
void edp_q_gather(const int16_t *x, const uint16_t *columns, uint32_t n, uint32_t right, int16_t *y);
/* (a factor_a + b factor_b) 2^-right */
void edp_q_sum(const int16_t *a, const int16_t *b, uint32_t n, int32_t factor_a, int32_t factor_b, uint32_t right,
               int16_t *y);
void edp_q_multiply(const int16_t *a, const int16_t *b, uint32_t n, uint32_t right, int16_t *y);
void edp_q_scale_shift(const int16_t *x, const int16_t *gain, const int32_t *offset, uint32_t n, uint32_t right,
                       int16_t *y);
/* `given`: fractional bits of x; `frac`: those of y, where it has not 15 or those of x. */
void edp_q_map_relu(const int16_t *x, uint32_t n, int16_t *y);
void edp_q_map_sigmoid(const int16_t *x, uint32_t n, int32_t given, int16_t *y);
void edp_q_map_tanh(const int16_t *x, uint32_t n, int32_t given, int16_t *y);
void edp_q_map_gelu(const int16_t *x, uint32_t n, int32_t given, int16_t *y);
void edp_q_map_softplus(const int16_t *x, uint32_t n, int32_t given, int32_t frac, int16_t *y);

/* ---- rows; y must not overlap with what is read --------------------------------------------------------------------- */

void edp_q_glu(const int16_t *x, uint32_t rows, uint32_t n, int32_t given, int16_t *y);
/* sums += W x. Weights lie in the order in which they are read: of four rows at a time first groups of four columns, of
 * each row the columns 0, 2, 1, 3; then the columns that are left, the four rows side by side; at the end the rows that
 * are left as they are. */
void edp_q_products(const int16_t *x, const int8_t *weight, uint32_t out, uint32_t in, int32_t *sums);
/* `sums` holds out numbers. */
void edp_q_dense(const int16_t *x, const edp_q_matrix *w, const int32_t *bias, uint32_t rows, uint32_t out, uint32_t in,
                 int32_t *sums, int16_t *y);
void edp_q_grouped_dense(const int16_t *x, const edp_q_matrix *w, const int32_t *bias, uint32_t rows, uint32_t out,
                         uint32_t in, int32_t *sums, int16_t *y);
/* As edp_trees; thresholds have the format of x, and the sum of the leaves `right` bits more than y. */
void edp_q_trees(const int16_t *x, const uint16_t *feature, const int16_t *threshold, const int16_t *leaf,
                 uint32_t outputs, uint32_t trees, uint32_t depth, uint32_t right, int16_t *y);
/* gates = W x, 16 fractional bits. */
void edp_q_gates(const int16_t *x, const edp_q_matrix *w, uint32_t out, uint32_t in, int32_t *gates);

/* ---- with memory ------------------------------------------------------------------------------------------------- */

void edp_q_difference(const int16_t *x, const int16_t *factor, uint32_t n, bool from_zero, uint32_t right,
                      int16_t *before, edp_ring *ring, int16_t *y);
/* weight (taps, out, in), past ((taps - 1) dilation, in); `sums` holds out numbers. */
void edp_q_convolution(const int16_t *x, const edp_q_matrix *w, const int32_t *bias, uint32_t out, uint32_t taps,
                       uint32_t in, uint32_t dilation, int16_t *past, edp_ring *ring, int32_t *sums, int16_t *y);
/* h in 2^-15, c in 2^-20; `gates` holds 8 units numbers. */
void edp_q_lstm(const int16_t *x, const edp_q_recurrent *w, uint32_t in, uint32_t units, int16_t *h, int32_t *c,
                int32_t *gates, int16_t *y);
/* h in 2^-15; `gates` holds 6 units numbers. */
void edp_q_gru(const int16_t *x, const edp_q_recurrent *w, uint32_t in, uint32_t units, int16_t *h, int32_t *gates,
               int16_t *y);
/* x holds gate and candidate, 2 units numbers of `given` fractional bits; h has 14 more of them. */
void edp_q_min_gru(const int16_t *x, uint32_t units, int32_t given, int32_t *h, int16_t *y);
/* Complex h = factor h + x 2^left, y = h 2^-right; factor in 2^-30. */
void edp_q_rotation(const int16_t *x, const int32_t *factor, uint32_t states, uint32_t left, uint32_t right, int32_t *h,
                    int16_t *y);
void edp_q_trailing_mean(const int16_t *x, uint32_t n, uint32_t window, int16_t *past, edp_ring *ring, int16_t *y);
/* `weights` holds window numbers; past (window - 1, n), scores (window - 1). */
void edp_q_attention_pool(const int16_t *x, const edp_q_matrix *score, uint32_t n, uint32_t window, int16_t *past,
                          int32_t *scores, edp_ring *ring, int32_t *weights, int16_t *y);

#endif
