/* From residuals to alarms: what every exported monitor needs. C99, no heap, no globals, no libm. Sums over ticks and rows
 * are in double precision; linear views of a block, which are most of the work, in single precision.
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
/* The sum of products x[i] y[i] over i < n, in single precision. */
float edp_dot(const float *x, const float *y, uint32_t n);
/* Whether a measurement is one: finite, and at most `limit` usual widths from its usual value. */
bool edp_plausible(float x, double centre, double spread, double limit);

/* The checksum of arrays in flash goes on from `crc` (0 to begin with); as CRC-32 of the bytes, lowest byte first. */
uint32_t edp_crc_doubles(uint32_t crc, const double *values, uint32_t n);

/* ---- from residuals at every tick to numbers of a block ------------------------------------------------------------ */

#define EDP_SUMS 8u      /* of a residual: ticks, r, r r, r u, u u, r d, d d, largest |r|; behind them r w, w w a driver */
#define EDP_SUMMARIES 5u /* of a residual and block: mean, spread, gain, lag, peak; behind them one a driver */
#define EDP_NO_INPUT 0xFFFFu

/* How blocks are formed. r is a residual times `scale`, u the channel that it judges less its `centre` times `spread`, d
   the change of u since the tick before: both factors are one over a usual width. A driver w is one scaled input, less
   another one unless that is EDP_NO_INPUT. */
typedef struct {
    uint32_t ticks; /* of a block */
    uint32_t inputs;
    uint32_t residuals;
    uint32_t levels;
    uint32_t moving;
    uint32_t drivers; /* of each residual */
    const double *centre;  /* (inputs) */
    const double *spread;  /* (inputs) */
    const double *scale;   /* (residuals) */
    const double *change;  /* (residuals) usual variance of d */
    const uint16_t *channel; /* (residuals) input that each judges */
    const uint16_t *level;   /* (levels) inputs whose mean is part of the operating point */
    const uint16_t *size;    /* (moving) inputs whose mean size is */
    const uint16_t *first;   /* (residuals, drivers) */
    const uint16_t *second;  /* (residuals, drivers) */
} edp_blocks;

/* Doubles in `sums` of one block. */
#define EDP_BLOCK_SUMS(residuals, drivers, levels, moving) \
    (((EDP_SUMS + (2u * (drivers))) * (residuals)) + (levels) + (moving))

/* A tick: NaN where an input or a residual is missing. `y` (inputs) is what the last tick left, zero before the first. */
void edp_block_tick(const edp_blocks *b, bool first, const float *in, const float *residuals, double *y, double *sums);
/* The summaries of a residual when the block has ended, EDP_SUMMARIES and one a driver; NaN where more than half of its
   ticks are missing. */
void edp_block_summaries(const edp_blocks *b, const double *sums, uint32_t residual, double *summaries);
/* The operating point (levels + moving), scaled and limited. */
void edp_block_point(const edp_blocks *b, const double *sums, const float *offset, const float *width, double limit,
                     float *point);
/* A summary at an operating point of n numbers: less what is usual there, over how widely it scatters there. `usual` and
   `wide` have 1 + n numbers. */
double edp_conditioned(double summary, const float *point, uint32_t n, const float *usual, const float *wide,
                       double floor, double limit);
/* A number within limits; NaN stays. */
double edp_within(double x, double low, double high);

/* ---- watches: a view of the conditioned summaries, and a detector on it --------------------------------------------- */

typedef enum { EDP_CUSUM = 0, EDP_EWMA = 1, EDP_GLR = 2, EDP_SEPARATE_CUSUMS = 3 } edp_detector;

typedef struct {
    edp_detector detector;
    bool own; /* whether it sees each summary by itself, in rows that are not clipped */
    uint32_t summaries;
    uint32_t directions;
    uint32_t rows;    /* of its memory, of `directions` each: of the likelihood ratio the lengths that are tried */
    double option;    /* slack or weight */
    double factor;    /* of the weighted means */
    double scale;     /* over which statistics of all watches are compared with one limit */
    const float *mean;   /* (summaries) */
    const float *matrix; /* (directions, summaries); its own: (summaries) */
} edp_watch;

#define EDP_PIECE 8u /* directions of a detector that one part of the work takes */
#define EDP_ROW 32u  /* summaries that one part of the work takes, where that is little work for each */

/* How many pieces n things are. */
uint32_t edp_pieces(uint32_t n, uint32_t piece);
void edp_clear(uint32_t n, double *values);

/* What a watch remembers. */
typedef struct {
    double *sums;      /* (directions, rows): multivariate CUSUM and weighted means one row; separate CUSUMs two, those up
                          first; likelihood ratio a row for each length */
    uint32_t *seen;    /* rows since a reset, up to `rows` */
    double *kept;      /* from one part of the work to the next */
    double *statistic; /* over its scale; whole behind the last part */
} edp_watch_memory;

/* One part of the work on a block, all about as long: summaries `z` less their mean, EDP_ROW at a time, where a missing one
   counts as healthy; white numbers; steps of the detector, unless the block is not `judged`, EDP_PIECE directions at a
   time. The multivariate CUSUM goes through them twice, the likelihood ratio once for each length. */
void edp_watch_part(const edp_watch *w, uint32_t part, bool judged, const double *z, float *centred, double *white,
                    const edp_watch_memory *m);
void edp_watch_reset(const edp_watch *w, double *memory, uint32_t *seen);

#endif
