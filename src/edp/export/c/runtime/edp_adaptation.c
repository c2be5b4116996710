/* A Kalman filter on coefficients that fade with time; see edp_adaptation.h. */
#include "edp_adaptation.h"

static float within(float x, float limit) {
    float y = x;
    if (y > limit) {
        y = limit;
    }
    if (y < -limit) {
        y = -limit;
    }
    return y;
}

static float magnitude(float x) { return (x < 0.0f) ? -x : x; }

static float dot(const float *a, const float *b, uint32_t n) {
    float sum = 0.0f;
    for (uint32_t i = 0; i < n; i++) {
        sum += a[i] * b[i];
    }
    return sum;
}

/* True if a target, as measured or as predicted, is farther from its middle than its dead zone. */
static bool moves(const edp_adapt_law *law, const float *in, const float *y) {
    bool moving = false;
    for (uint32_t j = 0; j < law->targets; j++) {
        if ((magnitude(in[law->columns[j]] - law->middle[j]) > law->dead_zone[j]) ||
            (magnitude(y[j] - law->middle[j]) > law->dead_zone[j])) {
            moving = true;
        }
    }
    return moving;
}

void edp_adapt_directions(const edp_adapt_law *law, const float *in, float *scaled, float *y) {
    for (uint32_t i = 0; i < law->inputs; i++) {
        scaled[i] = within((in[i] - law->offset[i]) / law->scale[i], EDP_ADAPT_FEATURE_LIMIT);
    }
    for (uint32_t i = 0; i < law->rank; i++) {
        y[i] = within(dot(law->directions + i * law->inputs, scaled, law->inputs), EDP_ADAPT_FEATURE_LIMIT);
    }
}

static void start(const edp_adapt_law *law, float *covariance) {
    const uint32_t n = law->features;
    edp_fill(0.0f, n * n, covariance);
    for (uint32_t i = 0; i < n; i++) {
        covariance[i * n + i] = law->prior;
    }
}

void edp_adapt_forget(const edp_adapt_law *law, edp_adapt_memory *m) {
    const uint32_t row = law->features + 2u * law->targets;
    edp_fill(0.0f, law->targets * law->features, m->theta);
    edp_fill(0.0f, m->ticks * row, m->rows);
    edp_fill(0.0f, law->targets, m->plain);
    edp_fill(0.0f, law->targets, m->corrected);
    for (uint32_t j = 0; j < law->targets; j++) {
        m->fallback[j] = false;
    }
    start(law, m->covariance);
}

/* Brings a running error on. */
static void follow(float error, float rate, float *running) {
    float size = magnitude(error);
    if (size > EDP_ADAPT_MOST_ERROR) {
        size = EDP_ADAPT_MOST_ERROR;
    }
    *running += rate * (size - *running);
}

/* Compares the running errors of a target; returns true if its correction is taken back now. */
static bool judge(const edp_adapt_law *law, edp_adapt_memory *m, uint32_t j, float error, float correction) {
    bool worse = false;
    follow(error, law->rate, &m->plain[j]);
    follow(error - correction, law->rate, &m->corrected[j]);
    if (m->fallback[j]) {
        m->fallback[j] = m->corrected[j] >= law->better * m->plain[j];
    } else {
        worse = m->corrected[j] > law->worse * m->plain[j];
        m->fallback[j] = worse;
    }
    return worse;
}

/* P = a^2 (P - g g' / d) + refresh I; false if it is not sound any more. */
static bool renew(const edp_adapt_law *law, const float *g, float inverse, float *p) {
    const uint32_t n = law->features;
    bool sound = true;
    for (uint32_t i = 0; i < n; i++) {
        float *const own = &p[i * n + i];
        for (uint32_t l = i; l < n; l++) {
            const float value = law->keep_squared * (p[i * n + l] - (g[i] * g[l]) * inverse);
            p[i * n + l] = value;
            p[l * n + i] = value;
        }
        *own += law->refresh;
        if (!((*own > 0.0f) && (*own <= 2.0f * law->prior))) {
            sound = false;
        }
    }
    return sound;
}

static uint32_t teach(const edp_adapt_law *law, edp_adapt_memory *m, const float *phi, const float *error,
                      float *g) {
    const uint32_t n = law->features;
    uint32_t done = 2u;
    for (uint32_t i = 0; i < n; i++) {
        g[i] = dot(m->covariance + i * n, phi, n);
    }
    const float d = law->noise + dot(phi, g, n);
    if (d >= law->noise) {
        const float inverse = 1.0f / d;
        for (uint32_t j = 0; j < law->targets; j++) {
            float *const theta = m->theta + j * n;
            const float step = within(error[j] - dot(theta, phi, n), EDP_ADAPT_CLIP) * inverse;
            for (uint32_t i = 0; i < n; i++) {
                theta[i] = within(law->keep * (theta[i] + g[i] * step), law->bound);
            }
        }
        done = renew(law, g, inverse, m->covariance) ? 1u : 3u;
    }
    if (done != 1u) {
        start(law, m->covariance);
    }
    return done;
}

void edp_adapt_error(const edp_adapt_law *law, edp_adapt_memory *m, const float *row, const float *in,
                     float *error) {
    const float *const base = row + law->features;
    for (uint32_t j = 0; j < law->targets; j++) {
        error[j] = (in[law->columns[j]] - base[j]) / law->unit[m->horizon * law->targets + j];
    }
}

uint32_t edp_adapt_due(const edp_adapt_law *law, edp_adapt_memory *m, const float *row, const float *error,
                       bool learn, float *g) {
    const uint32_t n = law->features;
    const float *const correction = row + n + law->targets;
    const bool moved = row[0] > 0.0f;
    bool restart = false;
    for (uint32_t j = 0; moved && (j < law->targets); j++) {
        if (judge(law, m, j, error[j], correction[j]) && learn) {
            edp_fill(0.0f, n, m->theta + j * n);
            m->corrected[j] = m->plain[j];
            restart = true;
        }
    }
    if (restart) {
        start(law, m->covariance);
    }
    return (moved && learn) ? teach(law, m, row, error, g) : 0u;
}

bool edp_adapt_correct(const edp_adapt_law *law, edp_adapt_memory *m, const float *in, const float *y,
                       const float *seen, float *row, float *correction) {
    const uint32_t n = law->features;
    const uint32_t targets = law->targets;
    const uint32_t first = m->horizon * targets;
    float *const kept = row + n + targets;
    bool sound = true;
    row[0] = 1.0f;
    for (uint32_t j = 0; j < targets; j++) {
        const float measured = in[law->columns[j]];
        row[1u + j] = within((measured - law->middle[j]) / law->spread[j], EDP_ADAPT_FEATURE_LIMIT);
        row[1u + targets + j] = within((y[j] - measured) / law->change[first + j], EDP_ADAPT_FEATURE_LIMIT);
        row[1u + 2u * targets + j] = within(seen[j], EDP_ADAPT_FEATURE_LIMIT);
    }
    edp_copy(seen + targets, law->rank, row + 1u + 3u * targets);
    if (!moves(law, in, y)) {
        edp_fill(0.0f, n, row);
    }
    edp_copy(y, targets, row + n);
    for (uint32_t j = 0; j < targets; j++) {
        const float sum = dot(m->theta + j * n, row, n);
        if (!edp_finite(sum)) {
            edp_fill(0.0f, n, m->theta + j * n);
            sound = false;
        }
        kept[j] = edp_finite(sum) ? within(sum, law->limit) : 0.0f;
        correction[j] = m->fallback[j] ? 0.0f : (law->unit[first + j] * kept[j]);
    }
    return sound;
}
