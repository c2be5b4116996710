/* Several lanes of one network side by side: a weight is read once for four of them. C99, float32.
 *
 * What a pointer points at belongs to the first lane; that of lane k lies k strides (numbers) behind it. Sums run in the
 * order of the columns, so that a lane has the bits of edp_runtime.h.
 */
#ifndef EDP_LANES_H
#define EDP_LANES_H

#include "edp_runtime.h"

/* See edp_dense, of one row. */
void edp_dense_lanes(const float *x, uint32_t x_stride, const float *weight, const float *bias, uint32_t out, uint32_t in,
                     float *y, uint32_t y_stride, uint32_t lanes);
/* See edp_gru, but for the last bits of its gates; x, gates and y have the stride of the work memory. */
void edp_gru_lanes(const float *x, const edp_gru_weights *w, uint32_t in, uint32_t units, float *h, uint32_t h_stride,
                   float *gates, float *y, uint32_t stride, uint32_t lanes);

#endif
