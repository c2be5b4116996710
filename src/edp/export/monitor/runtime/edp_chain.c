/* Arithmetic and detectors of exported monitors; see edp_chain.h. */
#include "edp_chain.h"

#include <stddef.h>
#include <string.h>

#define EXPONENT 0x7FF0000000000000u
#define MANTISSA 0x000FFFFFFFFFFFFFu
#define HIDDEN 0x0010000000000000u
#define EDP_NEAR_ZERO 0.05 /* of healthy variance, added below gain and lag: a channel at rest tells neither */

static uint64_t bits_of(double x) {
    uint64_t bits;
    (void)memcpy(&bits, &x, sizeof bits);
    return bits;
}

static double from_bits(uint64_t bits) {
    double x;
    (void)memcpy(&x, &bits, sizeof x);
    return x;
}

bool edp_known(double x) { return (bits_of(x) & EXPONENT) != EXPONENT; }

double edp_unknown(void) { return from_bits(EXPONENT | (HIDDEN >> 1)); }

double edp_root(double x) {
    double result = x; /* zero with its sign, NaN and +infinity are their own roots */
    if (x < 0.0) {
        result = edp_unknown();
    } else if ((x > 0.0) && edp_known(x)) {
        /* 2^54 brings what is subnormal into the normal range, without rounding. */
        const bool tiny = bits_of(x) < HIDDEN;
        const uint64_t bits = bits_of(tiny ? (x * 18014398509481984.0) : x);
        const int32_t power = (int32_t)(bits >> 52) - 1023;
        uint64_t left = (bits & MANTISSA) | HIDDEN;
        uint64_t root = 0u;
        uint64_t twice = 0u;
        int32_t half = power / 2;
        if ((power % 2) != 0) { /* an even power of two is left outside */
            left <<= 1;
            half -= (power < 0) ? 1 : 0;
        }
        /* Digit by digit: 53 bits of the root, and one to round by. */
        left <<= 1;
        for (uint64_t digit = HIDDEN << 1; digit != 0u; digit >>= 1) {
            const uint64_t next = twice + digit;
            if (next <= left) {
                twice = next + digit;
                left -= next;
                root += digit;
            }
            left <<= 1;
        }
        /* A root is never halfway between two numbers. */
        root += root & 1u;
        result = from_bits((root >> 1) + ((uint64_t)(int64_t)(half + 1022) << 52));
        result = tiny ? (result * 7.450580596923828125e-9) : result; /* 2^-27 */
    }
    return result;
}

float edp_dot(const float *x, const float *y, uint32_t n) {
    float sum = 0.0f;
    for (uint32_t i = 0; i < n; i++) {
        sum += x[i] * y[i];
    }
    return sum;
}

uint32_t edp_crc_doubles(uint32_t crc, const double *values, uint32_t n) {
    uint32_t left = crc ^ 0xFFFFFFFFu;
    for (uint32_t i = 0; i < n; i++) {
        uint64_t bits = bits_of(values[i]);
        for (uint32_t bit = 0; bit < 64u; bit++) {
            const uint32_t low = (left ^ (uint32_t)(bits & 1u)) & 1u;
            left = (left >> 1) ^ (0xEDB88320u & (0u - low));
            bits >>= 1;
        }
    }
    return left ^ 0xFFFFFFFFu;
}

/* ---- blocks -------------------------------------------------------------------------------------------------------- */

double edp_within(double x, double low, double high) {
    double y = x;
    if (x < low) {
        y = low;
    } else if (x > high) {
        y = high;
    } else {
        /* within, or NaN */
    }
    return y;
}

static double size_of(double x) { return (x < 0.0) ? -x : x; }

bool edp_plausible(float x, double centre, double spread, double limit) {
    return (size_of((double)x - centre) * spread) <= limit; /* false for NaN */
}

static void add_residual(double r, double u, double d, double *sums) {
    sums[0] += 1.0;
    sums[1] += r;
    sums[2] += r * r;
    sums[3] += r * u;
    sums[5] += r * d;
    sums[7] = (size_of(r) > sums[7]) ? size_of(r) : sums[7];
}

/* Numbers of a residual in the sums of a block. */
static uint32_t stride_of(const edp_blocks *b) { return EDP_SUMS + (2u * b->drivers); }

/* What of a residual goes with what moves its part. */
static void add_drivers(const edp_blocks *b, uint32_t residual, bool known, double r, const double *y, double *own) {
    for (uint32_t k = 0; k < b->drivers; k++) {
        const uint32_t at = (residual * b->drivers) + k;
        const double one = y[b->first[at]];
        const double w = (b->second[at] == EDP_NO_INPUT) ? one : (one - y[b->second[at]]);
        if (known) {
            own[EDP_SUMS + (2u * k)] += r * w;
        }
        own[EDP_SUMS + (2u * k) + 1u] += w * w;
    }
}

void edp_block_tick(const edp_blocks *b, bool first, const float *in, const float *residuals, double *y, double *sums) {
    double *const levels = &sums[stride_of(b) * b->residuals];
    double *const sizes = &levels[b->levels];
    /* Each residual first takes the channel of the tick before, then that of this one. */
    for (uint32_t i = 0; i < b->residuals; i++) {
        const uint32_t c = b->channel[i];
        const double before = y[c];
        const double u = edp_known((double)in[c]) ? (((double)in[c] - b->centre[c]) * b->spread[c]) : before;
        const double d = first ? 0.0 : (u - before);
        double *const own = &sums[stride_of(b) * i];
        if (edp_known((double)residuals[i])) {
            add_residual((double)residuals[i] * b->scale[i], u, d, own);
        }
        own[4] += u * u;
        own[6] += d * d;
    }
    for (uint32_t c = 0; c < b->inputs; c++) {
        if (edp_known((double)in[c])) {
            y[c] = ((double)in[c] - b->centre[c]) * b->spread[c];
        }
    }
    for (uint32_t i = 0; i < b->residuals; i++) {
        const bool known = edp_known((double)residuals[i]);
        add_drivers(b, i, known, known ? ((double)residuals[i] * b->scale[i]) : 0.0, y, &sums[stride_of(b) * i]);
    }
    for (uint32_t i = 0; i < b->levels; i++) {
        levels[i] += y[b->level[i]];
    }
    for (uint32_t i = 0; i < b->moving; i++) {
        sizes[i] += size_of(y[b->size[i]]);
    }
}

void edp_block_summaries(const edp_blocks *b, const double *sums, uint32_t residual, double *summaries) {
    const double *const own = &sums[stride_of(b) * residual];
    const double whole = (double)b->ticks;
    const double n = (own[0] > 1.0) ? own[0] : 1.0;
    const double mean = own[1] / n;
    const double variance = (own[2] / n) - (mean * mean);
    if ((2.0 * own[0]) < whole) {
        for (uint32_t i = 0; i < (EDP_SUMMARIES + b->drivers); i++) {
            summaries[i] = edp_unknown();
        }
    } else {
        summaries[0] = mean;
        summaries[1] = edp_root(edp_root((variance > 0.0) ? variance : 0.0));
        summaries[2] = own[3] / (own[4] + (EDP_NEAR_ZERO * whole));
        summaries[3] = own[5] / (own[6] + ((EDP_NEAR_ZERO * whole) * b->change[residual]));
        summaries[4] = edp_root(own[7]);
        for (uint32_t k = 0; k < b->drivers; k++) {
            const double *const pair = &own[EDP_SUMS + (2u * k)];
            summaries[EDP_SUMMARIES + k] = pair[0] / (pair[1] + (EDP_NEAR_ZERO * whole));
        }
    }
}

void edp_block_point(const edp_blocks *b, const double *sums, const float *offset, const float *width, double limit,
                     float *point) {
    const double *const values = &sums[stride_of(b) * b->residuals];
    const double whole = (double)b->ticks;
    for (uint32_t i = 0; i < (b->levels + b->moving); i++) {
        point[i] = (float)edp_within(((values[i] / whole) - (double)offset[i]) / (double)width[i], -limit, limit);
    }
}

double edp_conditioned(double summary, const float *point, uint32_t n, const float *usual, const float *wide,
                       double floor, double limit) {
    float middle = usual[0];
    float across = wide[0];
    double width;
    for (uint32_t i = 0; i < n; i++) {
        middle += point[i] * usual[i + 1u];
        across += point[i] * wide[i + 1u];
    }
    width = (double)across;
    return edp_within((summary - (double)middle) / ((width > floor) ? width : floor), -limit, limit);
}

/* ---- detectors ----------------------------------------------------------------------------------------------------- */

void edp_clear(uint32_t n, double *values) {
    for (uint32_t i = 0; i < n; i++) {
        values[i] = 0.0;
    }
}

uint32_t edp_pieces(uint32_t n, uint32_t piece) { return (n + (piece - 1u)) / piece; }

/* The place behind the last of a piece. */
static uint32_t end_of(uint32_t first, uint32_t piece, uint32_t n) { return ((n - first) > piece) ? (first + piece) : n; }

/* First the sums and their squares, piece by piece; behind the last of them the statistic; then what is left of the sums. */
static void step_cusum(const edp_watch *w, uint32_t step, const double *row, double *sums, double *kept,
                       double *statistic) {
    const uint32_t pieces = edp_pieces(w->directions, EDP_PIECE);
    const uint32_t first = (step % pieces) * EDP_PIECE;
    const uint32_t end = end_of(first, EDP_PIECE, w->directions);
    if (step < pieces) {
        double squares = (step == 0u) ? 0.0 : *kept;
        for (uint32_t i = first; i < end; i++) {
            sums[i] += row[i];
            squares += sums[i] * sums[i];
        }
        *kept = squares;
        if (end == w->directions) {
            const double length = edp_root(squares);
            const double left = ((length - w->option) > 0.0) ? (length - w->option) : 0.0;
            *statistic = left / w->scale;
            *kept = left / ((length > 1e-300) ? length : 1e-300);
        }
    } else {
        for (uint32_t i = first; i < end; i++) {
            sums[i] *= *kept;
        }
    }
}

static void step_ewma(const edp_watch *w, uint32_t step, const double *row, double *means, double *kept,
                      double *statistic) {
    const uint32_t first = step * EDP_PIECE;
    const uint32_t end = end_of(first, EDP_PIECE, w->directions);
    double squares = (step == 0u) ? 0.0 : *kept;
    for (uint32_t i = first; i < end; i++) {
        means[i] += w->option * (row[i] - means[i]);
        squares += means[i] * means[i];
    }
    *kept = squares;
    if (end == w->directions) {
        *statistic = (squares * w->factor) / w->scale;
    }
}

static void step_separate_cusums(const edp_watch *w, uint32_t step, const double *row, double *sums, double *kept,
                                 double *statistic) {
    const uint32_t n = w->directions;
    const uint32_t first = step * EDP_PIECE;
    const uint32_t end = end_of(first, EDP_PIECE, n);
    double largest = (step == 0u) ? 0.0 : *kept;
    for (uint32_t i = first; i < end; i++) {
        const double up = (sums[i] + row[i]) - w->option;
        const double down = (sums[n + i] - row[i]) - w->option;
        sums[i] = (up > 0.0) ? up : 0.0;
        sums[n + i] = (down > 0.0) ? down : 0.0;
        largest = (sums[i] > largest) ? sums[i] : largest;
        largest = (sums[n + i] > largest) ? sums[n + i] : largest;
    }
    *kept = largest;
    if (end == n) {
        *statistic = largest / w->scale;
    }
}

/* Longest first: the sum of a length is that of the next shorter one before this row, and the row. */
static void step_glr(const edp_watch *w, uint32_t step, const double *row, double *memory, uint32_t *seen, double *kept,
                     double *statistic) {
    const uint32_t n = w->directions;
    const uint32_t pieces = edp_pieces(n, EDP_PIECE);
    const uint32_t length = w->rows - (step / pieces);
    const uint32_t first = (step % pieces) * EDP_PIECE;
    const uint32_t end = end_of(first, EDP_PIECE, n);
    double *const sums = &memory[(size_t)(length - 1u) * n];
    const double *const before = (length > 1u) ? &memory[(size_t)(length - 2u) * n] : NULL;
    double squares = (first == 0u) ? 0.0 : *kept;
    for (uint32_t i = first; i < end; i++) {
        sums[i] = ((before == NULL) ? 0.0 : before[i]) + row[i];
        squares += sums[i] * sums[i];
    }
    *kept = squares;
    if (step == 0u) {
        *seen += (*seen < w->rows) ? 1u : 0u;
        *statistic = 0.0;
    }
    if (end == n) {
        const double ratio = squares / (2.0 * (double)length);
        if ((length <= *seen) && (ratio > *statistic)) {
            *statistic = ratio;
        }
        if (length == 1u) {
            *statistic /= w->scale;
        }
    }
}

/* ---- watches ------------------------------------------------------------------------------------------------------- */

static uint32_t centre_parts(const edp_watch *w) { return edp_pieces(w->summaries, EDP_ROW); }

static uint32_t white_parts(const edp_watch *w) {
    return w->own ? edp_pieces(w->directions, EDP_ROW) : w->directions;
}

static void centre_part(const edp_watch *w, uint32_t part, const double *z, float *centred) {
    const uint32_t first = part * EDP_ROW;
    const uint32_t end = end_of(first, EDP_ROW, w->summaries);
    for (uint32_t i = first; i < end; i++) {
        centred[i] = edp_known(z[i]) ? (float)(z[i] - (double)w->mean[i]) : 0.0f;
    }
}

static void white_part(const edp_watch *w, uint32_t part, const float *centred, double *white) {
    if (w->own) {
        const uint32_t first = part * EDP_ROW;
        const uint32_t end = end_of(first, EDP_ROW, w->directions);
        for (uint32_t i = first; i < end; i++) {
            const float product = centred[i] * w->matrix[i];
            white[i] = (double)product;
        }
    } else {
        white[part] = (double)edp_dot(centred, &w->matrix[(size_t)part * w->summaries], w->summaries);
    }
}

static void detector_part(const edp_watch *w, uint32_t part, const double *white, const edp_watch_memory *m) {
    if (w->detector == EDP_CUSUM) {
        step_cusum(w, part, white, m->sums, m->kept, m->statistic);
    } else if (w->detector == EDP_EWMA) {
        step_ewma(w, part, white, m->sums, m->kept, m->statistic);
    } else if (w->detector == EDP_SEPARATE_CUSUMS) {
        step_separate_cusums(w, part, white, m->sums, m->kept, m->statistic);
    } else {
        step_glr(w, part, white, m->sums, m->seen, m->kept, m->statistic);
    }
}

void edp_watch_part(const edp_watch *w, uint32_t part, bool judged, const double *z, float *centred, double *white,
                    const edp_watch_memory *m) {
    const uint32_t whitens = centre_parts(w);
    const uint32_t detects = whitens + white_parts(w);
    if (part < whitens) {
        centre_part(w, part, z, centred);
    } else if (part < detects) {
        white_part(w, part - whitens, centred, white);
    } else if (judged) {
        detector_part(w, part - detects, white, m);
    } else {
        /* Not judged yet. */
    }
}

void edp_watch_reset(const edp_watch *w, double *memory, uint32_t *seen) {
    edp_clear(w->directions * w->rows, memory);
    *seen = 0u;
}
