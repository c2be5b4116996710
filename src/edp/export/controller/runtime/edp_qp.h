/* Dense quadratic programs of a controller: C99, no heap, no globals, a bounded number of iterations.
 *
 *     minimise x' H x / 2 + f' x   with   lower <= x <= upper,  row_lower <= A x <= row_upper
 *
 * H is symmetric and positive definite. Rows may be soft: violated at a price. The program is brought into least-distance
 * form here and solved by DAQP's dual active-set method (daqp/, MIT licence). DAQP computes in double precision; with
 * DAQP_SINGLE_PRECISION defined for ALL files, in single precision, for cores without double arithmetic.
 */
#ifndef EDP_QP_H
#define EDP_QP_H

#include "daqp/types.h"

#include <stdbool.h>
#include <stdint.h>

/* What a solution is. */
typedef enum {
    EDP_QP_OPTIMAL = 0,
    EDP_QP_SOFT = 1,       /* optimal; a soft row is violated */
    EDP_QP_INFEASIBLE = 2, /* hard bounds or rows contradict one another */
    EDP_QP_LIMIT = 3,      /* more iterations than allowed */
    EDP_QP_SINGULAR = 4,   /* H is not positive definite, or a number is not finite */
    EDP_QP_CYCLE = 5       /* no progress within rounding */
} edp_qp_status;

/* Numbers and integers of the memory of n variables and up to r rows. */
#define EDP_QP_TOTAL(n, r) ((n) + (r) + 1u)
#define EDP_QP_NUMBERS(n, r)                                                                                            \
    (((n) * ((n) + 1u)) / 2u + 4u * (n) + 3u + (r) * (n) + 3u * ((n) + (r)) + (r) + 5u * EDP_QP_TOTAL(n, r) +           \
     (EDP_QP_TOTAL(n, r) * (EDP_QP_TOTAL(n, r) + 1u)) / 2u)
#define EDP_QP_INTEGERS(n, r) ((n) + (r) + EDP_QP_TOTAL(n, r))

/* A program; matrices row by row. Bounds of the variables come first, those of the rows behind them; 1e30 is none. */
typedef struct {
    uint32_t variables;
    uint32_t rows;
    uint32_t iterations; /* limit */
    bool soft;           /* all rows are */
    c_float *hessian;    /* (variables, variables) */
    c_float *gradient;   /* (variables) */
    c_float *matrix;     /* (rows, variables) */
    c_float *lower;      /* (variables + rows) */
    c_float *upper;      /* (variables + rows) */
    c_float *numbers;    /* EDP_QP_NUMBERS of these sizes */
    int *integers;       /* EDP_QP_INTEGERS of these sizes */
} edp_qp;

/* Solves; `x` is written for EDP_QP_OPTIMAL and EDP_QP_SOFT, `used` (iterations) always. */
edp_qp_status edp_qp_solve(const edp_qp *qp, c_float *x, uint32_t *used);

#endif
