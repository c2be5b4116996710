/* One tick of a grey box. See edp_hydraulics.h; the equations are those of the Python package's edp.networks.twin.grey. */
#include "edp_hydraulics.h"
#include "edp_linkage.h"
#include "edp_parameter_index.h"

#include <math.h>
#include <stddef.h>

#define ATMOSPHERE 0.1013    /* MPa; pressures are gauge */
#define LEAST_ABSOLUTE 1e-3  /* MPa below which no oil is left that could boil */
#define SMOOTH2 0.01         /* square of the pressure (MPa) below which an orifice turns laminar */
#define CHECK 1e-3           /* share of its flow that a load check passes backwards, so that it has a slope */
#define IDLE 1e-9            /* MW below which pumps take no power */
#define NEGLIGIBLE 6.5       /* Stribeck velocities beyond which their effect is below rounding */
#define TOLERANCE 1e-9       /* of a Newton step, MPa and m/s */
#define LARGEST 4.0          /* MPa by which an iteration may move a pressure */
#define GAMMA 0.29289321881345254 /* 1 - 1/sqrt(2): the method is L-stable */
#define STAGE_RATIO 2.4142135623730949  /* (1 - gamma) / gamma */

/* The caller's room, divided. */
typedef struct {
    uint32_t n, nodes, unknown, all; /* actuators, pressures that are states, unknowns, nodes with tank and supply */
    double *y, *base, *reached, *residual, *by_y;        /* unknown; by_y (unknown, unknown) */
    double *p, *net, *jac;                               /* all; jac (all, all) */
    double *s, *z, *zs, *base_z, *frozen, *scaled, *before, *at_start, *s_start, *force, *w, *u; /* n */
    double *low, *dot, *along, *mass;                    /* (n, n) */
    double *by_low;                                      /* (n, n, n) */
    double *value, *first;                               /* terms; (terms, n) */
    double *table;                                       /* (2, n, powers) */
    double *x, *valves;                                  /* valves; (valves, VALVE_STATES) */
    double *d, *asked;                                   /* pumps */
} rooms;

static double *taken(double **room, uint32_t count) {
    double *const first = *room;
    *room += count;
    return first;
}

static double *zeroed(double *values, uint32_t count) {
    for (uint32_t i = 0; i < count; i++) {
        values[i] = 0.0;
    }
    return values;
}

static void copied(const double *from, uint32_t count, double *to) {
    for (uint32_t i = 0; i < count; i++) {
        to[i] = from[i];
    }
}

static double number(const edp_hydraulics *h, uint32_t at) { return (double)h->numbers[at]; }

static double circuit(const edp_hydraulics *h, uint32_t which) { return number(h, h->circuit + which); }

static void divide(const edp_hydraulics *h, double *room, rooms *r) {
    const uint32_t n = h->actuators;
    r->n = n;
    r->nodes = 2u * n + h->pumps;
    r->unknown = r->nodes + n;
    r->all = r->nodes + 2u;
    r->y = taken(&room, r->unknown);
    r->base = taken(&room, r->unknown);
    r->reached = taken(&room, r->unknown);
    r->residual = taken(&room, r->unknown);
    r->by_y = taken(&room, r->unknown * r->unknown);
    r->p = taken(&room, r->all);
    r->net = taken(&room, r->all);
    r->jac = taken(&room, r->all * r->all);
    r->s = taken(&room, n);
    r->z = taken(&room, n);
    r->zs = taken(&room, n);
    r->base_z = taken(&room, n);
    r->frozen = taken(&room, n);
    r->scaled = taken(&room, n);
    r->before = taken(&room, n);
    r->at_start = taken(&room, n);
    r->s_start = taken(&room, n);
    r->force = taken(&room, n);
    r->w = taken(&room, n);
    r->u = taken(&room, n);
    r->low = taken(&room, n * n);
    r->dot = taken(&room, n * n);
    r->along = taken(&room, n * n);
    r->mass = taken(&room, n * n);
    r->by_low = taken(&room, n * n * n);
    r->value = taken(&room, h->terms);
    r->first = taken(&room, h->terms * n);
    r->table = taken(&room, 2u * n * h->powers);
    r->x = taken(&room, h->valves);
    r->valves = taken(&room, h->valves * VALVE_STATES);
    r->d = taken(&room, h->pumps);
    r->asked = taken(&room, h->pumps);
}

/* Monomials of the scaled strokes and their gradients by the strokes. */
static void basis(const edp_hydraulics *h, const rooms *r) {
    const uint32_t n = r->n;
    double *const powers = r->table;
    double *const slopes = r->table + n * h->powers;
    for (uint32_t i = 0; i < n; i++) {
        double power = 1.0;
        for (uint32_t e = 0; e < h->powers; e++) {
            powers[i * h->powers + e] = power;
            power *= r->scaled[i];
        }
        for (uint32_t e = 0; e < h->powers; e++) {
            const double lower = (e > 0u) ? powers[i * h->powers + e - 1u] : 1.0;
            slopes[i * h->powers + e] = (double)e * (double)h->scale[i] * lower;
        }
    }
    for (uint32_t b = 0; b < h->terms; b++) {
        const uint16_t *const e = h->exponents + b * n;
        double whole = 1.0;
        for (uint32_t i = 0; i < n; i++) {
            whole *= powers[i * h->powers + e[i]];
        }
        r->value[b] = whole;
        for (uint32_t k = 0; k < n; k++) {
            double once = 1.0;
            for (uint32_t i = 0; i < n; i++) {
                once *= ((i == k) ? slopes : powers)[i * h->powers + e[i]];
            }
            r->first[b * n + k] = once;
        }
    }
}

/* Add the Coriolis forces: c = L. w + L u - e, with w = L'v, u = L.'v and e_i = w . (dL_i' v). */
static void turning(const rooms *r) {
    const uint32_t n = r->n;
    const double *const v = r->before;
    double *const w = zeroed(r->w, n);
    double *const u = zeroed(r->u, n);
    double *const dot = zeroed(r->dot, n * n);
    double *const along = zeroed(r->along, n * n);
    for (uint32_t a = 0; a < n; a++) {
        for (uint32_t c = 0; c < n; c++) {
            w[c] += r->low[a * n + c] * v[a];
            for (uint32_t k = 0; k < n; k++) {
                dot[a * n + c] += r->by_low[(a * n + c) * n + k] * v[k];
                along[k * n + c] += r->by_low[(a * n + c) * n + k] * v[a];
            }
        }
    }
    for (uint32_t a = 0; a < n; a++) {
        for (uint32_t c = 0; c < n; c++) {
            u[c] += dot[a * n + c] * v[a];
        }
    }
    for (uint32_t i = 0; i < n; i++) {
        for (uint32_t c = 0; c < n; c++) {
            r->force[i] += dot[i * n + c] * w[c] + r->low[i * n + c] * u[c] - w[c] * along[i * n + c];
        }
    }
}

/* Inertia M = L L' from its root. */
static void squared(const rooms *r) {
    const uint32_t n = r->n;
    zeroed(r->mass, n * n);
    for (uint32_t i = 0; i < n; i++) {
        for (uint32_t k = 0; k < n; k++) {
            for (uint32_t c = 0; c <= ((i < k) ? i : k); c++) {
                r->mass[i * n + k] += r->low[i * n + c] * r->low[k * n + c];
            }
        }
    }
}

/* Strokes in the middle of the step, and the load there: inertia, forces of gravity and of turning. */
static void freeze(const edp_hydraulics *h, const rooms *r, double step) {
    const uint32_t n = r->n;
    for (uint32_t i = 0; i < n; i++) {
        const double half = (h->scale[i] > 0.0f) ? (0.5 * step) : 0.0;
        r->frozen[i] = r->s[i] + half * r->before[i];
        r->scaled[i] = (r->frozen[i] - (double)h->middle[i]) * (double)h->scale[i];
    }
    if (h->linked != 0u) {
        edp_linkage_load(h->linkage, h->numbers + h->inertia, r->frozen, r->before, r->mass, r->force);
        return;
    }
    basis(h, r);
    zeroed(r->low, n * n);
    zeroed(r->by_low, n * n * n);
    uint32_t entry = h->inertia;
    for (uint32_t a = 0; a < n; a++) {
        for (uint32_t c = 0; c <= a; c++) {
            for (uint32_t b = 0; b < h->per_entry; b++) {
                r->low[a * n + c] += number(h, entry + b) * r->value[b];
                for (uint32_t k = 0; k < n; k++) {
                    r->by_low[(a * n + c) * n + k] += number(h, entry + b) * r->first[b * n + k];
                }
            }
            entry += h->per_entry;
        }
    }
    for (uint32_t i = 0; i < n; i++) {
        r->force[i] = 0.0;
        for (uint32_t b = 1; b < h->terms; b++) {
            r->force[i] += number(h, h->potential + b - 1u) * r->first[b * n + i];
        }
    }
    squared(r);
    turning(r);
}

/* Smoothed square root of a pressure difference, and its slope. */
static double turbulent(double dp, double *slope) {
    const double q2 = dp * dp + SMOOTH2;
    const double inverse = 1.0 / (q2 * sqrt(sqrt(q2)));
    *slope = (q2 - 0.5 * dp * dp) * inverse;
    return dp * q2 * inverse;
}

/* Add an edge that passes `flow` from node f to node t. */
static void stamp(const rooms *r, uint32_t f, uint32_t t, double flow, double slope) {
    r->net[f] -= flow;
    r->net[t] += flow;
    r->jac[f * r->all + f] -= slope;
    r->jac[f * r->all + t] += slope;
    r->jac[t * r->all + f] += slope;
    r->jac[t * r->all + t] -= slope;
}

/* Add an opening to the tank that has no slope towards it. */
static void relieve(const rooms *r, uint32_t node, double limit, double opened) {
    if (r->p[node] > limit) {
        r->net[node] -= opened * (r->p[node] - limit);
        r->jac[node * r->all + node] -= opened;
    }
}

/* Area of a monotone curve at x in [0, 1]: increments between fixed knots, summed up. */
static double opening(const edp_hydraulics *h, double x, uint32_t first) {
    double area = 0.0;
    for (uint32_t k = 0; k + 1u < h->curve; k++) {
        const double low = (double)h->knots[k];
        const double share = (x - low) / ((double)h->knots[k + 1u] - low);
        if (share > 0.0) {
            area += number(h, first + k) * ((share < 1.0) ? share : 1.0);
        }
    }
    return area;
}

/* Share of the outflow that is left at a distance from the stop: a smoothstep. */
static double cushion(double distance, double length, double least) {
    const double share = distance / length;
    if (share >= 1.0) {
        return 1.0;
    }
    const double x = (share > 0.0) ? share : 0.0;
    return least + (1.0 - least) * x * x * (3.0 - 2.0 * x);
}

/* One opening of a spool; `checked`: a load check bars the way back. */
static void edge(const rooms *r, uint32_t f, uint32_t t, double area, bool checked) {
    double slope;
    double g = turbulent(r->p[f] - r->p[t], &slope);
    if (checked && (r->p[f] < r->p[t])) {
        g *= CHECK;
        slope *= CHECK;
    }
    stamp(r, f, t, area * g, area * slope);
}

/* The edges of one spool at x. */
static void spool_flows(const edp_hydraulics *h, const rooms *r, uint32_t j, double x) {
    const uint32_t n = r->n;
    const uint32_t d = (x >= 0.0) ? 0u : 1u;
    const uint16_t *const at = h->valve_at + j * VALVE_PLACES;
    const double band = number(h, at[BAND + d]);
    double opened = (fabs(x) - band) / (1.0 - band);
    if (opened <= 0.0) {
        return;
    }
    opened = (opened < 1.0) ? opened : 1.0;
    const uint32_t i = h->valve_actuator[j];
    const uint32_t fed = (d == 0u) ? i : (n + i);
    const uint32_t other = (d == 0u) ? (n + i) : i;
    const uint32_t source = (h->valve_pump[j] != EDP_NONE) ? (2u * n + h->valve_pump[j]) : (r->all - 1u);
    edge(r, source, fed, opening(h, opened, at[INTO + d]), true);
    if (at[OUT_OF + d] == EDP_NONE) {
        return;
    }
    /* Cushions throttle what leaves, on the side that the piston runs into. */
    const uint32_t a = h->actuator_at[i];
    const double left = (d == 0u) ? (number(h, a + STOP_HIGH) - r->frozen[i]) : (r->frozen[i] - number(h, a + STOP_LOW));
    const double share = cushion(left, number(h, a + CUSHION_LENGTH), number(h, a + CUSHION_LEAST));
    const double area = share * opening(h, opened, at[OUT_OF + d]);
    edge(r, other, r->all - 2u, area, false);
    if (at[REGENERATION + d] != EDP_NONE) {
        edge(r, other, fed, area * number(h, at[REGENERATION + d]), true);
    }
}

/* Leakage, reliefs and make-up of all chambers. */
static void port_flows(const edp_hydraulics *h, const rooms *r) {
    const uint32_t n = r->n;
    const uint32_t tank = r->all - 2u;
    for (uint32_t i = 0; i < n; i++) {
        const uint32_t a = h->actuator_at[i];
        const double leak = number(h, a + PISTON_LEAK);
        stamp(r, i, n + i, leak * (r->p[i] - r->p[n + i]), leak);
        for (uint32_t side = 0; side < 2u; side++) {
            const uint32_t node = i + side * n;
            const double spool = number(h, a + SPOOL_LEAK);
            stamp(r, node, tank, spool * (r->p[node] - r->p[tank]), spool);
            /* A slope instead of a hard limit: real reliefs let pressure rise while they open. */
            relieve(r, node, number(h, a + HEAD_RELIEF + side), circuit(h, PORT_SLOPE));
            if (r->p[node] < r->p[tank]) {
                double slope;
                const double g = turbulent(r->p[tank] - r->p[node], &slope);
                stamp(r, tank, node, circuit(h, MAKE_UP) * g, circuit(h, MAKE_UP) * slope);
            }
        }
    }
}

/* Pumps, open centres, which close as any spool of a pump moves, and main reliefs. */
static void pump_flows(const edp_hydraulics *h, const rooms *r) {
    const uint32_t tank = r->all - 2u;
    for (uint32_t m = 0; m < h->pumps; m++) {
        const uint32_t a = h->pump_at[m];
        const uint32_t node = 2u * r->n + m;
        r->net[node] += number(h, a + FLOW) * r->d[m];
        double area = number(h, a + BYPASS);
        for (uint32_t j = 0; j < h->valves; j++) {
            if (h->valve_pump[j] == m) {
                const double left = 1.0 - fabs(r->x[j]) / number(h, a + BYPASS_CLOSED);
                area *= (left > 0.0) ? (left * left) : 0.0;
            }
        }
        double slope;
        const double g = turbulent(r->p[node] - r->p[tank], &slope);
        stamp(r, node, tank, area * g, area * slope);
        relieve(r, node, number(h, a + RELIEF), circuit(h, RELIEF_SLOPE));
    }
}

/* How much oil a volume holds, as the pressure that would press it in without free air; its slope by the pressure. */
static double content(const edp_hydraulics *h, double p, double *slope) {
    const double absolute = p + ATMOSPHERE;
    const double inverse = 1.0 / ((absolute > LEAST_ABSOLUTE) ? absolute : LEAST_ABSOLUTE);
    const double air = circuit(h, AIR) * ATMOSPHERE * inverse;
    *slope = 1.0 + circuit(h, BULK) * air * inverse;
    /* Below the least pressure the curve goes on as its tangent: a pole there would end the iteration. */
    return p - circuit(h, BULK) * (air * (2.0 - absolute * inverse));
}

/* Row of one pressure. */
static void node_row(const edp_hydraulics *h, const rooms *r, uint32_t node, double volume, double area, double step) {
    const uint32_t speed = r->nodes + node % r->n;
    const double rate = step * circuit(h, BULK) / volume;
    double slope;
    const double oil = content(h, r->y[node], &slope);
    double *const row = r->by_y + node * r->unknown;
    r->residual[node] = oil - r->base[node] - rate * (r->net[node] - area * r->y[speed]);
    for (uint32_t other = 0; other < r->nodes; other++) {
        row[other] = -rate * r->jac[node * r->all + other];
    }
    zeroed(row + r->nodes, r->n);
    row[node] += slope;
    row[speed] += rate * area;
}

/* Rows of all chambers and pump lines. */
static void pressure_rows(const edp_hydraulics *h, const rooms *r, double step) {
    for (uint32_t i = 0; i < r->n; i++) {
        const uint32_t a = h->actuator_at[i];
        for (uint32_t side = 0; side < 2u; side++) {
            const double area = number(h, a + HEAD_AREA + side);
            const double way = (side == 0u) ? 1.0 : -1.0;
            const double left = way * (r->frozen[i] - number(h, a + ((side == 0u) ? STOP_LOW : STOP_HIGH)));
            /* Beyond a stop the oil of the dead volume is left. */
            const double volume = number(h, a + HEAD_DEAD + side) + area * ((left > 0.0) ? left : 0.0);
            node_row(h, r, i + side * r->n, volume, way * area, step);
        }
    }
    for (uint32_t m = 0; m < h->pumps; m++) {
        node_row(h, r, 2u * r->n + m, number(h, h->pump_at[m] + LINE), 0.0, step);
    }
}

/* LuGre friction after an implicit step of its bristle: force, its slope by v, and the deflection. */
static double friction(const edp_hydraulics *h, uint32_t a, double v, double before, double step, double *slope,
                       double *deflection) {
    const double stribeck = number(h, a + STRIBECK);
    const double fixed = number(h, a + STATIC);
    const double stiffness = number(h, a + BRISTLE);
    const double damping = number(h, a + BRISTLE_DAMPING);
    const double lean = number(h, a + ASYMMETRY);
    const double ratio = v / stribeck;
    const double fade = (fabs(ratio) < NEGLIGIBLE) ? exp(-ratio * ratio) : 0.0;
    const double level = number(h, a + COULOMB) + fixed * fade;
    /* The implicit step: z = before + step (v - stiffness |v| z / level). */
    const double share = stiffness * step * fabs(v) / level;
    const double under = 1.0 / (1.0 + share);
    const double z = (before + step * v) * under;
    const double rate = stiffness + damping * fade / step;
    const double sign = (v >= 0.0) ? 1.0 : -1.0;
    const double fade_v = -2.0 * ratio / stribeck * fade;
    const double z_v = step * under - z * under * (stiffness * step * sign / level - share / level * fixed * fade_v);
    /* A lean of the force by the sign of v, smooth over the Stribeck velocity. */
    const double tilt = tanh(ratio);
    *slope = rate * z_v + (z - before) / step * damping * fade_v + number(h, a + VISCOUS) +
             2.0 * lean * tilt * (1.0 - tilt * tilt) / stribeck;
    *deflection = z;
    return rate * z - damping * fade / step * before + number(h, a + VISCOUS) * v + lean * tilt * tilt;
}

/* Rows of all velocities; `reach` is half the time from the start of the step to this stage. */
static void motion_rows(const edp_hydraulics *h, const rooms *r, double step, double reach) {
    const uint32_t n = r->n;
    for (uint32_t i = 0; i < n; i++) {
        const uint32_t a = h->actuator_at[i];
        const double v = r->y[r->nodes + i];
        const double head = number(h, a + HEAD_AREA);
        const double rod = number(h, a + ROD_AREA);
        double *const row = zeroed(r->by_y + (r->nodes + i) * r->unknown, r->unknown);
        double slope;
        double deflection;
        const double rubbing = friction(h, a, v, r->base_z[i], step, &slope, &deflection);
        const double reached = r->s[i] + reach * (r->before[i] + v);
        double depth = 0.0;
        if (reached < number(h, a + STOP_LOW)) {
            depth = reached - number(h, a + STOP_LOW);
        } else if (reached > number(h, a + STOP_HIGH)) {
            depth = reached - number(h, a + STOP_HIGH);
        }
        const double stiffness = (depth != 0.0) ? number(h, a + STOP_STIFFNESS) : 0.0;
        double inertial = 0.0;
        for (uint32_t k = 0; k < n; k++) {
            inertial += r->mass[i * n + k] * (r->y[r->nodes + k] - r->base[r->nodes + k]);
            row[r->nodes + k] = r->mass[i * n + k];
        }
        const double push = head * r->y[i] - rod * r->y[n + i] - r->force[i];
        r->residual[r->nodes + i] = inertial - step * (push - rubbing - stiffness * depth);
        row[i] = -step * head;
        row[n + i] = step * rod;
        row[r->nodes + i] += step * (slope + stiffness * reach);
    }
}

static void assemble(const edp_hydraulics *h, const rooms *r, double step, double reach) {
    copied(r->y, r->nodes, r->p);
    r->p[r->nodes] = circuit(h, TANK);
    r->p[r->nodes + 1u] = circuit(h, SUPPLY);
    zeroed(r->net, r->all);
    zeroed(r->jac, r->all * r->all);
    for (uint32_t j = 0; j < h->valves; j++) {
        spool_flows(h, r, j, r->x[j]);
    }
    port_flows(h, r);
    pump_flows(h, r);
    pressure_rows(h, r, step);
    motion_rows(h, r, step, reach);
}

/* Replace the residual by the Newton step: LU in place, without pivots, as the diagonal of pressures dominates. */
static void solve(const rooms *r) {
    const uint32_t size = r->unknown;
    double *const a = r->by_y;
    double *const b = r->residual;
    for (uint32_t k = 0; k < size; k++) {
        for (uint32_t i = k + 1u; i < size; i++) {
            if (a[i * size + k] != 0.0) {
                const double factor = a[i * size + k] / a[k * size + k];
                for (uint32_t j = k + 1u; j < size; j++) {
                    a[i * size + j] -= factor * a[k * size + j];
                }
                b[i] -= factor * b[k];
            }
        }
    }
    for (uint32_t i = size; i-- > 0u;) {
        for (uint32_t k = i + 1u; k < size; k++) {
            b[i] -= a[i * size + k] * b[k];
        }
        b[i] /= a[i * size + i];
    }
}

/* Move one unknown by its Newton step. */
static void move(const rooms *r, uint32_t k, double change) {
    if (k >= r->nodes) {
        r->y[k] -= change;
        return;
    }
    const double held = (change > LARGEST) ? LARGEST : ((change < -LARGEST) ? -LARGEST : change);
    /* Towards a vacuum by shares of what is left: the content has a pole there. */
    const double least = 0.25 * (r->y[k] + ATMOSPHERE) - ATMOSPHERE;
    r->y[k] = (r->y[k] - held > least) ? (r->y[k] - held) : least;
}

/* What an iteration of Newton's method leaves to the next one: the share of its step, and the largest part of it. */
typedef struct {
    double share;
    double largest;
    uint32_t at;
} damping;

/* Move by a share of the step that stands in the residual. */
static void damped_step(damping *last, const rooms *r) {
    uint32_t most = 0u;
    for (uint32_t k = 1; k < r->unknown; k++) {
        most = (fabs(r->residual[k]) > fabs(r->residual[most])) ? k : most;
    }
    const double largest = r->residual[most];
    /* Where a check or a relief toggles, whole steps would go to and fro for ever. */
    const bool to_and_fro =
        (most == last->at) && (largest * last->largest < 0.0) && (fabs(largest) > 0.5 * fabs(last->largest));
    last->share *= to_and_fro ? 0.5 : 2.0;
    last->share = (last->share > 1.0) ? 1.0 : ((last->share < 0.125) ? 0.125 : last->share);
    last->largest = largest;
    last->at = most;
    for (uint32_t k = 0; k < r->unknown; k++) {
        move(r, k, last->share * r->residual[k]);
    }
}

/* Solve a stage, from a guess in y. */
static void newton(const edp_hydraulics *h, const rooms *r, double step, double reach) {
    damping last = {1.0, 0.0, r->unknown};
    for (uint32_t iteration = 0; iteration < EDP_MOST_ITERATIONS; iteration++) {
        assemble(h, r, step, reach);
        solve(r);
        damped_step(&last, r);
        if (fabs(last.largest) < TOLERANCE) {
            return;
        }
    }
}

static void lag(double *value, double goal, double keep) { *value = goal + (*value - goal) * keep; }

/* Move all valves on by `step` seconds. */
static void advance_valves(const edp_hydraulics *h, const rooms *r, const float *history, double step) {
    const double play = circuit(h, PLAY);
    for (uint32_t j = 0; j < h->valves; j++) {
        const uint16_t *const at = h->valve_at + j * VALVE_PLACES;
        double *const row = r->valves + j * VALVE_STATES;
        const double last = (double)h->history - 2.0;
        double ticks = number(h, at[DELAY]) / (double)h->tick_s;
        ticks = (ticks > last) ? last : ((ticks < 0.0) ? 0.0 : ticks);
        const uint32_t whole = (uint32_t)ticks;
        const double newer = (double)history[whole * h->valves + j];
        const double older = (double)history[(whole + 1u) * h->valves + j];
        const double pilot_keep = exp(-step / number(h, at[PILOT_LAG]));
        lag(&row[PILOT_1], newer + (ticks - (double)whole) * (older - newer), pilot_keep);
        lag(&row[PILOT_2], row[PILOT_1], pilot_keep);
        if (row[PLAYED] > row[PILOT_2] + play) {
            row[PLAYED] = row[PILOT_2] + play;
        } else if (row[PLAYED] < row[PILOT_2] - play) {
            row[PLAYED] = row[PILOT_2] - play;
        }
        const double spool_keep = exp(-step / number(h, at[SPOOL_LAG]));
        lag(&row[SPOOL_1], row[PLAYED], spool_keep);
        lag(&row[SPOOL], row[SPOOL_1], spool_keep);
    }
}

/* Move the displacements of all pumps towards what the pilots ask for, under the common power limit. */
static void displace(const edp_hydraulics *h, const rooms *r, double step) {
    double power = 0.0;
    for (uint32_t m = 0; m < h->pumps; m++) {
        const uint32_t a = h->pump_at[m];
        const double pressure = r->y[2u * r->n + m];
        r->asked[m] = number(h, a + LEAST);
        for (uint32_t j = 0; j < h->valves; j++) {
            if (h->valve_pump[j] == m) {
                const double pilot = r->valves[j * VALVE_STATES + PILOT_2];
                const double beyond = (fabs(pilot) - circuit(h, DEMAND_START)) / circuit(h, DEMAND_SPAN);
                const double x = (beyond > 1.0) ? 1.0 : ((beyond < 0.0) ? 0.0 : beyond);
                const uint32_t side = (pilot >= 0.0) ? 0u : 1u;
                const double wanted = x * number(h, h->valve_at[j * VALVE_PLACES + GAIN + side]);
                const double share = (wanted < 1.0) ? wanted : 1.0;
                r->asked[m] = (share > r->asked[m]) ? share : r->asked[m];
            }
        }
        power += number(h, a + FLOW) * r->asked[m] * ((pressure > 0.0) ? pressure : 0.0);
    }
    const double allowed = circuit(h, POWER) / ((power > IDLE) ? power : IDLE);
    for (uint32_t m = 0; m < h->pumps; m++) {
        const double keep = exp(-step / number(h, h->pump_at[m] + LAG));
        lag(&r->d[m], r->asked[m] * ((allowed < 1.0) ? allowed : 1.0), keep);
    }
}

static void contents(const edp_hydraulics *h, const rooms *r, double *held) {
    double slope;
    for (uint32_t k = 0; k < r->nodes; k++) {
        held[k] = content(h, r->y[k], &slope);
    }
    copied(r->y + r->nodes, r->n, held + r->nodes);
}

/* Strokes by the trapezoidal rule; one that is not measured has no scale, and nothing depends on it. */
static void displaced_strokes(const edp_hydraulics *h, const rooms *r, const double *start, const double *before,
                              double half) {
    for (uint32_t i = 0; i < r->n; i++) {
        const double weight = (h->scale[i] > 0.0f) ? half : 0.0;
        r->s[i] = start[i] + weight * (before[i] + r->y[r->nodes + i]);
    }
}

/* One step: two stages of an L-stable SDIRK method of order two (Alexander 1977). */
static void step_of(const edp_hydraulics *h, const rooms *r, const float *history, double step) {
    const double stage = GAMMA * step;
    copied(r->y + r->nodes, r->n, r->before);
    freeze(h, r, step);
    copied(r->z, r->n, r->zs);
    copied(r->z, r->n, r->base_z);
    contents(h, r, r->base);
    for (uint32_t which = 0; which < 2u; which++) {
        const double reach = 0.5 * ((which == 0u) ? stage : step);
        advance_valves(h, r, history, (which == 0u) ? stage : (step - stage));
        if (which == 0u) {
            displace(h, r, step);
        }
        for (uint32_t j = 0; j < h->valves; j++) {
            r->x[j] = r->valves[j * VALVE_STATES + SPOOL];
        }
        newton(h, r, stage, reach);
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
        }
    }
    displaced_strokes(h, r, r->s, r->before, 0.5 * step);
}

/* Fill the ports: what was measured, or the last answers. */
static void feed(const edp_hydraulics *h, const rooms *r, const float *fed) {
    for (uint32_t c = 0; c < h->answers; c++) {
        const uint32_t kind = h->ports[2u * c];
        const uint32_t which = h->ports[2u * c + 1u];
        const double value = (double)h->offset[c] + (double)h->width[c] * (double)fed[c];
        if (kind == 1u) {
            r->s[which] = value;
        } else if (kind == 0u) {
            r->y[r->nodes + which] = value;
        } else {
            r->y[which] = (value > LEAST_ABSOLUTE - ATMOSPHERE) ? value : (LEAST_ABSOLUTE - ATMOSPHERE);
        }
    }
}

/* Signed commands of the valves as shares of full, extension positive, behind those of the ticks before. */
static void remember(const edp_hydraulics *h, const float *commands, float *history) {
    for (uint32_t k = h->history * h->valves; k-- > h->valves;) {
        history[k] = history[k - h->valves];
    }
    for (uint32_t j = 0; j < h->valves; j++) {
        const uint32_t back = h->sides[2u * j + 1u];
        double demand = (double)commands[h->sides[2u * j]];
        demand -= (back != EDP_NONE) ? (double)commands[back] : 0.0;
        demand /= (double)h->full[j];
        history[j] = (float)((demand > 1.0) ? 1.0 : ((demand < -1.0) ? -1.0 : demand));
    }
}

static void loaded(const float *from, uint32_t count, double *to) {
    for (uint32_t i = 0; i < count; i++) {
        to[i] = (double)from[i];
    }
}

static void kept(const double *from, uint32_t count, float *to) {
    for (uint32_t i = 0; i < count; i++) {
        to[i] = (float)from[i];
    }
}

void edp_hydraulic_tick(const float *commands, const float *fed, const edp_hydraulics *h,
                        const edp_hydraulic_state *state, double *room, float *y) {
    rooms r;
    divide(h, room, &r);
    loaded(state->y, r.unknown, r.y);
    loaded(state->strokes, r.n, r.s);
    loaded(state->bristles, r.n, r.z);
    loaded(state->displacements, h->pumps, r.d);
    loaded(state->valves, h->valves * VALVE_STATES, r.valves);
    feed(h, &r, fed);
    remember(h, commands, state->history);
    copied(r.y + r.nodes, r.n, r.at_start);
    copied(r.s, r.n, r.s_start);
    for (uint32_t k = 0; k < h->steps; k++) {
        step_of(h, &r, state->history, (double)h->tick_s / (double)h->steps);
    }
    /* What a twin promises: a stroke is the trapezoidal integral of the velocities that it answers, one a tick. */
    displaced_strokes(h, &r, r.s_start, r.at_start, 0.5 * (double)h->tick_s);
    kept(r.y, r.unknown, state->y);
    kept(r.s, r.n, state->strokes);
    kept(r.z, r.n, state->bristles);
    kept(r.d, h->pumps, state->displacements);
    kept(r.valves, h->valves * VALVE_STATES, state->valves);
    uint32_t at = 0u;
    for (uint32_t c = 0; c < h->answers; c++) {
        const uint32_t kind = h->ports[2u * c];
        const uint32_t which = h->ports[2u * c + 1u];
        if (kind != 1u) {
            const double value = r.y[which + ((kind == 0u) ? r.nodes : 0u)];
            y[at] = (float)((value - (double)h->offset[c]) / (double)h->width[c]);
            at++;
        }
    }
}
