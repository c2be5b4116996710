/* On-board adaptation of a model's predictions: a bounded correction, learned while the machine moves. C99, float32,
 * no heap, no globals, no recursion, fixed trip counts. All memory belongs to the caller.
 *
 * Coefficients theta of features phi correct each prediction y by unit * theta' phi. They are learned by a Kalman filter
 * from errors that have come due, fade with time, and are cut off at `bound`; the correction is cut off at `limit`.
 */
#ifndef EDP_ADAPTATION_H
#define EDP_ADAPTATION_H

#include "edp_runtime.h"

#define EDP_ADAPT_FEATURE_LIMIT 6.0f /* standard widths at which inputs and features are cut off */
#define EDP_ADAPT_CLIP 3.0f          /* units beyond which an innovation teaches no more */
#define EDP_ADAPT_MOST_ERROR 20.0f   /* units beyond which an error counts no more when it is judged */

/* What a call has done. */
typedef enum {
    EDP_ADAPT_NONE = 0,     /* nothing: there is no prediction to correct */
    EDP_ADAPT_HOLDING = 1,  /* corrected; nothing was learned: at rest, frozen, or too few ticks in a row */
    EDP_ADAPT_LEARNING = 2, /* corrected; the error of an earlier prediction has taught */
    EDP_ADAPT_FALLBACK = 3  /* at least one number goes out as it was: its corrections were worse than none */
} edp_adapt_status;

/* Constants; `features` is n = 1 + 3 targets + rank. */
typedef struct {
    const float *offset;      /* (inputs) */
    const float *scale;       /* (inputs) */
    const float *directions;  /* (rank, inputs) */
    const float *middle;      /* (targets) */
    const float *spread;      /* (targets) */
    const float *dead_zone;   /* (targets) */
    const float *change;      /* (horizons, targets) */
    const float *unit;        /* (horizons, targets) */
    const uint16_t *columns;  /* (targets): input that measures each of them */
    const uint32_t *ahead;    /* (horizons): ticks */
    uint32_t inputs;
    uint32_t targets;
    uint32_t rank;
    uint32_t features;
    float keep;         /* a, of a coefficient from tick to tick */
    float keep_squared;
    float refresh;      /* (1 - a^2) prior */
    float prior;        /* variance of a coefficient */
    float noise;        /* variance of an error that nothing explains */
    float limit;
    float bound;
    float rate;         /* of the running errors */
    float worse;
    float better;
} edp_adapt_law;

/* What one horizon carries from tick to tick. */
typedef struct {
    float *theta;      /* (targets, n) */
    float *covariance; /* (n, n), symmetric */
    float *rows;       /* (ticks, n + 2 targets): features, predictions and corrections of the ticks before */
    float *plain;      /* (targets): running errors without correction */
    float *corrected;  /* (targets): and with it */
    bool *fallback;    /* (targets) */
    uint32_t ticks;    /* k */
    uint32_t horizon;  /* its place */
} edp_adapt_memory;

/* The inputs along the directions; `scaled` holds inputs numbers, y rank numbers. */
void edp_adapt_directions(const edp_adapt_law *law, const float *in, float *scaled, float *y);
/* A horizon as after a reset. */
void edp_adapt_forget(const edp_adapt_law *law, edp_adapt_memory *m);
/* Error in units, `error` (targets), of the prediction of a row, which has come due. */
void edp_adapt_error(const edp_adapt_law *law, edp_adapt_memory *m, const float *row, const float *in,
                     float *error);
/* Judges that prediction, and learns from it if `learn`, unless it was made at rest; `g` holds n numbers. Returns 1 if it
   has learned, 2 more if the covariance was found unsound and was started anew. */
uint32_t edp_adapt_due(const edp_adapt_law *law, edp_adapt_memory *m, const float *row, const float *error,
                       bool learn, float *g);
/* Corrections of the predictions y in SI units, 0 at rest and where they are taken back; `row` takes features, predictions and
   corrections; `seen` holds errors (targets) and what edp_adapt_directions gave (rank). Returns false if theta was found
   damaged and was cleared. */
bool edp_adapt_correct(const edp_adapt_law *law, edp_adapt_memory *m, const float *in, const float *y,
                       const float *seen, float *row, float *correction);

#endif
