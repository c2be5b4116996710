/* A grey box whose numbers follow the machine, and predictions that move towards its forecasts. C99, double precision, no
 * heap, no globals, no recursion; the equations are those of the Python package's edp.networks.twin.tuned and
 * tuned_correction.
 *
 * An observer runs along with the machine. When a stretch of ticks has been measured, it is run again: once with the
 * present numbers and once for each group of numbers a little grown. `runs` of these a tick, so that a tick has a bound;
 * after the last one a Kalman filter moves the numbers. With more `runs` than there are, all happens in one tick, as it
 * does in Python. Each implicit stage has EDP_MOST_ITERATIONS of Newton's method at most (edp_hydraulics.h).
 */
#ifndef EDP_FOLLOW_H
#define EDP_FOLLOW_H

#include "edp_near.h"

/* What a tick has done. */
typedef enum {
    EDP_FOLLOW_NOT_RESET = 0, /* the memory was never reset, or belongs to another follower: predictions as they came */
    EDP_FOLLOW_WAITING = 1,   /* the observer has not settled: predictions as they came */
    EDP_FOLLOW_FOLLOWING = 2,
    EDP_FOLLOW_LEARNED = 3    /* the same, and the numbers have moved at this tick */
} edp_follow_status;

/* Numbers of a state from tick to tick, and doubles of scratch in which a tick works beside edp_near. */
#define EDP_FOLLOW_STATE(n, v, p, history) (5u * (n) + (p) + ((p) > 0u ? (p) : 1u) + (5u + (history)) * (v))
#define EDP_FOLLOW_WORK(most) (2u * (most) * (most) + 2u * (most))

/* Constants. `most`: the larger of groups and velocities. */
typedef struct {
    const edp_hydraulics *machine; /* as it was */
    const float *low;              /* bounds of the answers, units of the grey box */
    const float *high;
    const float *floors;           /* least mean square of errors (velocities), SI units */
    const float *powers;           /* by which a number grows with its group (entries) */
    const uint16_t *entry_number;  /* which number (entries), */
    const uint16_t *entry_group;   /* and which group */
    const float *deviation;        /* prior, of the logarithms (groups) */
    const float *warmth;           /* of the logarithms by a kelvin (groups) */
    const float *limit;            /* largest correction (horizons, targets), SI units */
    const uint16_t *columns;       /* velocity of each target */
    const uint16_t *ahead;         /* ticks of each horizon */
    uint32_t numbers;
    uint32_t commands;
    uint32_t entries;
    uint32_t groups;
    uint32_t velocities; /* the answers begin with them */
    uint32_t targets;
    uint32_t horizons;
    uint32_t reach;      /* the farthest of them, ticks */
    uint32_t prefix;     /* ticks in which the observer settles */
    uint32_t learn_ticks;
    uint32_t state;      /* EDP_FOLLOW_STATE */
    uint32_t most;
    float gain;          /* of the observer */
    float load_share;
    double keep;         /* of what was learned, a stretch later */
    float oil_c;         /* in the logs of the machine as it was; far out of range: not known */
    double judged_rate;  /* one over the ticks over which errors are averaged */
} edp_follow_law;

/* A stretch of ticks that is to be run again. */
typedef struct {
    float *state;       /* before it (state) */
    float *row;         /* what its ports read at first (answers) */
    double *resistance; /* MN (actuators) */
    float *demands;     /* (learn_ticks, valves) */
    float *truth;       /* velocities after each tick (learn_ticks, velocities) */
} edp_follow_stretch;

/* Counters and flags. */
typedef struct {
    bool started;   /* the observer runs */
    bool begun;     /* a stretch is being measured */
    bool due;       /* another one is to be run again */
    bool expects;   /* velocities of this tick were expected */
    bool learned;   /* numbers have moved at this tick */
    uint32_t ticks; /* of the observer, no more than prefix + 1 */
    uint32_t count; /* ticks of the stretch */
    uint32_t run;   /* of the due stretch, that is next */
    uint32_t age;   /* of the slopes by forces, ticks */
    uint32_t seen;  /* rows of the ring, no more than reach */
    uint32_t at;    /* where its next one goes */
    uint32_t judged; /* stretches over which errors are averaged, at most EDP_FOLLOW_LATELY */
    uint32_t taught; /* stretches */
    uint32_t repairs; /* damaged coefficients that were cleared */
} edp_follow_count;

/* Memory of one machine, in arrays of the caller. */
typedef struct {
    edp_follow_count *n;
    float *numbers;          /* of now (numbers), */
    float *trial;            /* and of a run */
    double *logs;            /* what was learned (groups), */
    double *by_oil;          /* and what the oil's temperature makes of them */
    double *covariance;      /* (groups, groups) */
    double *square;          /* mean squares of errors (velocities) */
    float *now;              /* state (state), */
    float *before;           /* and before the last tick */
    float *own;              /* answers of the last tick, SI units (answers) */
    float *row;              /* what the ports read (answers); NaN: free */
    double *resistance;      /* MN (actuators) */
    double *by_force;        /* m/s by MN (velocities, velocities) */
    double *expected;        /* m/s (velocities) */
    edp_follow_stretch open; /* being measured */
    edp_follow_stretch due;  /* being run again */
    double *errors;          /* of the due stretch (learn_ticks, velocities), m/s */
    double *slopes;          /* (groups, learn_ticks, velocities) */
    float *demands;          /* of a forecast (reach, valves) */
    float *ring;             /* predictions, then forecasts (reach, 2, horizons, targets) */
    double *products;        /* mean squares of both errors and their mean product (horizons, 3, targets) */
    float *weight;           /* of the forecast (horizons, targets) */
    uint32_t *counted;       /* judged ticks (horizons) */
    float *forecast;         /* velocities (horizons, velocities); NaN where there is none */
    double *work;            /* EDP_FOLLOW_WORK */
    double *room;            /* of edp_near */
    uint8_t *differs;        /* (valves) */
} edp_follow_memory;

#define EDP_FOLLOW_LATELY 30u

/* Forgets machine and all that was learned. */
void edp_follow_reset(const edp_follow_law *w, const edp_follow_memory *m);
/* The observer begins anew at the next tick; what was learned stays. */
void edp_follow_interrupt(const edp_follow_law *w, const edp_follow_memory *m);
/* One tick; true where there is a forecast. commands: finite, or all begins anew. measured: NaN where a sensor is missing.
 * runs: 0 freezes the numbers. prediction, moved: (horizons, targets), SI units; they may be the same. */
bool edp_follow_tick(const edp_follow_law *w, const edp_follow_memory *m, const float *commands, const float *measured,
                     float oil_c, uint32_t runs, const float *prediction, float *moved);
/* Factor of a group against the machine as it was, from what was learned and what the temperature makes of it. */
float edp_follow_factor(double log, double by_oil);

#endif
