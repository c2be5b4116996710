/* A grey box that follows a machine. See edp_follow.h. */
#include "edp_follow.h"

#include <math.h>

#define STEP 0.02       /* of a logarithm, to see its effect */
#define CLIP 3.0        /* units beyond which an error teaches no more */
#define BOUND 3.0       /* prior deviations within which logarithms are held */
#define WARMER 0.02     /* change of a logarithm by temperature from which numbers are made anew */
#define HOTTEST_C 150.0f
#define REST 1e-3f      /* m/s below which nothing is told of valves */
#define PROBE_MN 0.01   /* by which a force is changed to see its effect, */
#define RENEWED_TICKS 10u /* how often, */
#define MOST_MN 0.5     /* and the largest estimate */
#define BEYOND 0.05f    /* share of a stroke by which it may lie beyond an end stop at the start */

static bool finite_double(double x) { return x - x == 0.0; }

static void copy_doubles(const double *from, uint32_t count, double *to) {
    for (uint32_t i = 0; i < count; i++) {
        to[i] = from[i];
    }
}

static void fill_doubles(double value, uint32_t count, double *to) {
    for (uint32_t i = 0; i < count; i++) {
        to[i] = value;
    }
}

/* The parts of a state. */
static edp_hydraulic_state parts_of(const edp_hydraulics *h, float *state) {
    edp_hydraulic_state s;
    const uint32_t n = h->actuators;
    s.y = state;
    s.strokes = s.y + 3u * n + h->pumps;
    s.bristles = s.strokes + n;
    s.displacements = s.bristles + n;
    s.valves = s.displacements + ((h->pumps > 0u) ? h->pumps : 1u);
    s.history = s.valves + 5u * h->valves;
    return s;
}

/* The machine with these numbers. */
static edp_hydraulics machine_with(const edp_follow_law *w, const float *numbers) {
    edp_hydraulics h = *w->machine;
    h.numbers = numbers;
    return h;
}

/* Numbers with these logarithms, `grown` larger by a step (groups: none). */
static void set_numbers(const edp_follow_law *w, const edp_follow_memory *m, uint32_t grown, float *numbers) {
    edp_copy(w->machine->numbers, w->numbers, numbers);
    /* Entries of a number follow each other. */
    for (uint32_t e = 0; e < w->entries;) {
        const uint32_t which = w->entry_number[e];
        double power = 0.0;
        for (; (e < w->entries) && (w->entry_number[e] == which); e++) {
            const uint32_t g = w->entry_group[e];
            const double log = m->by_oil[g] + (m->logs[g] + ((g == grown) ? STEP : 0.0));
            power += (double)w->powers[e] * log;
        }
        numbers[which] = (float)((double)w->machine->numbers[which] * exp(power));
    }
}

/* Numbers of now; what was expected with others is no more. */
static void renew(const edp_follow_law *w, const edp_follow_memory *m) {
    set_numbers(w, m, w->groups, m->numbers);
    m->n->expects = false;
    m->n->age = 0u;
}

void edp_follow_interrupt(const edp_follow_law *w, const edp_follow_memory *m) {
    fill_doubles(0.0, w->machine->actuators, m->resistance);
    renew(w, m);
    m->n->started = false;
    m->n->begun = false;
    m->n->due = false;
    m->n->ticks = 0u;
    m->n->seen = 0u;
    m->n->at = 0u;
    edp_fill(NAN, w->horizons * w->velocities, m->forecast);
}

/* What was learned, as before anything was. */
static void forget(const edp_follow_law *w, const edp_follow_memory *m) {
    fill_doubles(0.0, w->groups, m->logs);
    fill_doubles(0.0, w->groups * w->groups, m->covariance);
    for (uint32_t g = 0; g < w->groups; g++) {
        m->covariance[g * w->groups + g] = (double)w->deviation[g] * (double)w->deviation[g];
    }
    fill_doubles(0.0, w->velocities, m->square);
    m->n->judged = 0u;
}

void edp_follow_reset(const edp_follow_law *w, const edp_follow_memory *m) {
    forget(w, m);
    fill_doubles(0.0, w->groups, m->by_oil);
    fill_doubles(0.0, w->horizons * 3u * w->targets, m->products);
    edp_fill(0.0f, w->horizons * w->targets, m->weight);
    for (uint32_t h = 0; h < w->horizons; h++) {
        m->counted[h] = 0u;
    }
    m->n->taught = 0u;
    m->n->repairs = 0u;
    m->n->learned = false;
    edp_follow_interrupt(w, m);
}

float edp_follow_factor(double log, double by_oil) { return (float)exp(by_oil + log); }

/* ---- runs ------------------------------------------------------------------------------------------------------------ */

/* A run from a state; ports read what there is. */
static void open_run(const edp_follow_law *w, const edp_follow_memory *m, edp_near *run, const edp_hydraulics *h,
                     float *state, const float *row, const double *resistance) {
    const edp_hydraulic_state s = parts_of(h, state);
    edp_near_open(run, h, w->low, w->high, 0u, m->room, m->differs);
    edp_near_load(run, s.y, s.strokes, s.bristles, s.displacements, s.valves);
    run->resistance = resistance;
    for (uint32_t i = 0; i < h->answers; i++) {
        if (edp_finite(row[i])) {
            edp_near_read(run, i, row[i]);
        }
    }
}

/* Whether the machine can start there: all measured, no stroke far beyond an end stop. */
static bool can_start(const edp_follow_law *w, const float *measured) {
    const edp_hydraulics *const h = w->machine;
    bool good = edp_all_finite(measured, h->answers);
    for (uint32_t i = 0; i < h->answers; i++) {
        if (h->ports[2u * i] == 1u) {
            const float range = BEYOND * (w->high[i] - w->low[i]);
            good = good && (w->low[i] - measured[i] <= range) && (measured[i] - w->high[i] <= range);
        }
    }
    return good;
}

/* At rest with these demands and measured values. */
static void start(const edp_follow_law *w, const edp_follow_memory *m, const float *demands, const float *measured) {
    const edp_hydraulics *const h = w->machine;
    const edp_hydraulic_state s = parts_of(h, m->now);
    const uint32_t nodes = 2u * h->actuators + h->pumps;
    const edp_hydraulics moved = machine_with(w, m->numbers);
    edp_near_rest(&moved, &s);
    for (uint32_t i = 0; i < h->answers; i++) {
        const uint32_t kind = h->ports[2u * i];
        const uint32_t which = h->ports[2u * i + 1u];
        if (kind == 1u) {
            s.strokes[which] = measured[i];
        } else {
            s.y[which + ((kind == 0u) ? nodes : 0u)] = (kind == 2u) ? (1e-6f * measured[i]) : measured[i];
        }
    }
    for (uint32_t j = 0; j < h->valves; j++) {
        edp_fill(demands[j], 5u, s.valves + 5u * j);
        for (uint32_t k = 0; k < h->history; k++) {
            s.history[k * h->valves + j] = demands[j];
        }
    }
    edp_copy(measured, h->answers, m->own);
    m->n->started = true;
}

/* Solves a x = b of n unknowns, both destroyed; false where there is no solution. */
static bool solve(double *a, double *b, uint32_t n, double *x) {
    for (uint32_t c = 0; c < n; c++) {
        uint32_t pivot = c;
        for (uint32_t r = c + 1u; r < n; r++) {
            pivot = (fabs(a[r * n + c]) > fabs(a[pivot * n + c])) ? r : pivot;
        }
        if (!(fabs(a[pivot * n + c]) > 0.0)) {
            return false;
        }
        for (uint32_t k = 0; k < n; k++) {
            const double kept = a[c * n + k];
            a[c * n + k] = a[pivot * n + k];
            a[pivot * n + k] = kept;
        }
        const double moved = b[c];
        b[c] = b[pivot];
        b[pivot] = moved;
        for (uint32_t r = c + 1u; r < n; r++) {
            const double share = a[r * n + c] / a[c * n + c];
            for (uint32_t k = c; k < n; k++) {
                a[r * n + k] -= share * a[c * n + k];
            }
            b[r] -= share * b[c];
        }
    }
    for (uint32_t c = n; c-- > 0u;) {
        double sum = b[c];
        for (uint32_t k = c + 1u; k < n; k++) {
            sum -= a[c * n + k] * x[k];
        }
        x[c] = sum / a[c * n + c];
        if (!finite_double(x[c])) {
            return false;
        }
    }
    return true;
}

/* Inverse of a positive definite matrix by its root, which takes the matrix's place; false where it is none. */
static bool inverted(double *a, uint32_t n, double *inverse) {
    for (uint32_t i = 0; i < n; i++) {
        for (uint32_t j = 0; j <= i; j++) {
            double sum = a[i * n + j];
            for (uint32_t k = 0; k < j; k++) {
                sum -= a[i * n + k] * a[j * n + k];
            }
            if (i != j) {
                a[i * n + j] = sum / a[j * n + j];
            } else if ((sum > 0.0) && finite_double(sum)) {
                a[i * n + i] = sqrt(sum);
            } else {
                return false;
            }
        }
    }
    for (uint32_t c = 0; c < n; c++) {
        for (uint32_t i = 0; i < n; i++) {
            double sum = (i == c) ? 1.0 : 0.0;
            for (uint32_t k = 0; k < i; k++) {
                sum -= a[i * n + k] * inverse[k * n + c];
            }
            inverse[i * n + c] = sum / a[i * n + i];
        }
        for (uint32_t i = n; i-- > 0u;) {
            double sum = inverse[i * n + c];
            for (uint32_t k = i + 1u; k < n; k++) {
                sum -= a[k * n + i] * inverse[k * n + c];
            }
            inverse[i * n + c] = sum / a[i * n + i];
        }
    }
    return true;
}

/* ---- forces that no number stands for -------------------------------------------------------------------------------- */

static uint32_t actuator_of(const edp_follow_law *w, uint32_t velocity) { return w->machine->ports[2u * velocity + 1u]; }

/* From velocities that were not expected. */
static void estimate_load(const edp_follow_law *w, const edp_follow_memory *m, const float *measured) {
    const uint32_t n = w->velocities;
    double *const matrix = m->work;
    double *const right = m->work + n * n;
    double *const forces = right + n;
    if (!m->n->expects || !edp_all_finite(measured, n)) {
        return;
    }
    copy_doubles(m->by_force, n * n, matrix);
    for (uint32_t i = 0; i < n; i++) {
        right[i] = (double)measured[i] - m->expected[i];
    }
    if (!solve(matrix, right, n, forces)) {
        return;
    }
    for (uint32_t i = 0; i < n; i++) {
        double *const force = &m->resistance[actuator_of(w, i)];
        const double next = *force + (double)w->load_share * forces[i];
        *force = (next > MOST_MN) ? MOST_MN : ((next < -MOST_MN) ? -MOST_MN : next);
    }
}

/* Slopes of velocities after the last tick by forces against them. */
static void renew_slopes(const edp_follow_law *w, const edp_follow_memory *m, const edp_hydraulics *h) {
    const uint32_t n = w->velocities;
    edp_near run;
    for (uint32_t axis = 0; axis < n; axis++) {
        double *const force = &m->resistance[actuator_of(w, axis)];
        const double was = *force;
        *force = was + PROBE_MN;
        open_run(w, m, &run, h, m->before, m->row, m->resistance);
        (void)edp_near_next(&run, m->demands, 1u, parts_of(h, m->before).history, 0u, false);
        *force = was;
        for (uint32_t i = 0; i < n; i++) {
            m->by_force[i * n + axis] = (edp_near_answer(&run, i, false) - m->expected[i]) / PROBE_MN;
        }
    }
}

/* ---- learning --------------------------------------------------------------------------------------------------------- */

/* Run the due stretch once more: with the present numbers (run 0), or with those of a group grown. */
static void run_again(const edp_follow_law *w, const edp_follow_memory *m) {
    const uint32_t run = m->n->run;
    const uint32_t size = w->velocities;
    double *const to = (run == 0u) ? m->errors : (m->slopes + (run - 1u) * w->learn_ticks * size);
    edp_near near;
    set_numbers(w, m, (run == 0u) ? w->groups : (run - 1u), m->trial);
    const edp_hydraulics h = machine_with(w, m->trial);
    open_run(w, m, &near, &h, m->due.state, m->due.row, m->due.resistance);
    for (uint32_t tick = 0; tick < w->learn_ticks; tick++) {
        (void)edp_near_next(&near, m->due.demands, w->learn_ticks, parts_of(&h, m->due.state).history, tick, false);
        for (uint32_t i = 0; i < size; i++) {
            const double answer = edp_near_answer(&near, i, false);
            const uint32_t k = tick * size + i;
            to[k] = (run == 0u) ? ((double)m->due.truth[k] - answer) : ((answer + m->errors[k] - (double)m->due.truth[k]) / STEP);
        }
    }
    m->n->run++;
}

/* In units of what errors lately were: errors and slopes of the due stretch. */
static void scale_errors(const edp_follow_law *w, const edp_follow_memory *m) {
    const uint32_t size = w->velocities;
    const uint32_t count = w->learn_ticks * size;
    m->n->judged += (m->n->judged < EDP_FOLLOW_LATELY) ? 1u : 0u;
    for (uint32_t i = 0; i < size; i++) {
        double sum = 0.0;
        for (uint32_t k = i; k < count; k += size) {
            sum += m->errors[k] * m->errors[k];
        }
        m->square[i] += (sum / (double)w->learn_ticks - m->square[i]) / (double)m->n->judged;
        const double least = (double)w->floors[i];
        const double unit = sqrt((m->square[i] > least) ? m->square[i] : least);
        for (uint32_t k = i; k < count; k += size) {
            const double error = m->errors[k] / unit;
            m->errors[k] = (error > CLIP) ? CLIP : ((error < -CLIP) ? -CLIP : error);
            for (uint32_t g = 0; g < w->groups; g++) {
                m->slopes[g * count + k] /= unit;
            }
        }
    }
}

/* P = (P^-1 + S' S / ticks)^-1, x = a (x + P S' e / ticks), P = a^2 P + (1 - a^2) prior; false where P is damaged. */
static bool filtered(const edp_follow_law *w, const edp_follow_memory *m) {
    const uint32_t n = w->groups;
    const uint32_t count = w->learn_ticks * w->velocities;
    double *const whole = m->work;
    double *const posterior = whole + n * n;
    double *const pull = posterior + n * n;
    bool good = true;
    copy_doubles(m->covariance, n * n, posterior);
    if (!inverted(posterior, n, whole)) {
        return false;
    }
    for (uint32_t a = 0; a < n; a++) {
        pull[a] = 0.0;
        for (uint32_t k = 0; k < count; k++) {
            pull[a] += m->slopes[a * count + k] * m->errors[k];
        }
        for (uint32_t b = 0; b < n; b++) {
            double sum = 0.0;
            for (uint32_t k = 0; k < count; k++) {
                sum += m->slopes[a * count + k] * m->slopes[b * count + k];
            }
            whole[a * n + b] += sum / (double)w->learn_ticks;
        }
    }
    if (!inverted(whole, n, posterior)) {
        return false;
    }
    for (uint32_t a = 0; a < n; a++) {
        const double most = BOUND * (double)w->deviation[a];
        double moved = m->logs[a];
        for (uint32_t b = 0; b < n; b++) {
            const double shared = 0.5 * (posterior[a * n + b] + posterior[b * n + a]);
            moved += posterior[a * n + b] * pull[b] / (double)w->learn_ticks;
            m->covariance[a * n + b] = w->keep * w->keep * shared;
        }
        m->covariance[a * n + a] += (1.0 - w->keep * w->keep) * (double)w->deviation[a] * (double)w->deviation[a];
        moved *= w->keep;
        m->logs[a] = (moved > most) ? most : ((moved < -most) ? -most : moved);
        good = good && finite_double(m->logs[a]);
    }
    return good;
}

/* After the last run of the due stretch. */
static void learn(const edp_follow_law *w, const edp_follow_memory *m) {
    const uint32_t count = w->learn_ticks * w->velocities;
    bool finite = true;
    for (uint32_t k = 0; k < count; k++) {
        finite = finite && finite_double(m->errors[k]);
    }
    for (uint32_t k = 0; k < w->groups * count; k++) {
        finite = finite && finite_double(m->slopes[k]);
    }
    m->n->due = false;
    if (!finite) {
        return;
    }
    scale_errors(w, m);
    if (filtered(w, m)) {
        m->n->taught++;
    } else {
        forget(w, m);
        m->n->repairs++;
    }
    m->n->learned = true;
    renew(w, m);
}

/* As many runs of what is due. */
static void run_due(const edp_follow_law *w, const edp_follow_memory *m, uint32_t runs) {
    for (uint32_t left = runs; (left > 0u) && m->n->due; left--) {
        run_again(w, m);
        if (m->n->run > w->groups) {
            learn(w, m);
        }
    }
}

/* Note what a stretch has come to; at its end it is due, if it can teach and nothing else is. */
static void take(const edp_follow_law *w, const edp_follow_memory *m, const float *measured, bool learns) {
    const uint32_t size = w->velocities;
    const uint32_t valves = w->machine->valves;
    const edp_follow_stretch *const from = &m->open;
    if (!m->n->begun || (m->n->count == 0u)) {
        return;
    }
    edp_copy(measured, size, from->truth + (m->n->count - 1u) * size);
    if (m->n->count < w->learn_ticks) {
        return;
    }
    m->n->begun = false;
    bool moves = false;
    for (uint32_t k = 0; k < w->learn_ticks * size; k++) {
        moves = moves || (fabsf(from->truth[k]) > REST);
    }
    if (!learns || !moves || m->n->due || !edp_all_finite(from->truth, w->learn_ticks * size)) {
        return;
    }
    edp_copy(from->state, w->state, m->due.state);
    edp_copy(from->row, w->machine->answers, m->due.row);
    copy_doubles(from->resistance, w->machine->actuators, m->due.resistance);
    edp_copy(from->demands, w->learn_ticks * valves, m->due.demands);
    edp_copy(from->truth, w->learn_ticks * size, m->due.truth);
    m->n->due = true;
    m->n->run = 0u;
}

/* What the temperature of the oil makes of the numbers. */
static void warm(const edp_follow_law *w, const edp_follow_memory *m, float oil_c) {
    const float apart = oil_c - w->oil_c;
    bool moves = false;
    if (!((fabsf(apart) <= 2.0f * HOTTEST_C) && (fabsf(oil_c) <= HOTTEST_C))) {
        return;
    }
    for (uint32_t g = 0; g < w->groups; g++) {
        moves = moves || (fabs((double)w->warmth[g] * (double)apart - m->by_oil[g]) > WARMER);
    }
    if (moves) {
        for (uint32_t g = 0; g < w->groups; g++) {
            m->by_oil[g] = (double)w->warmth[g] * (double)apart;
        }
        /* Runs of it with numbers from before and after could not be compared. */
        m->n->due = false;
        renew(w, m);
    }
}

/* ---- a tick ----------------------------------------------------------------------------------------------------------- */

/* The observer's tick and, where it has settled, its forecasts; false if a number is not finite. */
static bool advance(const edp_follow_law *w, const edp_follow_memory *m) {
    const edp_hydraulics h = machine_with(w, m->numbers);
    const edp_hydraulic_state s = parts_of(&h, m->now);
    const bool settled = m->n->ticks > w->prefix;
    const uint32_t ticks = settled ? w->reach : 1u;
    edp_near run;
    bool finite = true;
    edp_copy(m->now, w->state, m->before);
    const float *const history = parts_of(&h, m->before).history;
    for (uint32_t k = 1; k < w->reach; k++) {
        edp_copy(m->demands, h.valves, m->demands + k * h.valves);
    }
    open_run(w, m, &run, &h, m->now, m->row, m->resistance);
    for (uint32_t tick = 0; (tick < ticks) && finite; tick++) {
        finite = edp_near_next(&run, m->demands, w->reach, history, tick, false);
        if (tick == 0u) {
            edp_near_keep(&run, &s, m->demands, 1u);
            for (uint32_t i = 0; i < h.answers; i++) {
                m->own[i] = (float)edp_near_answer(&run, i, false);
            }
            for (uint32_t i = 0; i < w->velocities; i++) {
                m->expected[i] = edp_near_answer(&run, i, false);
            }
        }
        for (uint32_t e = 0; settled && (e < w->horizons); e++) {
            for (uint32_t i = 0; (i < w->velocities) && (w->ahead[e] == tick + 1u); i++) {
                m->forecast[e * w->velocities + i] = (float)edp_near_answer(&run, i, false);
            }
        }
    }
    if (finite && (w->load_share > 0.0f)) {
        m->n->expects = true;
        if (m->n->age % RENEWED_TICKS == 0u) {
            renew_slopes(w, m, &h);
        }
        m->n->age = (m->n->age + 1u) % RENEWED_TICKS;
    }
    return finite;
}

/* The observer and its learning. */
static void follow(const edp_follow_law *w, const edp_follow_memory *m, const float *commands, const float *measured,
                   uint32_t runs) {
    const edp_hydraulics *const h = w->machine;
    edp_near_demands(h, commands, m->demands);
    if (!m->n->started) {
        if (!can_start(w, measured)) {
            return;
        }
        start(w, m, m->demands, measured);
    }
    take(w, m, measured, runs > 0u);
    run_due(w, m, runs);
    estimate_load(w, m, measured);
    for (uint32_t i = 0; i < h->answers; i++) {
        m->row[i] = m->own[i] + w->gain * (measured[i] - m->own[i]);
    }
    m->n->ticks += (m->n->ticks <= w->prefix) ? 1u : 0u;
    if (!m->n->begun && (m->n->ticks > w->prefix)) {
        edp_copy(m->now, w->state, m->open.state);
        edp_copy(m->row, h->answers, m->open.row);
        copy_doubles(m->resistance, h->actuators, m->open.resistance);
        m->n->begun = true;
        m->n->count = 0u;
    }
    if (m->n->begun) {
        edp_copy(m->demands, h->valves, m->open.demands + m->n->count * h->valves);
        m->n->count++;
    }
    if (!advance(w, m)) {
        edp_follow_interrupt(w, m);
    }
}

/* The weight of least squared error of a mixture, from mean products of errors. */
static float weight_of(double own, double other, double both) {
    const double apart = own + other - 2.0 * both;
    const double share = (apart > 0.0) ? ((own - both) / apart) : 0.0;
    return (float)((share > 1.0) ? 1.0 : ((share > 0.0) ? share : 0.0));
}

static double clipped(double value, double most) { return (value > most) ? most : ((value < -most) ? -most : value); }

/* What was predicted and forecast of this tick, `row` of a horizon's ticks ago, against what is measured. */
static void judge(const edp_follow_law *w, const edp_follow_memory *m, uint32_t h, const float *row, const float *measured) {
    const uint32_t size = w->targets;
    const float *const ours = row + h * size;
    const float *const theirs = row + (w->horizons + h) * size;
    double *const mean = m->products + h * 3u * size;
    bool moves = false;
    bool finite = true;
    for (uint32_t j = 0; j < size; j++) {
        const float present = measured[w->columns[j]];
        moves = moves || (fabsf(present) > REST);
        finite = finite && edp_finite(present) && edp_finite(ours[j]) && edp_finite(theirs[j]);
    }
    if (!finite || !moves) {
        return;
    }
    m->counted[h] += (m->counted[h] < 0xFFFFFFFFu) ? 1u : 0u;
    const double once = 1.0 / (double)m->counted[h];
    const double rate = (w->judged_rate > once) ? w->judged_rate : once;
    const bool judges = (double)m->counted[h] * w->judged_rate >= 1.0 - 1e-9;
    for (uint32_t j = 0; j < size; j++) {
        const double present = (double)measured[w->columns[j]];
        const double limit = (double)w->limit[h * size + j];
        const double own = clipped((present - (double)ours[j]) / limit, 1.0);
        const double other = clipped((present - (double)theirs[j]) / limit, 1.0);
        mean[j] += (own * own - mean[j]) * rate;
        mean[size + j] += (other * other - mean[size + j]) * rate;
        mean[2u * size + j] += (own * other - mean[2u * size + j]) * rate;
        if (judges) {
            m->weight[h * size + j] = weight_of(mean[j], mean[size + j], mean[2u * size + j]);
        }
    }
}

bool edp_follow_tick(const edp_follow_law *w, const edp_follow_memory *m, const float *commands, const float *measured,
                     float oil_c, uint32_t runs, const float *prediction, float *moved) {
    const uint32_t size = w->targets;
    const uint32_t row = 2u * w->horizons * size;
    m->n->learned = false;
    warm(w, m, oil_c);
    if (runs == 0u) {
        m->n->due = false;
    }
    edp_fill(NAN, w->horizons * w->velocities, m->forecast);
    if (edp_all_finite(commands, w->commands)) {
        follow(w, m, commands, measured, runs);
    } else {
        edp_follow_interrupt(w, m);
    }
    for (uint32_t h = 0; h < w->horizons; h++) {
        if (m->n->seen >= w->ahead[h]) {
            const uint32_t back = m->n->at + w->reach - w->ahead[h];
            judge(w, m, h, m->ring + ((back < w->reach) ? back : (back - w->reach)) * row, measured);
        }
    }
    float *const now = m->ring + m->n->at * row;
    for (uint32_t k = 0; k < w->horizons * size; k++) {
        const float base = prediction[k];
        const float ahead = m->forecast[(k / size) * w->velocities + w->columns[k % size]];
        const double step = clipped((double)m->weight[k] * ((double)ahead - (double)base), (double)w->limit[k]);
        now[k] = base;
        now[w->horizons * size + k] = ahead;
        moved[k] = finite_double(step) ? (float)((double)base + step) : base;
    }
    m->n->seen += (m->n->seen < w->reach) ? 1u : 0u;
    m->n->at = (m->n->at + 1u < w->reach) ? (m->n->at + 1u) : 0u;
    return m->n->started && (m->n->ticks > w->prefix);
}
