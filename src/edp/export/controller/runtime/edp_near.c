/* Runs near a run of a grey box. See edp_near.h; the equations are those of the Python package's
   edp.networks.twin.grey.near_runs, near_tangents and near_valves. */
#include "edp_near.h"

/* On purpose: one unit with the tick of the grey box, whose parts it calls by the thousand. */
#include "edp_hydraulics.c"

/* Of the last change of Newton's method, MPa and m/s: what is left then is about its square. */
#define NEAR_PRESSURE 1e-3
#define NEAR_SPEED 1e-5
#define SAME 1e-4           /* share of full by which a spool may differ and count as the same */
#define BETWEEN 0.41421356237309503 /* gamma / (1 - gamma): where a first stage lies between two of a tick */
#define REST_PRESSURE 2.0   /* MPa of a chamber that is not measured */
#define UNBOUNDED 0xFFFFFFFFu

void edp_near_open(edp_near *n, const edp_hydraulics *h, const float *low, const float *high, uint32_t most, double *room,
                   uint8_t *differs) {
    const uint32_t count = h->actuators;
    const uint32_t nodes = 2u * count + h->pumps;
    const uint32_t unknown = nodes + count;
    double *at = room;
    n->h = h;
    n->low = low;
    n->high = high;
    n->resistance = NULL;
    n->most = most;
    n->columns = 0u;
    n->left = UNBOUNDED;
    n->spent = 0u;
    n->solved = true;
    n->twice = false;
    n->length_s = 0.0;
    n->d_y = taken(&at, unknown * most);
    n->d_base = taken(&at, unknown * most);
    n->d_reached = taken(&at, unknown * most);
    n->d_before = taken(&at, unknown * most);
    n->d_s = taken(&at, count * most);
    n->d_z = taken(&at, count * most);
    n->d_base_z = taken(&at, count * most);
    n->d_v = taken(&at, count * most);
    n->d_s_before = taken(&at, count * most);
    n->before_y = taken(&at, unknown);
    n->before_s = taken(&at, count);
    n->valves = taken(&at, (most + 1u) * h->valves * VALVE_STATES);
    n->x = taken(&at, (most + 1u) * 2u * h->valves);
    n->pilots = taken(&at, (most + 1u) * h->valves);
    n->d = taken(&at, (most + 1u) * h->pumps);
    n->flows = taken(&at, h->pumps * most);
    n->asked = taken(&at, h->pumps);
    n->lines = taken(&at, h->pumps);
    n->lags = taken(&at, h->pumps);
    n->keep = taken(&at, 4u * h->valves);
    n->delays = taken(&at, h->valves);
    n->kept_s = 0.0;
    n->rate = taken(&at, nodes);
    n->centre = taken(&at, h->pumps);
    n->room = at;
    n->differs = differs;
}

void edp_near_rest(const edp_hydraulics *h, const edp_hydraulic_state *state) {
    const uint32_t nodes = 2u * h->actuators + h->pumps;
    for (uint32_t k = 0; k < nodes; k++) {
        state->y[k] = (float)REST_PRESSURE;
    }
    edp_fill(0.0f, h->actuators, state->y + nodes);
    edp_copy(h->middle, h->actuators, state->strokes);
    edp_fill(0.0f, h->actuators, state->bristles);
    for (uint32_t m = 0; m < h->pumps; m++) {
        state->displacements[m] = h->numbers[h->pump_at[m] + LEAST];
    }
    edp_fill(0.0f, h->valves * VALVE_STATES, state->valves);
    edp_fill(0.0f, h->history * h->valves, state->history);
}

void edp_near_load(edp_near *n, const float *y, const float *strokes, const float *bristles, const float *displacements,
                   const float *valves) {
    rooms r;
    divide(n->h, n->room, &r);
    loaded(y, r.unknown, r.y);
    loaded(strokes, r.n, r.s);
    loaded(bristles, r.n, r.z);
    loaded(displacements, n->h->pumps, n->d);
    loaded(valves, n->h->valves * VALVE_STATES, n->valves);
    n->columns = 0u;
}

void edp_near_keep(const edp_near *n, const edp_hydraulic_state *state, const float *demands, uint32_t ticks) {
    const uint32_t valves = n->h->valves;
    rooms r;
    divide(n->h, n->room, &r);
    kept(r.y, r.unknown, state->y);
    kept(r.s, r.n, state->strokes);
    kept(r.z, r.n, state->bristles);
    kept(n->d, n->h->pumps, state->displacements);
    kept(n->valves, valves * VALVE_STATES, state->valves);
    for (uint32_t k = n->h->history; k-- > 0u;) {
        const float *const from = (k < ticks) ? (demands + (ticks - 1u - k) * valves) : (state->history + (k - ticks) * valves);
        edp_copy(from, valves, state->history + k * valves);
    }
}

void edp_near_read(edp_near *n, uint32_t answer, float value) {
    const uint32_t kind = n->h->ports[2u * answer];
    const uint32_t which = n->h->ports[2u * answer + 1u];
    rooms r;
    divide(n->h, n->room, &r);
    if (kind == 1u) {
        r.s[which] = (double)value;
    } else if (kind == 0u) {
        r.y[r.nodes + which] = (double)value;
    } else {
        const double pressure = 1e-6 * (double)value;
        r.y[which] = (pressure > LEAST_ABSOLUTE - ATMOSPHERE) ? pressure : (LEAST_ABSOLUTE - ATMOSPHERE);
    }
}

void edp_near_branch(edp_near *n, uint32_t count) {
    const uint32_t valves = n->h->valves;
    const uint32_t actuators = n->h->actuators;
    const uint32_t unknown = 3u * actuators + n->h->pumps;
    for (uint32_t more = 0; (more < count) && (n->columns < n->most); more++) {
        const uint32_t k = n->columns;
        for (uint32_t row = 0; row < unknown; row++) {
            n->d_y[row * n->most + k] = 0.0;
        }
        for (uint32_t i = 0; i < actuators; i++) {
            n->d_s[i * n->most + k] = 0.0;
            n->d_z[i * n->most + k] = 0.0;
        }
        copied(n->d, n->h->pumps, n->d + (k + 1u) * n->h->pumps);
        for (uint32_t j = 0; j < valves; j++) {
            n->differs[(k + 1u) * valves + j] = 0u;
        }
        n->columns++;
    }
}

void edp_near_demands(const edp_hydraulics *h, const float *commands, float *demands) {
    for (uint32_t j = 0; j < h->valves; j++) {
        const uint32_t back = h->sides[2u * j + 1u];
        double demand = (double)commands[h->sides[2u * j]];
        demand -= (back != EDP_NONE) ? (double)commands[back] : 0.0;
        demand /= (double)h->full[j];
        demands[j] = (float)((demand > 1.0) ? 1.0 : ((demand < -1.0) ? -1.0 : demand));
    }
}

/* ---- the command path: every run as it is ---------------------------------------------------------------------------- */

/* Demand of a valve a dead time before tick t, linear between ticks. `demands`: of one run. */
static double delayed(const edp_near *n, const float *demands, const float *history, uint32_t t, uint32_t j) {
    const uint32_t valves = n->h->valves;
    const double ticks = n->delays[j];
    const uint32_t whole = (uint32_t)ticks;
    const double newer = (double)((whole <= t) ? demands[(t - whole) * valves + j] : history[(whole - t - 1u) * valves + j]);
    const double older = (double)((whole < t) ? demands[(t - whole - 1u) * valves + j] : history[(whole - t) * valves + j]);
    return newer + (ticks - (double)whole) * (older - newer);
}

/* Dead times in ticks, and shares of their distance that pilots and spools keep over the two stages of a step. */
static void set_keep(edp_near *n, double step) {
    const double last = (double)n->h->history - 2.0;
    if (n->kept_s == step) {
        return;
    }
    n->kept_s = step;
    for (uint32_t j = 0; j < n->h->valves; j++) {
        const uint16_t *const at = n->h->valve_at + j * VALVE_PLACES;
        const double ticks = number(n->h, at[DELAY]) / (double)n->h->tick_s;
        n->delays[j] = (ticks > last) ? last : ((ticks < 0.0) ? 0.0 : ticks);
        for (uint32_t which = 0; which < 2u; which++) {
            const double stage = (which == 0u) ? (GAMMA * step) : ((1.0 - GAMMA) * step);
            n->keep[4u * j + 2u * which] = exp(-stage / number(n->h, at[PILOT_LAG]));
            n->keep[4u * j + 2u * which + 1u] = exp(-stage / number(n->h, at[SPOOL_LAG]));
        }
    }
}

/* A valve over both stages of a step; its spool at each of them, and its pilot in the middle. */
static void move_valve(const edp_near *n, double *row, uint32_t j, double goal, double spools[2], double *pilot) {
    const double play = circuit(n->h, PLAY);
    for (uint32_t which = 0; which < 2u; which++) {
        const double keep = n->keep[4u * j + 2u * which];
        const double slow = n->keep[4u * j + 2u * which + 1u];
        lag(&row[PILOT_1], goal, keep);
        lag(&row[PILOT_2], row[PILOT_1], keep);
        if (row[PLAYED] > row[PILOT_2] + play) {
            row[PLAYED] = row[PILOT_2] + play;
        } else if (row[PLAYED] < row[PILOT_2] - play) {
            row[PLAYED] = row[PILOT_2] - play;
        }
        lag(&row[SPOOL_1], row[PLAYED], slow);
        lag(&row[SPOOL], row[SPOOL_1], slow);
        spools[which] = row[SPOOL];
        if (which == 0u) {
            *pilot = row[PILOT_2];
        }
    }
}

/* All valves of all runs over a step within tick t. Results are weighed into x and pilots: 0 as they are, 1 the first and
   2 the second of two ticks that one step goes over. */
static void move_valves(const edp_near *n, const float *demands, uint32_t ticks, const float *history, uint32_t t, uint32_t part) {
    const uint32_t valves = n->h->valves;
    for (uint32_t j = 0; j < valves; j++) {
        for (uint32_t run = n->columns + 1u; run-- > 0u;) {
            /* Backwards, so that a run that parts now finds the first one's valve as it was before. */
            const float *const own = demands + run * ticks * valves;
            uint8_t *const apart = &n->differs[run * valves + j];
            double *const row = n->valves + (run * valves + j) * VALVE_STATES;
            if ((run > 0u) && (*apart == 0u) && (own[t * valves + j] != demands[t * valves + j])) {
                *apart = 1u;
                copied(n->valves + j * VALVE_STATES, VALVE_STATES, row);
            }
            if ((run == 0u) || (*apart != 0u)) {
                double spools[2];
                double pilot = 0.0;
                double *const x = n->x + run * 2u * valves + j;
                double *const middle = n->pilots + run * valves + j;
                move_valve(n, row, j, delayed(n, own, history, t, j), spools, &pilot);
                if (part == 0u) {
                    x[0] = spools[0];
                    x[valves] = spools[1];
                    *middle = pilot;
                } else if (part == 1u) {
                    x[0] = (1.0 - BETWEEN) * spools[0] + BETWEEN * spools[1];
                    *middle = (1.0 - GAMMA) * pilot;
                } else {
                    x[valves] = spools[1];
                    *middle += GAMMA * pilot;
                }
            }
        }
    }
}

/* Where a run's valve is that of the first one, so are spool and pilot; it may have parted within a step of two ticks. */
static void share_valves(const edp_near *n) {
    const uint32_t valves = n->h->valves;
    for (uint32_t run = 1; run <= n->columns; run++) {
        for (uint32_t j = 0; j < valves; j++) {
            if (n->differs[run * valves + j] == 0u) {
                n->x[run * 2u * valves + j] = n->x[j];
                n->x[(run * 2u + 1u) * valves + j] = n->x[valves + j];
                n->pilots[run * valves + j] = n->pilots[j];
            }
        }
    }
}

/* Displacements of a run after a step, under the common power limit. */
static void displace_run(const edp_near *n, uint32_t run) {
    const edp_hydraulics *const h = n->h;
    double *const d = n->d + run * h->pumps;
    const double *const pilots = n->pilots + run * h->valves;
    double power = 0.0;
    for (uint32_t m = 0; m < h->pumps; m++) {
        const uint32_t a = h->pump_at[m];
        const double line = n->lines[m] + ((run > 0u) ? n->d_y[(2u * h->actuators + m) * n->most + run - 1u] : 0.0);
        n->asked[m] = number(h, a + LEAST);
        for (uint32_t j = 0; j < h->valves; j++) {
            if (h->valve_pump[j] == m) {
                const double beyond = (fabs(pilots[j]) - circuit(h, DEMAND_START)) / circuit(h, DEMAND_SPAN);
                const double share = (beyond > 1.0) ? 1.0 : ((beyond < 0.0) ? 0.0 : beyond);
                const uint32_t side = (pilots[j] >= 0.0) ? 0u : 1u;
                const double wanted = share * number(h, h->valve_at[j * VALVE_PLACES + GAIN + side]);
                const double held = (wanted < 1.0) ? wanted : 1.0;
                n->asked[m] = (held > n->asked[m]) ? held : n->asked[m];
            }
        }
        power += number(h, a + FLOW) * n->asked[m] * ((line > 0.0) ? line : 0.0);
    }
    const double allowed = circuit(h, POWER) / ((power > IDLE) ? power : IDLE);
    for (uint32_t m = 0; m < h->pumps; m++) {
        lag(&d[m], n->asked[m] * ((allowed < 1.0) ? allowed : 1.0), n->lags[m]);
    }
}

/* Displacements of all runs, and by what flow those of the others differ. */
static void displace_all(edp_near *n, const rooms *r, double step) {
    const edp_hydraulics *const h = n->h;
    for (uint32_t m = 0; m < h->pumps; m++) {
        n->lags[m] = exp(-step / number(h, h->pump_at[m] + LAG));
        n->lines[m] = r->y[2u * r->n + m];
    }
    for (uint32_t run = 0; run <= n->columns; run++) {
        displace_run(n, run);
    }
    for (uint32_t m = 0; m < h->pumps; m++) {
        for (uint32_t k = 0; k < n->columns; k++) {
            n->flows[m * n->most + k] = number(h, h->pump_at[m] + FLOW) * (n->d[(k + 1u) * h->pumps + m] - n->d[m]);
        }
        r->d[m] = n->d[m];
    }
}

/* ---- a stage of the first run ----------------------------------------------------------------------------------------- */

/* Replaces the residual by the Newton step: LU in place, without pivots, as the diagonal of pressures dominates; the
   factors stay for the columns of the other runs. */
static void eliminate(const rooms *r) {
    const uint32_t size = r->unknown;
    double *const b = r->residual;
    for (uint32_t k = 0; k < size; k++) {
        const double *const from = r->by_y + k * size;
        const double inverse = 1.0 / from[k];
        for (uint32_t i = k + 1u; i < size; i++) {
            double *const row = r->by_y + i * size;
            if (row[k] != 0.0) {
                const double factor = row[k] * inverse;
                row[k] = factor;
                for (uint32_t j = k + 1u; j < size; j++) {
                    row[j] -= factor * from[j];
                }
                b[i] -= factor * b[k];
            }
        }
    }
    for (uint32_t i = size; i-- > 0u;) {
        const double *const row = r->by_y + i * size;
        double sum = b[i];
        for (uint32_t k = i + 1u; k < size; k++) {
            sum -= row[k] * b[k];
        }
        b[i] = sum / row[i];
    }
}

/* Replaces `count` columns of `stride` by the solutions, with the factors that `eliminate` has left. */
static void substitute(const rooms *r, double *columns, uint32_t count, uint32_t stride) {
    const uint32_t size = r->unknown;
    for (uint32_t i = 0; i < size; i++) {
        double *const row = columns + i * stride;
        for (uint32_t k = 0; k < i; k++) {
            const double factor = r->by_y[i * size + k];
            if (factor != 0.0) {
                const double *const from = columns + k * stride;
                for (uint32_t c = 0; c < count; c++) {
                    row[c] -= factor * from[c];
                }
            }
        }
    }
    for (uint32_t i = size; i-- > 0u;) {
        double *const row = columns + i * stride;
        const double inverse = 1.0 / r->by_y[i * size + i];
        for (uint32_t k = i + 1u; k < size; k++) {
            const double factor = r->by_y[i * size + k];
            if (factor != 0.0) {
                const double *const from = columns + k * stride;
                for (uint32_t c = 0; c < count; c++) {
                    row[c] -= factor * from[c];
                }
            }
        }
        for (uint32_t c = 0; c < count; c++) {
            row[c] *= inverse;
        }
    }
}

/* As `newton`, within what is left of the iterations; the matrix stays factorised. */
static void newton_within(edp_near *n, const rooms *r, double step, double reach) {
    damping last = {1.0, 0.0, r->unknown};
    bool near_enough = false;
    for (uint32_t iteration = 0; (iteration < EDP_MOST_ITERATIONS) && !near_enough; iteration++) {
        assemble(n->h, r, step, reach);
        eliminate(r);
        damped_step(&last, r);
        n->spent++;
        near_enough = true;
        for (uint32_t k = 0; k < r->unknown; k++) {
            near_enough = near_enough && (fabs(r->residual[k]) < ((k < r->nodes) ? NEAR_PRESSURE : NEAR_SPEED));
        }
        if (n->left > 0u) {
            n->left--;
        } else if (!near_enough) {
            n->solved = false;
            near_enough = true;
        }
    }
}

/* ---- the tangents of a stage ------------------------------------------------------------------------------------------ */

/* Of friction after an implicit step of its bristle: force by the deflection before, deflection by that and by v. */
static void friction_slopes(const edp_hydraulics *h, uint32_t a, double v, double before, double step, double *by_before,
                            double *under, double *by_v) {
    const double stribeck = number(h, a + STRIBECK);
    const double fixed = number(h, a + STATIC);
    const double stiffness = number(h, a + BRISTLE);
    const double damping = number(h, a + BRISTLE_DAMPING);
    const double ratio = v / stribeck;
    const double fade = (fabs(ratio) < NEGLIGIBLE) ? exp(-ratio * ratio) : 0.0;
    const double level = number(h, a + COULOMB) + fixed * fade;
    const double share = stiffness * step * fabs(v) / level;
    const double sign = (v >= 0.0) ? 1.0 : -1.0;
    const double fade_v = -2.0 * ratio / stribeck * fade;
    *under = 1.0 / (1.0 + share);
    const double z = (before + step * v) * *under;
    const double rate = stiffness + damping * fade / step;
    *by_v = step * *under - z * *under * (stiffness * step * sign / level - share / level * fixed * fade_v);
    *by_before = rate * *under - damping * fade / step;
}

static void contents_of_others(const edp_near *n, const rooms *r, double *held) {
    for (uint32_t row = 0; row < r->unknown; row++) {
        double slope = 1.0;
        if (row < r->nodes) {
            (void)content(n->h, r->y[row], &slope);
        }
        for (uint32_t k = 0; k < n->columns; k++) {
            held[row * n->most + k] = slope * n->d_y[row * n->most + k];
        }
    }
}

/* Content that a net flow brings to each node over a stage. */
static void set_rates(const edp_near *n, const rooms *r, double step) {
    const edp_hydraulics *const h = n->h;
    for (uint32_t i = 0; i < r->n; i++) {
        const uint32_t a = h->actuator_at[i];
        for (uint32_t side = 0; side < 2u; side++) {
            const double way = (side == 0u) ? 1.0 : -1.0;
            const double left = way * (r->frozen[i] - number(h, a + STOP_LOW + side));
            const double volume = number(h, a + HEAD_DEAD + side) + number(h, a + HEAD_AREA + side) * ((left > 0.0) ? left : 0.0);
            n->rate[i + side * r->n] = step * circuit(h, BULK) / volume;
        }
    }
    for (uint32_t m = 0; m < h->pumps; m++) {
        n->rate[2u * r->n + m] = step * circuit(h, BULK) / number(h, h->pump_at[m] + LINE);
    }
}

/* Area of the open centre of a pump with spools at x. */
static double open_centre(const edp_hydraulics *h, const double *x, uint32_t m) {
    const uint32_t a = h->pump_at[m];
    const double closed = 1.0 / number(h, a + BYPASS_CLOSED);
    double area = number(h, a + BYPASS);
    for (uint32_t j = 0; j < h->valves; j++) {
        if (h->valve_pump[j] == m) {
            const double left = 1.0 - fabs(x[j]) * closed;
            area *= (left > 0.0) ? (left * left) : 0.0;
        }
    }
    return area;
}

/* What other spools than those of the first run pass at its pressures, into the right side. */
static void add_spools(const edp_near *n, const rooms *r, uint32_t which) {
    const edp_hydraulics *const h = n->h;
    const uint32_t valves = h->valves;
    const double *const base = n->x + which * valves;
    for (uint32_t m = 0; m < h->pumps; m++) {
        n->centre[m] = open_centre(h, base, m);
    }
    double *const alone = r->reached; /* unused until the stage is done */
    for (uint32_t j = 0; j < valves; j++) {
        bool summed = false;
        for (uint32_t run = 1; run <= n->columns; run++) {
            const double *const x = n->x + (2u * run + which) * valves;
            if ((n->differs[run * valves + j] == 0u) || (fabs(x[j] - base[j]) <= SAME)) {
                continue;
            }
            if (!summed) {
                zeroed(r->net, r->all);
                spool_flows(h, r, j, base[j]);
                copied(r->net, r->nodes, alone);
                summed = true;
            }
            zeroed(r->net, r->all);
            spool_flows(h, r, j, x[j]);
            for (uint32_t node = 0; node < r->nodes; node++) {
                n->d_y[node * n->most + run - 1u] += n->rate[node] * (r->net[node] - alone[node]);
            }
            if (h->valve_pump[j] != EDP_NONE) {
                const uint32_t m = h->valve_pump[j];
                const uint32_t node = 2u * r->n + m;
                double slope;
                const double wider = open_centre(h, x, m) - n->centre[m];
                n->d_y[node * n->most + run - 1u] -= n->rate[node] * wider * turbulent(r->p[node] - r->p[r->nodes], &slope);
            }
        }
    }
}

/* Differences of pressures and velocities after a stage, from those of its base. */
static void stage_of_others(const edp_near *n, const rooms *r, uint32_t which, double step, double reach) {
    const edp_hydraulics *const h = n->h;
    copied(r->y, r->nodes, r->p);
    set_rates(n, r, step);
    for (uint32_t node = 0; node < r->nodes; node++) {
        copied(n->d_base + node * n->most, n->columns, n->d_y + node * n->most);
    }
    for (uint32_t m = 0; m < h->pumps; m++) {
        const uint32_t node = 2u * r->n + m;
        for (uint32_t k = 0; k < n->columns; k++) {
            n->d_y[node * n->most + k] += n->rate[node] * n->flows[m * n->most + k];
        }
    }
    add_spools(n, r, which);
    for (uint32_t i = 0; i < r->n; i++) {
        const uint32_t a = h->actuator_at[i];
        const double v = r->y[r->nodes + i];
        double *const row = n->d_y + (r->nodes + i) * n->most;
        double by_before;
        /* Slopes of the deflections, in vectors that only the freezing of a load needs. */
        friction_slopes(h, a, v, r->base_z[i], step, &by_before, &r->w[i], &r->u[i]);
        const double reached = r->s[i] + reach * (r->before[i] + v);
        const bool inside = (number(h, a + STOP_LOW) <= reached) && (reached <= number(h, a + STOP_HIGH));
        const double touched = inside ? 0.0 : (step * number(h, a + STOP_STIFFNESS));
        for (uint32_t k = 0; k < n->columns; k++) {
            row[k] = -step * by_before * n->d_base_z[i * n->most + k] -
                     touched * (n->d_s[i * n->most + k] + reach * n->d_v[i * n->most + k]);
        }
        for (uint32_t m = 0; m < r->n; m++) {
            const double mass = r->mass[i * r->n + m];
            for (uint32_t k = 0; k < n->columns; k++) {
                row[k] += mass * n->d_base[(r->nodes + m) * n->most + k];
            }
        }
    }
    substitute(r, n->d_y, n->columns, n->most);
    for (uint32_t i = 0; i < r->n; i++) {
        for (uint32_t k = 0; k < n->columns; k++) {
            const uint32_t at = i * n->most + k;
            n->d_z[at] = r->w[i] * n->d_base_z[at] + r->u[i] * n->d_y[(r->nodes + i) * n->most + k];
        }
    }
}

/* Columns on the line through themselves and `reached`, so far beyond the latter. */
static void extend(const edp_near *n, uint32_t rows, double *values, const double *reached, double ahead) {
    for (uint32_t row = 0; row < rows; row++) {
        for (uint32_t k = 0; k < n->columns; k++) {
            const uint32_t at = row * n->most + k;
            values[at] += ahead * (reached[at] - values[at]);
        }
    }
}

static void copy_columns(const edp_near *n, const double *from, uint32_t rows, double *to) {
    for (uint32_t row = 0; row < rows; row++) {
        copied(from + row * n->most, n->columns, to + row * n->most);
    }
}

/* ---- a step of all runs ----------------------------------------------------------------------------------------------- */

static void solve_step(edp_near *n, const rooms *r, double step) {
    const edp_hydraulics *const h = n->h;
    const double stage = GAMMA * step;
    copied(r->y + r->nodes, r->n, r->before);
    freeze(h, r, step);
    for (uint32_t i = 0; (i < r->n) && (n->resistance != NULL); i++) {
        r->force[i] += n->resistance[i];
    }
    copied(r->z, r->n, r->zs);
    copied(r->z, r->n, r->base_z);
    contents(h, r, r->base);
    contents_of_others(n, r, n->d_base);
    copy_columns(n, n->d_z, r->n, n->d_base_z);
    copy_columns(n, n->d_y + r->nodes * n->most, r->n, n->d_v);
    displace_all(n, r, step);
    for (uint32_t which = 0; which < 2u; which++) {
        const double reach = 0.5 * ((which == 0u) ? stage : step);
        copied(n->x + which * h->valves, h->valves, r->x);
        newton_within(n, r, stage, reach);
        if (n->columns > 0u) {
            stage_of_others(n, r, which, stage, reach);
        }
        for (uint32_t i = 0; i < r->n; i++) {
            double slope;
            (void)friction(h, h->actuator_at[i], r->y[r->nodes + i], r->base_z[i], stage, &slope, &r->z[i]);
        }
        if (which == 0u) {
            contents(h, r, r->reached);
            for (uint32_t k = 0; k < r->unknown; k++) {
                r->base[k] += STAGE_RATIO * (r->reached[k] - r->base[k]);
            }
            for (uint32_t i = 0; i < r->n; i++) {
                r->base_z[i] = r->zs[i] + STAGE_RATIO * (r->z[i] - r->zs[i]);
            }
            contents_of_others(n, r, n->d_reached);
            extend(n, r->unknown, n->d_base, n->d_reached, STAGE_RATIO);
            /* The base of the bristles is where they began. */
            extend(n, r->n, n->d_base_z, n->d_z, STAGE_RATIO);
        }
    }
    displaced_strokes(h, r, r->s, r->before, 0.5 * step);
    for (uint32_t i = 0; i < r->n; i++) {
        const double weight = (h->scale[i] > 0.0f) ? (0.5 * step) : 0.0;
        for (uint32_t k = 0; k < n->columns; k++) {
            const uint32_t at = i * n->most + k;
            n->d_s[at] += weight * (n->d_v[at] + n->d_y[(r->nodes + i) * n->most + k]);
        }
    }
}

/* A stroke is the trapezoidal integral of the velocities that are answered. */
static void integrate(const edp_near *n, const rooms *r) {
    const double *const v_before = n->before_y + r->nodes;
    displaced_strokes(n->h, r, n->before_s, v_before, 0.5 * n->length_s);
    for (uint32_t i = 0; i < r->n; i++) {
        const double weight = (n->h->scale[i] > 0.0f) ? (0.5 * n->length_s) : 0.0;
        for (uint32_t k = 0; k < n->columns; k++) {
            const uint32_t row = (r->nodes + i) * n->most + k;
            n->d_s[i * n->most + k] = n->d_s_before[i * n->most + k] + weight * (n->d_before[row] + n->d_y[row]);
        }
    }
}

static double clipped_to(double value, double low, double high) { return (value < low) ? low : ((value > high) ? high : value); }

/* Holds what is answered within its bounds, velocities first; where the first run is at a bound, so are the others. */
static void hold(const edp_near *n, const rooms *r) {
    for (uint32_t turn = 0; turn < 2u; turn++) {
        for (uint32_t c = 0; c < n->h->answers; c++) {
            const uint32_t kind = n->h->ports[2u * c];
            const uint32_t which = n->h->ports[2u * c + 1u];
            const double low = (double)n->low[c];
            const double high = (double)n->high[c];
            if ((kind == 1u) != (turn == 1u)) {
                continue;
            }
            if (kind == 1u) {
                double *const v = &r->y[r->nodes + which];
                const double value = n->before_s[which] + 0.5 * n->length_s * (n->before_y[r->nodes + which] + *v);
                r->s[which] = clipped_to(value, low, high);
                *v = ((value > high) && (*v > 0.0)) ? 0.0 : (((value < low) && (*v < 0.0)) ? 0.0 : *v);
            } else {
                double *const value = &r->y[which + ((kind == 0u) ? r->nodes : 0u)];
                *value = clipped_to(*value, low, high);
            }
        }
    }
    for (uint32_t c = 0; c < n->h->answers; c++) {
        const uint32_t kind = n->h->ports[2u * c];
        const uint32_t which = n->h->ports[2u * c + 1u];
        const uint32_t row = which + ((kind == 2u) ? 0u : r->nodes);
        const double value = (kind == 1u) ? r->s[which] : r->y[row];
        if ((value > (double)n->low[c]) && (value < (double)n->high[c])) {
            continue;
        }
        zeroed(n->d_y + row * n->most, n->columns);
        if (kind == 1u) {
            zeroed(n->d_s + which * n->most, n->columns);
        }
    }
}

bool edp_near_next(edp_near *n, const float *demands, uint32_t ticks, const float *history, uint32_t t, bool twice) {
    const edp_hydraulics *const h = n->h;
    const double step = (double)h->tick_s / (double)h->steps;
    bool finite = true;
    rooms r;
    divide(h, n->room, &r);
    copied(r.y, r.unknown, n->before_y);
    copied(r.s, r.n, n->before_s);
    copy_columns(n, n->d_y, r.unknown, n->d_before);
    copy_columns(n, n->d_s, r.n, n->d_s_before);
    n->twice = twice;
    n->length_s = twice ? (2.0 * (double)h->tick_s) : (double)h->tick_s;
    set_keep(n, step);
    if (twice) {
        move_valves(n, demands, ticks, history, t, 1u);
        share_valves(n);
        move_valves(n, demands, ticks, history, t + 1u, 2u);
        share_valves(n);
        solve_step(n, &r, n->length_s);
    } else {
        for (uint32_t k = 0; k < h->steps; k++) {
            move_valves(n, demands, ticks, history, t, 0u);
            share_valves(n);
            solve_step(n, &r, step);
        }
    }
    integrate(n, &r);
    hold(n, &r);
    for (uint32_t k = 0; k < r.unknown; k++) {
        finite = finite && (r.y[k] - r.y[k] == 0.0);
    }
    return finite && n->solved;
}

double edp_near_answer(const edp_near *n, uint32_t answer, bool between) {
    const uint32_t kind = n->h->ports[2u * answer];
    const uint32_t which = n->h->ports[2u * answer + 1u];
    rooms r;
    divide(n->h, n->room, &r);
    const uint32_t row = which + ((kind == 2u) ? 0u : r.nodes);
    const double unit = (kind == 2u) ? 1e6 : 1.0;
    if (kind == 1u) {
        return between ? (n->before_s[which] + 0.125 * n->length_s * (3.0 * n->before_y[row] + r.y[row])) : r.s[which];
    }
    return unit * (between ? (0.5 * (n->before_y[row] + r.y[row])) : r.y[row]);
}

double edp_near_change(const edp_near *n, uint32_t run, uint32_t answer, bool between) {
    const uint32_t kind = n->h->ports[2u * answer];
    const uint32_t which = n->h->ports[2u * answer + 1u];
    const uint32_t nodes = 2u * n->h->actuators + n->h->pumps;
    const uint32_t row = (which + ((kind == 2u) ? 0u : nodes)) * n->most + run - 1u;
    const double unit = (kind == 2u) ? 1e6 : 1.0;
    if (kind == 1u) {
        const uint32_t at = which * n->most + run - 1u;
        return between ? (n->d_s_before[at] + 0.125 * n->length_s * (3.0 * n->d_before[row] + n->d_y[row])) : n->d_s[at];
    }
    return unit * (between ? (0.5 * (n->d_before[row] + n->d_y[row])) : n->d_y[row]);
}

bool edp_near_solve(const double rows[3][3], const double right[3], double solution[3]) {
    double cofactors[3][3];
    double whole = 0.0;
    bool finite = true;
    for (uint32_t i = 0; i < 3u; i++) {
        for (uint32_t j = 0; j < 3u; j++) {
            const uint32_t a = (i + 1u) % 3u;
            const uint32_t b = (i + 2u) % 3u;
            const uint32_t c = (j + 1u) % 3u;
            const uint32_t d = (j + 2u) % 3u;
            cofactors[i][j] = rows[a][c] * rows[b][d] - rows[a][d] * rows[b][c];
        }
    }
    for (uint32_t j = 0; j < 3u; j++) {
        whole += rows[0][j] * cofactors[0][j];
    }
    for (uint32_t j = 0; j < 3u; j++) {
        const double sum = cofactors[0][j] * right[0] + cofactors[1][j] * right[1] + cofactors[2][j] * right[2];
        solution[j] = sum / whole;
        finite = finite && (solution[j] - solution[j] == 0.0);
    }
    return finite;
}
