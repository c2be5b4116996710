/* Tangents of the runtime's functions: how their results change with what they read (forward mode), along several
 * directions at once. C99, float32, no heap, no globals, no recursion.
 *
 * A function F has F_tangent here; `dx` is the change of `x`. What `dx` points at are the changes along the first
 * direction; those along direction k lie k * stride numbers behind them. Unless said otherwise a tangent is called
 * BEFORE its function, with the memory as it was, and brings the changes of that memory on. At a kink (ReLU, minimum,
 * maximum) the change is that of one side.
 */
#ifndef EDP_TANGENT_H
#define EDP_TANGENT_H

#include "edp_runtime.h"

typedef struct {
    uint32_t count;
    uint32_t stride; /* numbers from one direction to the next */
} edp_directions;

/* ---- element by element ---------------------------------------------------------------------------------------- */

void edp_fill_tangent(uint32_t n, edp_directions d, float *dy); /* zero */
void edp_copy_tangent(const float *dx, uint32_t n, edp_directions d, float *dy);
void edp_gather_tangent(const float *dx, const uint16_t *columns, uint32_t n, edp_directions d, float *dy);
void edp_standardise_tangent(const float *dx, const float *scale, uint32_t n, edp_directions d, float *dy);
/* slope dx: of a function whose slopes are known. */
void edp_scale_tangent(const float *dx, const float *slope, uint32_t n, edp_directions d, float *dy);
void edp_add_tangent(const float *da, const float *db, uint32_t n, edp_directions d, float *dy);
void edp_subtract_tangent(const float *da, const float *db, uint32_t n, edp_directions d, float *dy);
void edp_multiply_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n,
                          edp_directions d, float *dy);
void edp_divide_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n, edp_directions d,
                        float *dy);
void edp_minimum_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n,
                         edp_directions d, float *dy);
void edp_maximum_tangent(const float *a, const float *b, const float *da, const float *db, uint32_t n,
                         edp_directions d, float *dy);
void edp_clip_tangent(const float *x, const float *dx, const float *low, const float *high, uint32_t n,
                      edp_directions d, float *dy); /* zero where a bound acts */

/* Slopes of edp_map_... at x. */
void edp_slope_relu(const float *x, uint32_t n, float *slope);
void edp_slope_sigmoid(const float *x, uint32_t n, float *slope);
void edp_slope_tanh(const float *x, uint32_t n, float *slope);
void edp_slope_gelu(const float *x, uint32_t n, float *slope);
void edp_slope_softplus(const float *x, uint32_t n, float *slope);
void edp_slope_exp(const float *x, uint32_t n, float *slope);
void edp_slope_sqrt(const float *x, uint32_t n, float *slope); /* infinite at 0 */
void edp_slope_sine(const float *x, uint32_t n, float *slope);
void edp_slope_cosine(const float *x, uint32_t n, float *slope);
void edp_slope_log(const float *x, uint32_t n, float *slope);
void edp_slope_positive(const float *x, uint32_t n, float *slope); /* 0 */

/* ---- rows ------------------------------------------------------------------------------------------------------ */

float edp_dot(const float *a, const float *b, uint32_t n);
/* Changes of scores to those of the weights that edp_softmax made of them, in place, along one direction. */
void edp_softmax_tangent(const float *weights, uint32_t n, float *dscores);
void edp_glu_tangent(const float *x, const float *dx, uint32_t rows, uint32_t n, edp_directions d, float *dy);
void edp_accumulate_tangent(const float *dx, uint32_t rows, uint32_t n, edp_directions d, float *dy);
void edp_dense_tangent(const float *dx, const float *weight, uint32_t rows, uint32_t out, uint32_t in,
                       edp_directions d, float *dy);
void edp_grouped_dense_tangent(const float *dx, const float *weight, uint32_t rows, uint32_t out, uint32_t in,
                               edp_directions d, float *dy);
/* dy may be dx. */
void edp_layer_norm_tangent(const float *x, const float *dx, const float *gain, float epsilon, uint32_t rows, uint32_t n,
                            edp_directions d, float *dy);
/* `scores` holds `rows` numbers, `dscores` as many along each direction. */
void edp_row_attention_tangent(const float *const qkv[3], const float *const dqkv[3], uint32_t rows, uint32_t n,
                               float *scores, float *dscores, edp_directions d, float *dy);

/* ---- with memory ----------------------------------------------------------------------------------------------- */

void edp_difference_tangent(const float *dx, const float *factor, uint32_t n, bool from_zero, const edp_ring *ring,
                            float *dbefore, edp_directions d, float *dy);
void edp_starting_tangent(const float *dx, uint32_t n, uint32_t ticks, const edp_ring *ring, edp_directions d,
                          float *dy);
void edp_convolution_tangent(const float *dx, const float *weight, uint32_t out, uint32_t taps, uint32_t in,
                             uint32_t dilation, const edp_ring *ring, float *dpast, edp_directions d, float *dy);
/* Changes of the gates, 4 units numbers along each direction. */
void edp_lstm_gates_tangent(const float *dx, const float *dh, const edp_lstm_weights *w, uint32_t in, uint32_t units,
                            edp_directions d, float *dgates);
/* The same of a layer-norm LSTM: `gates` and `dgates` hold 8 units numbers. */
void edp_layer_norm_gates_tangent(const float *x, const float *dx, const float *h, const float *dh,
                                  const edp_lstm_weights *w, const edp_lstm_norms *norms, uint32_t in, uint32_t units,
                                  float *gates, edp_directions d, float *dgates);
/* AFTER the LSTM: `gates` as it left them, `old` the cell as it was before, which is overwritten; no norms: NULL. */
void edp_lstm_cell_tangent(const float *gates, uint32_t units, float share, const edp_lstm_norms *norms, float *old,
                           float *dgates, float *dh, float *dc, edp_directions d, float *dy);
/* AFTER edp_gru: `gates` as it left them, `old` is h as it was before; dgates 6 units numbers. */
void edp_gru_tangent(const float *dx, const edp_gru_weights *w, uint32_t in, uint32_t units, const float *gates,
                     const float *old, float *dgates, float *dh, edp_directions d, float *dy);
void edp_min_gru_tangent(const float *x, const float *dx, uint32_t units, const float *h, float *dh, edp_directions d,
                         float *dy);
void edp_rotation_tangent(const float *dx, const float *factor, uint32_t states, float *dh, edp_directions d,
                          float *dy);
void edp_trailing_mean_tangent(const float *dx, uint32_t n, uint32_t window, const edp_ring *ring, float *dpast,
                               edp_directions d, float *dy);

/* What is remembered by attention over a window: rings of `size` numbers a tick, and where they are written. */
typedef struct {
    const float *past[2]; /* inputs and scores, or keys and values */
    float *dpast[2];
    const edp_ring *ring;
    uint32_t window;
    float *weights;  /* holds `window` numbers */
    float *dweights; /* as many along each direction */
} edp_attended;

void edp_attention_pool_tangent(const float *x, const float *dx, const float *score, float bias, uint32_t n,
                                const edp_attended *held, edp_directions d, float *dy);
void edp_window_attention_tangent(const float *const qkv[3], const float *const dqkv[3], uint32_t n, uint32_t heads,
                                  const edp_attended *held, edp_directions d, float *dy);
/* True at the one tick at which `dwork` has the changes of the correction, behind 2 in + hidden numbers; `work` holds
   2 in + hidden numbers. */
bool edp_prefix_tangent(const float *x, const float *dx, const edp_prefix_weights *w, uint32_t in, const float *total,
                        float *dtotal, const edp_ring *ring, float *work, float *dwork, edp_directions d);

#endif
