/* Runtime of exported predictors: C99, float32, no heap, no globals, no recursion, fixed trip counts.
 *
 * The same file serves every model. All memory belongs to the caller. Matrices are row-major; `out` and `in` are
 * their rows and columns. Unless said otherwise, `y` must not overlap with what is read.
 * Build with -ffp-contract=off (GCC, Clang): then the results are the same bits at every optimisation level.
 */
#ifndef EDP_RUNTIME_H
#define EDP_RUNTIME_H

#include <stdbool.h>
#include <stdint.h>

/* What a call of a model's `step` or `missed` has done. */
typedef enum {
    EDP_OK = 0,        /* a prediction from this tick's inputs */
    EDP_WARMING = 1,   /* the same, but fewer ticks than a whole window since the last reset: less accurate */
    EDP_HELD = 2,      /* inputs were rejected or missed; a prediction from the last accepted ones */
    EDP_RESTARTED = 3, /* nothing left to hold, or a result that is not finite: memory cleared, NO prediction */
    EDP_NOT_RESET = 4  /* the state was never reset, or belongs to another model: NO prediction */
} edp_status;

/* Where a ring of past ticks is written next, and how many ticks it has seen (no more than it needs to know). */
typedef struct {
    uint32_t at;
    uint32_t seen;
} edp_ring;

/* A constant array of a model, for its checksum. */
typedef struct {
    const void *values;
    uint32_t count;
    uint32_t width; /* bytes of a number: 1, 2 or 4 */
} edp_table;

/* Weights of an LSTM, gates in the order i, f, g, o. */
typedef struct {
    const float *weight_x; /* (4 units, in) */
    const float *weight_h; /* (4 units, units) */
    const float *bias;     /* (4 units) */
    float share;           /* of the new h and c that is taken: 1 without zoneout */
} edp_lstm_weights;

/* What a layer-norm LSTM has besides. */
typedef struct {
    const float *gain_x;  /* (4 units) */
    const float *gain_h;  /* (4 units) */
    const float *gain_c;  /* (units) */
    const float *shift_c; /* (units) */
    float epsilon;
} edp_lstm_norms;

/* Weights of a GRU, gates in the order r, z, n. */
typedef struct {
    const float *weight_x; /* (3 units, in) */
    const float *weight_h; /* (3 units, units) */
    const float *bias_x;   /* (3 units) */
    const float *bias_h;   /* (3 units) */
} edp_gru_weights;

/* A network that corrects the memory of others once, from the first ticks after a reset. */
typedef struct {
    const float *first_weight;  /* (hidden, 2 in) */
    const float *first_bias;    /* (hidden) */
    const float *second_weight; /* (out, hidden) */
    const float *second_bias;   /* (out) */
    uint32_t hidden;
    uint32_t out;
    uint32_t ticks;
} edp_prefix_weights;

/* ---- checks ---------------------------------------------------------------------------------------------------- */

/* True unless x is NaN or infinite; works on the bits, so that no compiler flag can take it away. */
bool edp_finite(float x);
/* True if every x[i] is finite and low[i] <= x[i] <= high[i]. */
bool edp_valid(const float *x, const float *low, const float *high, uint32_t n);
bool edp_all_finite(const float *x, uint32_t n);
/* CRC-32 (polynomial 0xEDB88320) of arrays, the low byte of each number first on every machine. */
uint32_t edp_crc(const edp_table *tables, uint32_t count);

/* ---- element by element; y may be x ---------------------------------------------------------------------------- */

float edp_exp(float x);
float edp_tanh(float x);
float edp_sigmoid(float x);

void edp_fill(float value, uint32_t n, float *y);
void edp_copy(const float *x, uint32_t n, float *y);
void edp_gather(const float *x, const uint16_t *columns, uint32_t n, float *y); /* y must not be x */
void edp_standardise(const float *x, const float *offset, const float *scale, uint32_t n, float *y);
void edp_scale_shift(const float *x, const float *gain, const float *shift, uint32_t n, float *y);
void edp_add(const float *a, const float *b, uint32_t n, float *y);
void edp_subtract(const float *a, const float *b, uint32_t n, float *y);
void edp_multiply(const float *a, const float *b, uint32_t n, float *y);
void edp_divide(const float *a, const float *b, uint32_t n, float *y);
void edp_minimum(const float *a, const float *b, uint32_t n, float *y);
void edp_maximum(const float *a, const float *b, uint32_t n, float *y);
void edp_map_relu(const float *x, uint32_t n, float *y);
void edp_map_sigmoid(const float *x, uint32_t n, float *y);
void edp_map_tanh(const float *x, uint32_t n, float *y);
void edp_map_gelu(const float *x, uint32_t n, float *y);
void edp_map_softplus(const float *x, uint32_t n, float *y);
void edp_map_exp(const float *x, uint32_t n, float *y);
void edp_map_sqrt(const float *x, uint32_t n, float *y);
void edp_map_sine(const float *x, uint32_t n, float *y);
void edp_map_cosine(const float *x, uint32_t n, float *y);
void edp_map_log(const float *x, uint32_t n, float *y);
void edp_map_positive(const float *x, uint32_t n, float *y); /* 1 where x > 0, else 0 */

/* ---- rows ------------------------------------------------------------------------------------------------------ */

/* Each of `rows` rows of 2 n numbers: first half times sigmoid of the second. */
void edp_glu(const float *x, uint32_t rows, uint32_t n, float *y);
/* y += W x with the columns of W from `first` on, `in` of them; W has `out` rows of `columns` numbers. Its rows lie in
   panels of EDP_PANEL, each of them column by column; the rows that are left over lie one after the other. */
#define EDP_PANEL 16u
void edp_product(const float *x, const float *weight, uint32_t first, uint32_t columns, uint32_t out, uint32_t in,
                 float *y);
/* Scores to weights that sum to 1, in place. */
void edp_softmax(float *scores, uint32_t n);
/* Running sums down `rows` rows of n numbers. */
void edp_accumulate(const float *x, uint32_t rows, uint32_t n, float *y);
/* W x + b on each of `rows` rows. */
void edp_dense(const float *x, const float *weight, const float *bias, uint32_t rows, uint32_t out, uint32_t in,
               float *y);
/* The same, row i with its own W (out, in) and b. */
void edp_grouped_dense(const float *x, const float *weight, const float *bias, uint32_t rows, uint32_t out, uint32_t in,
                       float *y);
/* Sums of complete trees: features and thresholds (outputs, trees, 2^depth - 1), leaves (outputs, trees, 2^depth). From
   node 0 on, node i goes to 2 i + 2 where x[feature] > threshold, else to 2 i + 1. Always as many comparisons. */
void edp_trees(const float *x, const uint16_t *feature, const float *threshold, const float *leaf, uint32_t outputs,
               uint32_t trees, uint32_t depth, float *y);
/* y may be x or shift. */
void edp_layer_norm(const float *x, const float *gain, const float *shift, float epsilon, uint32_t rows, uint32_t n,
                    float *y);
/* Every row of q attends to all rows of k and v; `scores` holds `rows` numbers. */
void edp_row_attention(const float *q, const float *k, const float *v, uint32_t rows, uint32_t n, float *scores,
                       float *y);

/* ---- with memory ----------------------------------------------------------------------------------------------- */

/* factor (x - before); at the first tick `before` is 0 if from_zero, else x. */
void edp_difference(const float *x, const float *factor, uint32_t n, bool from_zero, float *before, edp_ring *ring,
                    float *y);
/* [x ; 1] in the first `ticks` ticks, [mean ; 0] from then on; y holds n + 1 numbers. */
void edp_starting(const float *x, const float *mean, uint32_t n, uint32_t ticks, edp_ring *ring, float *y);
/* Causal convolution; weight (out, taps, in), the last tap is the present; past ((taps - 1) dilation, in). */
void edp_convolution(const float *x, const float *weight, const float *bias, uint32_t out, uint32_t taps, uint32_t in,
                     uint32_t dilation, float *past, edp_ring *ring, float *y);
/* y is the new h; `gates` holds 4 units numbers. */
void edp_lstm(const float *x, const edp_lstm_weights *w, uint32_t in, uint32_t units, float *h, float *c, float *gates,
              float *y);
/* `gates` holds 8 units numbers. */
void edp_layer_norm_lstm(const float *x, const edp_lstm_weights *w, const edp_lstm_norms *norms, uint32_t in,
                         uint32_t units, float *h, float *c, float *gates, float *y);
/* `gates` holds 6 units numbers. */
void edp_gru(const float *x, const edp_gru_weights *w, uint32_t in, uint32_t units, float *h, float *gates, float *y);
/* x holds gate and candidate, 2 units numbers. */
void edp_min_gru(const float *x, uint32_t units, float *h, float *y);
/* Complex h = factor h + x, pairs of real and imaginary part. */
void edp_rotation(const float *x, const float *factor, uint32_t states, float *h, float *y);
void edp_trailing_mean(const float *x, uint32_t n, uint32_t window, float *past, edp_ring *ring, float *y);
/* `weights` holds `window` numbers; past (window - 1, n), scores (window - 1). */
void edp_attention_pool(const float *x, const float *score, float bias, uint32_t n, uint32_t window, float *past,
                        float *scores, edp_ring *ring, float *weights, float *y);
/* `weights` holds `window` numbers; keys and values (window - 1, n). */
void edp_window_attention(const float *q, const float *k, const float *v, uint32_t n, uint32_t heads, uint32_t window,
                          float *keys, float *values, edp_ring *ring, float *weights, float *y);
/* True at the one tick at which `correction` was written; `work` holds 2 in + hidden numbers. */
bool edp_prefix(const float *x, const edp_prefix_weights *w, uint32_t in, float *total, edp_ring *ring, float *work,
                float *correction);

#endif
