/* From residuals to alarms: what every exported monitor needs. C99, double precision, no heap, no globals, no libm.
 *
 * Every sum is taken in the order of its index, from zero, and every operation is one of + - * / and a square root that
 * is rounded correctly: with -ffp-contract=off (GCC, Clang) the numbers are those of Python bit for bit, on every machine
 * with IEEE arithmetic. On a core without double precision in hardware they are computed by the compiler's library.
 */
#ifndef EDP_CHAIN_H
#define EDP_CHAIN_H

#include <stdbool.h>
#include <stdint.h>

/* The square root, rounded to nearest as IEEE 754 asks; NaN of what is negative. By integers: it calls no library. */
double edp_root(double x);
/* True unless x is NaN or infinite; works on the bits, so that no compiler flag can take it away. */
bool edp_known(double x);
/* What stands for a number that is not there. */
double edp_unknown(void);
/* The sum of products x[i] y[i * stride] over i < n. */
double edp_dot(const double *x, const double *y, uint32_t n, uint32_t stride);

/* ---- detectors: one row of white residuals in, a statistic out ---------------------------------------------------- */

/* Multivariate CUSUM; `sums` (n) is its memory. */
double edp_cusum(double slack, const double *row, uint32_t n, double *sums);
/* T2 of exponentially weighted means; `means` (n) is its memory, `factor` is (2 - weight) / weight. */
double edp_ewma(double weight, double factor, const double *row, uint32_t n, double *means);
/* Likelihood ratio of a shift that began `length` rows ago; `sums` (n) of that length. The sum of a length is that of the
   next shorter one before this row, and the row: lengths are taken from the longest down, `before` is that of length - 1,
   NULL for length 1. */
double edp_glr_ratio(const double *row, uint32_t n, const double *before, uint32_t length, double *sums);
void edp_clear(uint32_t n, double *values);

#endif
