/* Pumps, valves, cylinders, motors and their load as differential equations: one tick of a grey box, in double precision.
 *
 * Units within are m, s, MPa, MN and Gg (10^6 kg). The state is kept in single precision from tick to tick. Each implicit
 * stage takes as many Newton iterations as it needs, EDP_MOST_ITERATIONS at most: time a tick on the target.
 */
#ifndef EDP_HYDRAULICS_H
#define EDP_HYDRAULICS_H

#include "edp_runtime.h"

/* Newton iterations of an implicit stage; there are two stages a step. */
#define EDP_MOST_ITERATIONS 30u
/* Entry of a table of places: there is no such thing. */
#define EDP_NONE 65535u

/* A machine. Tables are row-major; places are those of its numbers. */
typedef struct {
    const float *numbers;
    const float *full;              /* the largest command of each valve */
    const float *knots;             /* of all opening curves */
    const float *middle;            /* of each stroke */
    const float *scale;             /* from a stroke to -1..1; 0: that stroke is not measured */
    const float *offset;            /* of each answer */
    const float *width;             /* of each answer */
    const float *linkage;           /* of edp_linkage.h, where `linked` */
    const uint16_t *sides;          /* (valves, 2): commands that extend and retract */
    const uint16_t *valve_at;       /* (valves, EDP_VALVE_PLACES) */
    const uint16_t *valve_actuator; /* (valves) */
    const uint16_t *valve_pump;     /* (valves) */
    const uint16_t *actuator_at;    /* (actuators) */
    const uint16_t *pump_at;        /* (pumps) */
    const uint16_t *ports;          /* (answers, 2): velocity 0, stroke 1 or pressure 2, and which */
    const uint16_t *exponents;      /* (terms, actuators): of the load's monomials */
    uint32_t actuators;
    uint32_t valves;
    uint32_t pumps;
    uint32_t answers;
    uint32_t curve;     /* knots */
    uint32_t terms;     /* monomials */
    uint32_t powers;    /* of a stroke: the degree and one */
    uint32_t history;   /* ticks of demands that are kept */
    uint32_t steps;     /* in a tick */
    uint32_t inertia;   /* place of the first coefficient of the inertia's root, */
    uint32_t per_entry; /* coefficients of each of its entries, */
    uint32_t potential; /* and the first one of the potential */
    uint32_t circuit;   /* place of the circuit's numbers */
    uint32_t linked;    /* 1: bodies of a linkage are the load, numbers from `inertia` on; 0: polynomials */
    float tick_s;
} edp_hydraulics;

/* What is carried from tick to tick. */
typedef struct {
    float *y;             /* pressures of head chambers, rod chambers and pump lines, then velocities */
    float *strokes;       /* (actuators) */
    float *bristles;      /* deflections (actuators) */
    float *displacements; /* shares of full (pumps) */
    float *valves;        /* (valves, EDP_VALVE_STATES) */
    float *history;       /* (history, valves): demands, newest first */
} edp_hydraulic_state;

/* commands: SI units; fed: what the ports read, scaled (answers); room: doubles, as many as the layer says;
 * y: written: velocities and pressures after the tick, scaled, in the order of the answers without the strokes. */
void edp_hydraulic_tick(const float *commands, const float *fed, const edp_hydraulics *h,
                        const edp_hydraulic_state *state, double *room, float *y);

#endif
