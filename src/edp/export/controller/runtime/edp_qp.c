/* From a quadratic program to the least-distance form that DAQP solves: with H = R' R and x = R^-1 (u - v), v = R'^-1 f,
 * minimise |u|^2 / 2 with rows of A R^-1, each of length 1. */
#include "edp_qp.h"

#include "daqp/daqp.h"

#include <math.h>
#include <stddef.h>

#ifdef DAQP_SINGLE_PRECISION
/* Rounding is 1e-7 here; a price of 1e-6 for a violation would drown in it. */
#define PRIMAL_TOLERANCE 1e-5f
#define DUAL_TOLERANCE 1e-6f
#define ZERO_TOLERANCE 1e-10f
#define PROGRESS_TOLERANCE 1e-7f
#define SINGULAR_TOLERANCE 1e-6f
#define REFACTOR_TOLERANCE 1e-5f
#define SOFTNESS 1e-4f
#define ROOT sqrtf
#else
/* DAQP's own. */
#define PRIMAL_TOLERANCE DAQP_DEFAULT_PRIM_TOL
#define DUAL_TOLERANCE DAQP_DEFAULT_DUAL_TOL
#define ZERO_TOLERANCE DAQP_DEFAULT_ZERO_TOL
#define PROGRESS_TOLERANCE DAQP_DEFAULT_PROG_TOL
#define SINGULAR_TOLERANCE DAQP_DEFAULT_SING_TOL
#define REFACTOR_TOLERANCE DAQP_DEFAULT_REFACTOR_TOL
#define SOFTNESS DAQP_DEFAULT_RHO_SOFT
#define ROOT sqrt
#endif

/* The next `count` numbers of the memory. */
static c_float *taken(c_float **next, uint32_t count) {
    c_float *const place = *next;
    *next = place + count;
    return place;
}

static bool finite_numbers(const c_float *x, uint32_t n) {
    bool finite = true;
    for (uint32_t i = 0; i < n; i++) {
        finite = finite && (isfinite(x[i]) != 0);
    }
    return finite;
}

/* R^-1, packed row by row, of H = R' R; false where H is not positive definite. */
static bool inverse_factor(const c_float *hessian, uint32_t n, c_float *r) {
    uint32_t at = 0;
    for (uint32_t i = 0; i < n; i++) {
        for (uint32_t j = i; j < n; j++) {
            c_float sum = hessian[i * n + j];
            uint32_t row = 0; /* where row k begins, less k */
            for (uint32_t k = 0; k < i; k++) {
                sum -= r[row + i] * r[row + j];
                row += n - k - 1u;
            }
            if (j > i) {
                r[at + j - i] = sum * r[at];
            } else if (sum > (c_float)ZERO_TOLERANCE) {
                r[at] = (c_float)1.0 / ROOT(sum); /* the diagonal is kept inverted */
            } else {
                return false;
            }
        }
        at += n - i;
    }
    /* Column by column from the diagonal up: the inverse of a triangle, in place. */
    for (uint32_t j = n; j-- > 0u;) {
        for (uint32_t i = j; i-- > 0u;) {
            const uint32_t own = i * n - (i * (i + 1u)) / 2u; /* where row i begins, less i */
            c_float sum = 0;
            for (uint32_t k = i + 1u; k <= j; k++) {
                /* Entries (i, k) beyond j are inverted already, those up to j are not. */
                sum += r[own + k] * r[k * n - (k * (k + 1u)) / 2u + j];
            }
            r[own + j] = -sum * r[own + i];
        }
    }
    return true;
}

/* 1 over the length of a row. */
static c_float unit(const c_float *row, uint32_t n) {
    c_float sum = 0;
    for (uint32_t j = 0; j < n; j++) {
        sum += row[j] * row[j];
    }
    return (sum < (c_float)ZERO_TOLERANCE) ? 0 : (c_float)1.0 / ROOT(sum);
}

/* Length one for a row, its bounds with it, and these moved by what it makes of v. */
static void set_row(DAQPWorkspace *work, uint32_t which, c_float *row, const c_float *v, uint32_t n, const edp_qp *qp) {
    const c_float scale = work->scaling[which];
    c_float moved = 0;
    for (uint32_t j = 0; j < n; j++) {
        row[j] *= scale;
        moved += row[j] * v[j];
    }
    work->dupper[which] = qp->upper[which] * scale + moved;
    work->dlower[which] = qp->lower[which] * scale + moved;
}

/* Marks of a constraint; false where its bounds contradict each other. */
static bool marked(const edp_qp *qp, uint32_t which, int *sense) {
    const c_float room = qp->upper[which] - qp->lower[which];
    const bool soft = qp->soft && (which >= qp->variables);
    *sense = soft ? DAQP_SOFT : 0;
    if ((room < (c_float)ZERO_TOLERANCE) && !soft) {
        *sense = DAQP_ACTIVE | DAQP_IMMUTABLE;
    }
    return room >= -(c_float)PRIMAL_TOLERANCE;
}

/* The rows of A; false where a hard row that depends on no variable cannot hold. */
static bool set_matrix(DAQPWorkspace *work, const edp_qp *qp) {
    const uint32_t n = qp->variables;
    for (uint32_t i = 0; i < qp->rows; i++) {
        const c_float *const from = qp->matrix + i * n;
        c_float *const row = work->M + i * n;
        const uint32_t which = n + i;
        uint32_t at = (n * (n + 1u)) / 2u;
        for (uint32_t j = n; j-- > 0u;) {
            row[j] = 0;
        }
        at = 0;
        for (uint32_t k = 0; k < n; k++) {
            for (uint32_t j = k; j < n; j++) {
                row[j] += from[k] * work->Rinv[at + j - k];
            }
            at += n - k;
        }
        work->scaling[which] = unit(row, n);
        if (work->scaling[which] == 0) {
            const bool holds = (qp->upper[which] >= -(c_float)ZERO_TOLERANCE) &&
                               (qp->lower[which] <= (c_float)ZERO_TOLERANCE);
            if (!holds && !qp->soft) {
                return false;
            }
            work->scaling[which] = 1;
            work->sense[which] = DAQP_IMMUTABLE; /* not active and immutable: left out */
        }
        set_row(work, which, row, work->v, n, qp);
    }
    return true;
}

/* Least-distance form in the memory. */
static edp_qp_status prepared(DAQPWorkspace *work, const edp_qp *qp) {
    const uint32_t n = qp->variables;
    const uint32_t every = n + qp->rows;
    if (!finite_numbers(qp->hessian, n * n) || !finite_numbers(qp->gradient, n) ||
        !finite_numbers(qp->matrix, qp->rows * n) || !finite_numbers(qp->lower, every) ||
        !finite_numbers(qp->upper, every)) {
        return EDP_QP_SINGULAR;
    }
    for (uint32_t i = 0; i < every; i++) {
        if (!marked(qp, i, &work->sense[i])) {
            return EDP_QP_INFEASIBLE;
        }
    }
    if (!inverse_factor(qp->hessian, n, work->Rinv)) {
        return EDP_QP_SINGULAR;
    }
    for (uint32_t j = 0; j < n; j++) {
        work->v[j] = 0;
    }
    uint32_t at = 0;
    for (uint32_t k = 0; k < n; k++) {
        for (uint32_t j = k; j < n; j++) {
            work->v[j] += work->Rinv[at + j - k] * qp->gradient[k];
        }
        at += n - k;
    }
    if (!set_matrix(work, qp)) {
        return EDP_QP_INFEASIBLE;
    }
    /* The bounds' rows are those of R^-1: scaled last, since the matrix needs them as they are. */
    at = 0;
    for (uint32_t i = 0; i < n; i++) {
        work->scaling[i] = unit(work->Rinv + at, n - i);
        set_row(work, i, work->Rinv + at, work->v + i, n - i, qp);
        at += n - i;
    }
    work->state = DAQP_STATE_RINV_NORMALIZED;
    return EDP_QP_OPTIMAL;
}

/* True if a hard bound or row is violated. */
static bool violated(const edp_qp *qp, const DAQPWorkspace *work, const c_float *x) {
    const uint32_t n = qp->variables;
    bool beyond = false;
    for (uint32_t i = 0; i < n + qp->rows; i++) {
        c_float value = 0;
        if ((work->sense[i] & DAQP_SOFT) != 0) {
            continue;
        }
        if (i < n) {
            value = x[i];
        } else {
            for (uint32_t j = 0; j < n; j++) {
                value += qp->matrix[(i - n) * n + j] * x[j];
            }
        }
        beyond = beyond || (value > qp->upper[i] + (c_float)PRIMAL_TOLERANCE) ||
                 (value < qp->lower[i] - (c_float)PRIMAL_TOLERANCE);
    }
    return beyond;
}

/* Places of the workspace in the memory. */
static void lay_out(DAQPWorkspace *work, const edp_qp *qp) {
    const uint32_t n = qp->variables;
    const uint32_t rows = qp->rows;
    const uint32_t total = EDP_QP_TOTAL(n, rows);
    c_float *next = qp->numbers;
    work->n = (int)n;
    work->m = (int)(n + rows);
    work->ms = (int)n;
    work->Rinv = taken(&next, (n * (n + 1u)) / 2u);
    work->v = taken(&next, n);
    work->x = taken(&next, n + 1u);
    work->xold = taken(&next, n + 1u);
    work->u = taken(&next, n + 1u);
    work->M = taken(&next, rows * n);
    work->dupper = taken(&next, n + rows);
    work->dlower = taken(&next, n + rows);
    work->scaling = taken(&next, n + rows);
    work->Mu = taken(&next, rows);
    work->lam = taken(&next, total);
    work->lam_star = taken(&next, total);
    work->D = taken(&next, total);
    work->xldl = taken(&next, total);
    work->zldl = taken(&next, total);
    work->L = taken(&next, (total * (total + 1u)) / 2u);
    work->sense = qp->integers;
    work->WS = qp->integers + n + rows;
}

edp_qp_status edp_qp_solve(const edp_qp *qp, c_float *x, uint32_t *used) {
    /* A pivot tolerance of zero: DAQP's exchange of neighbours, which calls itself, is never entered. */
    DAQPSettings settings = {.primal_tol = (c_float)PRIMAL_TOLERANCE,
                             .dual_tol = (c_float)DUAL_TOLERANCE,
                             .zero_tol = (c_float)ZERO_TOLERANCE,
                             .pivot_tol = 0,
                             .progress_tol = (c_float)PROGRESS_TOLERANCE,
                             .cycle_tol = DAQP_DEFAULT_CYCLE_TOL,
                             .iter_limit = (int)qp->iterations,
                             .fval_bound = DAQP_INF,
                             .rho_soft = (c_float)SOFTNESS,
                             .sing_tol = (c_float)SINGULAR_TOLERANCE,
                             .refactor_tol = (c_float)REFACTOR_TOLERANCE};
    DAQPProblem problem = {.n = (int)qp->variables,
                           .m = (int)(qp->variables + qp->rows),
                           .ms = (int)qp->variables,
                           .H = qp->hessian,
                           .f = qp->gradient,
                           .A = qp->matrix,
                           .bupper = qp->upper,
                           .blower = qp->lower};
    DAQPWorkspace work = {.qp = &problem, .settings = &settings};
    *used = 0u;
    lay_out(&work, qp);
    edp_qp_status status = prepared(&work, qp);
    if (status != EDP_QP_OPTIMAL) {
        return status;
    }
    reset_daqp_workspace(&work);
    if (daqp_activate_constraints(&work) < 0) {
        return EDP_QP_INFEASIBLE;
    }
    const int flag = daqp_ldp(&work);
    *used = (uint32_t)work.iterations;
    if (flag > 0) {
        ldp2qp_solution(&work);
        daqp_refine_primal(&work);
        if (!finite_numbers(work.x, qp->variables)) {
            return EDP_QP_SINGULAR;
        }
        if (((work.state & DAQP_STATE_NOISE_FLOOR) != 0) && violated(qp, &work, work.x)) {
            return EDP_QP_CYCLE;
        }
        for (uint32_t i = 0; i < qp->variables; i++) {
            x[i] = work.x[i];
        }
        return (flag == DAQP_EXIT_SOFT_OPTIMAL) ? EDP_QP_SOFT : EDP_QP_OPTIMAL;
    }
    if (flag == DAQP_EXIT_ITERLIMIT) {
        return EDP_QP_LIMIT;
    }
    return (flag == DAQP_EXIT_INFEASIBLE) ? EDP_QP_INFEASIBLE : EDP_QP_CYCLE;
}
