/* Bodies of a known linkage. See edp_linkage.h; the equations are those of edp.networks.twin.grey.linkage. */
#include "edp_linkage.h"
#include "edp_parameter_index.h"

#include <math.h>

/* In the values of a knot. */
enum { STROKE, ANGLE, SLOPE, CURVATURE };

#define BEYOND 1.0 /* share of a stretch by which polynomials are followed beyond the first and last knot */

/* A body as it is: first and second derivative of its joint's angle by the stroke, where it is and how it turns. */
typedef struct {
    uint32_t actuator;
    double first, second;
    double cosine, sine, rate, bend;
    double x, y, inertia; /* moments about its joint, and inertia, with the bodies that it carries at its end */
} body;

/* Angle of a joint at a stroke, and its derivatives into `b`. */
static double joint_angle(const float *joint, double stroke, body *b) {
    uint32_t low = 0u;
    uint32_t high = LINKAGE_KNOTS - 1u;
    while (high - low > 1u) {
        const uint32_t middle = (low + high) / 2u;
        if ((double)joint[KNOT + KNOT_VALUES * middle + STROKE] > stroke) {
            high = middle;
        } else {
            low = middle;
        }
    }
    const float *const k = joint + KNOT + KNOT_VALUES * low;
    const float *const after = k + KNOT_VALUES;
    const double width = (double)after[STROKE] - (double)k[STROKE];
    const double along = (stroke - (double)k[STROKE]) / width;
    const double u = (along < -BEYOND) ? -BEYOND : ((along > 1.0 + BEYOND) ? (1.0 + BEYOND) : along);
    const double rise = (double)after[ANGLE] - (double)k[ANGLE];
    const double d_0 = (double)k[SLOPE] * width;
    const double d_1 = (double)after[SLOPE] * width;
    const double b_0 = (double)k[CURVATURE] * width * width;
    const double b_1 = (double)after[CURVATURE] * width * width;
    const double c_3 = 10.0 * rise - 6.0 * d_0 - 4.0 * d_1 - 1.5 * b_0 + 0.5 * b_1;
    const double c_4 = -15.0 * rise + 8.0 * d_0 + 7.0 * d_1 + 1.5 * b_0 - b_1;
    const double c_5 = 6.0 * rise - 3.0 * (d_0 + d_1) - 0.5 * (b_0 - b_1);
    const double outside = (along - u) * width;
    b->first = (d_0 + u * (b_0 + u * (3.0 * c_3 + u * (4.0 * c_4 + u * 5.0 * c_5)))) / width;
    b->second = (b_0 + u * (6.0 * c_3 + u * (12.0 * c_4 + u * 20.0 * c_5))) / (width * width);
    if (along < -BEYOND || along > 1.0 + BEYOND) {
        b->second = 0.0;
    }
    return (double)k[ANGLE] + u * (d_0 + u * (0.5 * b_0 + u * (c_3 + u * (c_4 + u * c_5)))) + outside * b->first;
}

/* Moments and inertia of body `a` about its joint. */
static void base(const float *linkage, const float *numbers, uint32_t a, body *b) {
    const float *const own = numbers + BODY_VALUES * a;
    const double mass = (double)own[MASS];
    const double x = (double)own[CENTRE_X];
    const double y = (double)own[CENTRE_Y];
    b->x = mass * x;
    b->y = mass * y;
    b->inertia = (double)own[INERTIA] + mass * (x * x + y * y);
    for (uint32_t far = a + 1u; far < BODIES; far++) {
        const double length = (double)linkage[LENGTH + a];
        const double behind = (double)numbers[BODY_VALUES * far + MASS];
        b->x += length * behind;
        b->inertia += length * length * behind;
    }
}

/* Sum over the bodies from `i` and from `k` on: what turns with both joints. */
static double turned(double coupled[BODIES][BODIES], uint32_t i, uint32_t k) {
    double sum = 0.0;
    for (uint32_t a = i; a < BODIES; a++) {
        for (uint32_t c = k; c < BODIES; c++) {
            sum += coupled[a][c];
        }
    }
    return sum;
}

void edp_linkage_load(const float *linkage, const float *numbers, const double *strokes, const double *v, double *mass,
                      double *force) {
    body all[BODIES];
    double coupled[BODIES][BODIES];
    double torque[BODIES];
    double angle = 0.0;
    double rate = 0.0;
    double bend = 0.0;
    for (uint32_t a = 0; a < BODIES; a++) {
        const float *const joint = linkage + JOINTS + a * JOINT_VALUES;
        body *const b = &all[a];
        b->actuator = (uint32_t)joint[ACTUATOR];
        const double speed = v[b->actuator];
        angle += joint_angle(joint, strokes[b->actuator], b);
        rate += b->first * speed;
        bend += b->second * speed * speed;
        b->cosine = cos(angle);
        b->sine = sin(angle);
        b->rate = rate;
        b->bend = bend;
        base(linkage, numbers, a, b);
        coupled[a][a] = b->inertia;
        torque[a] = b->inertia * bend + (double)linkage[GRAVITY] * (b->x * b->cosine - b->y * b->sine);
    }
    for (uint32_t far = 1; far < BODIES; far++) {
        const body *const b = &all[far];
        for (uint32_t near = 0; near < far; near++) {
            const body *const a = &all[near];
            const double length = (double)linkage[LENGTH + near];
            const double cosine = length * (a->cosine * b->cosine + a->sine * b->sine);
            const double sine = length * (a->cosine * b->sine - a->sine * b->cosine);
            const double both = b->x * cosine - b->y * sine;
            const double slope = b->x * sine + b->y * cosine;
            coupled[near][far] = both;
            coupled[far][near] = both;
            torque[near] += both * b->bend - slope * b->rate * b->rate;
            torque[far] += both * a->bend + slope * a->rate * a->rate;
        }
    }
    double behind = 0.0;
    for (uint32_t i = BODIES; i-- > 0u;) {
        behind += torque[i];
        force[all[i].actuator] = all[i].first * behind;
        for (uint32_t k = 0; k < BODIES; k++) {
            mass[all[i].actuator * BODIES + all[k].actuator] = all[i].first * all[k].first * turned(coupled, i, k);
        }
    }
}
