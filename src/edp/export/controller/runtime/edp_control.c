#include "edp_control.h"

#include "edp_runtime.h"

#include <math.h>
#include <stddef.h>

#define PI 3.14159265f
/* Tip speed (m/s) above which an error has a direction along the path and one across. */
#define FAST_TIP 0.02f
/* By which tip poses (m, rad) may differ from those of the strokes; half a hundredth is measuring with a tape. */
#define SAME_TIP 0.02f
/* By which strokes (m) may lie beyond an end stop: zeros of sensors. */
#define BEYOND_STOP 0.005f

static float clipped(float x, float low, float high) { return (x < low) ? low : ((x > high) ? high : x); }

float edp_polygon(const float *x, const float *y, uint32_t n, float at) {
    float value = y[n - 1u];
    if (at < x[0]) {
        value = y[0];
    } else {
        for (uint32_t i = 0; i + 1u < n; i++) {
            if (at < x[i + 1u]) {
                value = y[i] + (y[i + 1u] - y[i]) / (x[i + 1u] - x[i]) * (at - x[i]);
                break;
            }
        }
    }
    return value;
}

float edp_lever_of(const edp_valve_side sides[2], float speed) {
    return (speed >= 0.0f) ? edp_polygon(sides[0].speeds, sides[0].levers, sides[0].points, speed)
                           : -edp_polygon(sides[1].speeds, sides[1].levers, sides[1].points, -speed);
}

float edp_towards(float target, float from, float step) { return clipped(target, from - step, from + step); }

void edp_limit_levers(const edp_lever_limits *limits, const float asked[EDP_AXES], float levers[EDP_AXES]) {
    for (uint32_t i = 0; i < EDP_AXES; i++) {
        const float ranged = clipped(asked[i], limits->low[i], limits->high[i]);
        levers[i] = edp_towards(ranged, levers[i], limits->slew[i]);
    }
}

float edp_pilot_pressure(const edp_lever_shape *shape, const edp_pilot *pilot, const float levers[EDP_AXES]) {
    const float lever = levers[pilot->axis];
    float demand = 0.0f;
    if ((lever >= 0.0f) == pilot->extend) {
        demand = clipped((fabsf(lever) - shape->zone) / (1.0f - shape->zone), 0.0f, 1.0f);
        if (pilot->second) {
            demand = pilot->share * clipped((demand - shape->start) / (1.0f - shape->start), 0.0f, 1.0f);
        }
    }
    return shape->full * demand;
}

uint32_t edp_reference_row(const edp_reference *reference, uint32_t tick) {
    return (tick < reference->ticks) ? tick : (reference->ticks - 1u);
}

float edp_slope_at(const float (*rows)[EDP_AXES], uint32_t ticks, uint32_t row, uint32_t column, float rate) {
    const uint32_t before = (row > 0u) ? (row - 1u) : 0u;
    const uint32_t after = (row + 1u < ticks) ? (row + 1u) : row;
    const float way = rows[after][column] - rows[before][column];
    return (after > before) ? (way * rate / (float)(after - before)) : 0.0f;
}

edp_refusal edp_check_reference(const edp_reference *reference, const edp_front *front) {
    if ((reference->ticks == 0u) || (reference->strokes == NULL) || (reference->tip == NULL)) {
        return EDP_REFUSED_EMPTY;
    }
    for (uint32_t row = 0; row < reference->ticks; row++) {
        const float *const strokes = reference->strokes[row];
        const float *const tip = reference->tip[row];
        float reached[EDP_AXES];
        if (!edp_all_finite(strokes, EDP_AXES) || !edp_all_finite(tip, EDP_AXES)) {
            return EDP_REFUSED_NUMBERS;
        }
        for (uint32_t i = 0; i < EDP_AXES; i++) {
            if ((strokes[i] < -BEYOND_STOP) || (strokes[i] > front->full[i] + BEYOND_STOP)) {
                return EDP_REFUSED_STROKES;
            }
        }
        edp_tip(front, strokes, reached, NULL);
        if ((fabsf(reached[0] - tip[0]) > SAME_TIP) || (fabsf(reached[1] - tip[1]) > SAME_TIP) ||
            (fabsf(edp_wrapped(reached[2] - tip[2])) > SAME_TIP)) {
            return EDP_REFUSED_KINEMATICS;
        }
    }
    return EDP_REFUSED_NOT;
}

void edp_tip(const edp_front *front, const float strokes[EDP_AXES], float tip[EDP_AXES],
             float jacobian[EDP_AXES][EDP_AXES]) {
    float turned[EDP_AXES];
    float slope[EDP_AXES];
    float along[EDP_AXES];
    float up[EDP_AXES];
    float angle = 0.0f;
    for (uint32_t i = 0; i < EDP_AXES; i++) {
        const float spaces = (float)(front->nodes - 1u);
        const float node = clipped(strokes[i] / front->full[i], 0.0f, 1.0f) * spaces;
        const uint32_t whole = (uint32_t)node;
        const uint32_t low = (whole + 1u < front->nodes) ? whole : (front->nodes - 2u);
        const float first = front->angles[low][i];
        const float rise = front->angles[low + 1u][i] - first;
        angle += first + (node - (float)low) * rise;
        turned[i] = angle;
        slope[i] = rise * spaces / front->full[i];
    }
    edp_map_cosine(turned, EDP_AXES, along);
    edp_map_sine(turned, EDP_AXES, up);
    edp_multiply(along, front->length, EDP_AXES, along);
    edp_multiply(up, front->length, EDP_AXES, up);
    tip[0] = along[0] + along[1] + along[2];
    tip[1] = up[0] + up[1] + up[2];
    tip[2] = turned[2];
    if (jacobian != NULL) {
        float x = 0.0f;
        float y = 0.0f;
        /* A joint turns all links behind it. */
        for (uint32_t i = EDP_AXES; i-- > 0u;) {
            x -= up[i];
            y += along[i];
            jacobian[0][i] = x * slope[i];
            jacobian[1][i] = y * slope[i];
            jacobian[2][i] = slope[i];
        }
    }
}

float edp_wrapped(float angle) { return angle - 2.0f * PI * floorf((angle + PI) / (2.0f * PI)); }

void edp_error_rows(const edp_reference *reference, uint32_t row, float rate, float along, float attitude,
                    float rows[EDP_AXES][EDP_AXES]) {
    const float x = edp_slope_at(reference->tip, reference->ticks, row, 0u, rate);
    const float y = edp_slope_at(reference->tip, reference->ticks, row, 1u, rate);
    const float speed = sqrtf(x * x + y * y);
    const bool moves = speed > FAST_TIP;
    const float root = sqrtf(along);
    rows[0][0] = moves ? (-y / speed) : 1.0f;
    rows[0][1] = moves ? (x / speed) : 0.0f;
    rows[0][2] = 0.0f;
    rows[1][0] = moves ? (root * x / speed) : 0.0f;
    rows[1][1] = moves ? (root * y / speed) : 1.0f;
    rows[1][2] = 0.0f;
    rows[2][0] = 0.0f;
    rows[2][1] = 0.0f;
    rows[2][2] = attitude;
}

void edp_pi_levers(const edp_pi_gains *gains, const edp_valve_side sides[EDP_AXES][2], const edp_lever_limits *limits,
                   const edp_reference *reference, uint32_t tick, const float strokes[EDP_AXES], float sum[EDP_AXES],
                   float levers[EDP_AXES]) {
    const uint32_t now = edp_reference_row(reference, tick);
    const uint32_t ahead = edp_reference_row(reference, now + gains->lead);
    for (uint32_t i = 0; i < EDP_AXES; i++) {
        const float error = reference->strokes[now][i] - strokes[i];
        const float wanted = edp_slope_at(reference->strokes, reference->ticks, ahead, i, gains->rate);
        const float speed = wanted + gains->proportional * error + sum[i];
        levers[i] = (fabsf(speed) > gains->rest) ? edp_lever_of(sides[i], speed) : 0.0f;
        /* No integration at a saturated lever, which could not follow. */
        if ((levers[i] > limits->low[i]) && (levers[i] < limits->high[i])) {
            sum[i] = clipped(sum[i] + gains->integral * error / gains->rate, -gains->most, gains->most);
        }
    }
}
