/* What every exported controller of boom, arm and bucket needs: references, valve map, PI loop, kinematics, levers.
 * C99, float32, SI units, no heap, no globals, no recursion. Triples are boom, arm, bucket.
 */
#ifndef EDP_CONTROL_H
#define EDP_CONTROL_H

#include <stdbool.h>
#include <stdint.h>

#define EDP_AXES 3u

/* What a call has done. Levers are within range and slew whatever it says. */
typedef enum {
    EDP_CONTROL_OK = 0,        /* levers of the controller itself */
    EDP_CONTROL_FALLBACK = 1,  /* the plan had no solution: levers of the PI loop */
    EDP_CONTROL_NEUTRAL = 2,   /* inputs missing or no answer: levers go to neutral at the slew limit */
    EDP_CONTROL_NOT_BEGUN = 3, /* no reference yet, or memory that was never initialised: levers are neutral */
    EDP_CONTROL_REFUSED = 4    /* of begin: the state says why; nothing has begun */
} edp_control_status;

/* Why begin refuses. */
typedef enum {
    EDP_REFUSED_NOT = 0,
    EDP_REFUSED_INPUTS = 1,    /* a measured value is missing, not finite or far out of its range */
    EDP_REFUSED_EMPTY = 2,     /* a reference without ticks */
    EDP_REFUSED_NUMBERS = 3,   /* a number of the reference is not finite */
    EDP_REFUSED_STROKES = 4,   /* a stroke that the machine does not have */
    EDP_REFUSED_KINEMATICS = 5 /* tip poses that are not those of the strokes: another machine? */
} edp_refusal;

/* A reference: row t belongs to the t-th step after begin; the last row holds from its end on. The arrays are the
   caller's, and stay as they are while it is followed. */
typedef struct {
    uint32_t ticks;
    const float (*strokes)[EDP_AXES]; /* m from closed */
    const float (*tip)[EDP_AXES];     /* x, y (m from the boom foot), attitude (rad) */
} edp_reference;

/* Joint angles by strokes, and what lies between the joints. */
typedef struct {
    uint32_t nodes;                   /* evenly spaced over the full stroke */
    const float (*angles)[EDP_AXES];  /* rad, each relative to the link before */
    float full[EDP_AXES];             /* m */
    float length[EDP_AXES];           /* m */
} edp_front;

/* Levers by speeds of one direction, rising. */
typedef struct {
    uint32_t points;
    const float *speeds; /* m/s, positive */
    const float *levers;
} edp_valve_side;

/* Limits of the levers; `slew` is the most that one moves in a tick. */
typedef struct {
    float low[EDP_AXES];
    float high[EDP_AXES];
    float slew[EDP_AXES];
} edp_lever_limits;

typedef struct {
    float proportional; /* 1/s */
    float integral;     /* 1/s^2 */
    float rest;         /* m/s: below it a lever stays at neutral */
    float most;         /* m/s that an integral may add */
    float rate;         /* Hz */
    uint32_t lead;      /* ticks by which the reference's speed is read ahead */
} edp_pi_gains;

/* How levers become pilot pressures. */
typedef struct {
    float full; /* Pa */
    float zone; /* lever below which nothing moves */
    float start; /* demand from which second spools take part */
} edp_lever_shape;
typedef struct {
    uint8_t axis;
    bool second; /* a conflux spool */
    bool extend;
    float share; /* of a conflux spool */
} edp_pilot;

/* y at x between nodes that rise; the ends hold beyond them. */
float edp_polygon(const float *x, const float *y, uint32_t n, float at);
/* The lever for a signed speed; sides are extending and retracting. */
float edp_lever_of(const edp_valve_side sides[2], float speed);
/* From a position to a target by at most `step`. */
float edp_towards(float target, float from, float step);
/* Range, then slew from the levers before. */
void edp_limit_levers(const edp_lever_limits *limits, const float asked[EDP_AXES], float levers[EDP_AXES]);
/* Pa. */
float edp_pilot_pressure(const edp_lever_shape *shape, const edp_pilot *pilot, const float levers[EDP_AXES]);

/* Rows beyond the end are the last one. */
uint32_t edp_reference_row(const edp_reference *reference, uint32_t tick);
/* Slope by time of a column of the reference: central, one-sided at its ends. */
float edp_slope_at(const float (*rows)[EDP_AXES], uint32_t ticks, uint32_t row, uint32_t column, float rate);
edp_refusal edp_check_reference(const edp_reference *reference, const edp_front *front);

/* Tip pose of strokes, and its derivatives by them (may be NULL); strokes beyond an end stop count as at the stop. */
void edp_tip(const edp_front *front, const float strokes[EDP_AXES], float tip[EDP_AXES],
             float jacobian[EDP_AXES][EDP_AXES]);
/* An angle between -pi and pi. */
float edp_wrapped(float angle);
/* Rows that turn an error of the tip into weighted ones across and along the path and of the attitude. */
void edp_error_rows(const edp_reference *reference, uint32_t row, float rate, float along, float attitude,
                    float rows[EDP_AXES][EDP_AXES]);

/* Levers of the PI loop; `sum` is its memory. */
void edp_pi_levers(const edp_pi_gains *gains, const edp_valve_side sides[EDP_AXES][2], const edp_lever_limits *limits,
                   const edp_reference *reference, uint32_t tick, const float strokes[EDP_AXES], float sum[EDP_AXES],
                   float levers[EDP_AXES]);

#endif
