/* A grey box and runs near it: what a plan asks of its model at each tick. C99, double precision, no heap, no globals.
 *
 * The first run is the grey box itself (edp_hydraulics.h). Others part from it by their commands: spools, pilots and
 * displacements of each are run as they are, dead bands and play among them; pressures, velocities and strokes follow by
 * the tangent of each implicit stage, whose matrix the first run has factorised already.
 *
 * Newton's method ends when it moves pressures by less than 1 kPa and velocities by less than 0.01 mm/s, or when `left`
 * iterations are spent: then every stage has one more and `solved` is false. So a tick of a controller has a bound.
 */
#ifndef EDP_NEAR_H
#define EDP_NEAR_H

#include "edp_hydraulics.h"

/* Doubles that `count` runs beside the first one of `n` actuators, `v` valves and `p` pumps need, beside those of a tick. */
#define EDP_NEAR_ROOM(n, v, p, count)                                                                                  \
    ((3u * (n) + (p)) * (4u * (count) + 1u) + (n) * (5u * (count) + 1u) + 8u * ((count) + 1u) * (v) +                   \
     ((count) + 1u) * (p) + (p) * ((count) + 5u) + 5u * (v) + 2u * (n))

/* Bounds of a grey box, and where it works. Made anew for each use: its pointers are into the caller's memory. */
typedef struct {
    const edp_hydraulics *h;
    const float *low;  /* of each answer, units of the grey box */
    const float *high;
    const double *resistance; /* MN against each actuator, of which the load does not know */
    uint32_t most;    /* runs beside the first one for which there is room, */
    uint32_t columns; /* those under way, */
    uint32_t left;    /* iterations that may be spent, */
    uint32_t spent;   /* and those that were */
    bool solved;
    bool twice;       /* the last step went over two ticks */
    double length_s;  /* of that step */
    double *room;     /* of a tick */
    double *d_y, *d_base, *d_reached, *d_before;    /* differences of pressures and velocities (unknown, most) */
    double *d_s, *d_z, *d_base_z, *d_v, *d_s_before;       /* of strokes, bristles and velocities (actuators, most) */
    double *before_y, *before_s;                    /* of the first run before the last step */
    double *valves;                                 /* (1 + most, valves, 5) */
    double *x, *pilots;                             /* (1 + most, 2, valves), (1 + most, valves) */
    double *d;                                      /* displacements (1 + most, pumps) */
    double *flows, *asked, *lines, *lags;           /* (pumps, most), (pumps) each */
    double *keep, *delays, *rate, *centre;          /* (valves, 4), (valves), (nodes), (pumps) */
    double kept_s;                                  /* the step that `keep` is of */
    uint8_t *differs;                               /* (1 + most, valves) */
} edp_near;

/* room: layer's room of a tick and EDP_NEAR_ROOM; differs: (1 + most) * valves. Iterations are unbounded at first. */
void edp_near_open(edp_near *n, const edp_hydraulics *h, const float *low, const float *high, uint32_t most, double *room,
                   uint8_t *differs);
/* At rest with neutral commands; ports that are read next say where. */
void edp_near_rest(const edp_hydraulics *h, const edp_hydraulic_state *state);
/* The first run from a kept state (see edp_hydraulic_state), and back; `demands` are those of the ticks since,
 * (ticks, valves). */
void edp_near_load(edp_near *n, const float *y, const float *strokes, const float *bristles, const float *displacements,
                   const float *valves);
void edp_near_keep(const edp_near *n, const edp_hydraulic_state *state, const float *demands, uint32_t ticks);
/* A port reads a measured value, SI units. */
void edp_near_read(edp_near *n, uint32_t answer, float value);
/* `count` more runs, which are the first one up to now. */
void edp_near_branch(edp_near *n, uint32_t count);
/* Signed commands of the valves as shares of full. */
void edp_near_demands(const edp_hydraulics *h, const float *commands, float *demands);
/* Tick t, or with `twice` ticks t and t + 1 in one step. demands: (run, ticks, valves); history: those before tick 0,
 * newest first. False where a number is not finite or `left` is spent. */
bool edp_near_next(edp_near *n, const float *demands, uint32_t ticks, const float *history, uint32_t t, bool twice);
/* An answer of the first run after the last step, SI units; `between`: one tick before its end, where it had two. */
double edp_near_answer(const edp_near *n, uint32_t answer, bool between);
/* By how much that of another run (1 to columns) differs. */
double edp_near_change(const edp_near *n, uint32_t run, uint32_t answer, bool between);
/* Solves three equations; false where they have no solution. */
bool edp_near_solve(const double rows[3][3], const double right[3], double solution[3]);

#endif
