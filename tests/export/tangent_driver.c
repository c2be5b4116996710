/* Reads a number of directions and rows of inputs and their changes, along each direction; writes rows of predictions
 * and their changes. A row whose first input is -12345 is a tick that was missed. */
#include "predictor_tangent.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST 64u
#define WIDTH (sizeof(predictor_output) / sizeof(float))

static predictor_state state;
static predictor_state twin;
static predictor_tangent tangents[MOST];

int main(int argc, char **argv) {
    static float din[MOST][PREDICTOR_INPUTS];
    static predictor_output dout[MOST];
    static float in[PREDICTOR_INPUTS];
    predictor_output out;
    predictor_output other;
    const uint32_t count = (uint32_t)atoi((argc > 1) ? argv[1] : "1");
    const int alone = (argc > 2) && (strcmp(argv[2], "alone") == 0); /* this tick's inputs alone */
    (void)memset(&out, 0, sizeof out);
    (void)memset(&other, 0, sizeof other);
    (void)memset(dout, 0, sizeof dout);
    if (predictor_step_tangents(&state, tangents, count, in, (const float(*)[PREDICTOR_INPUTS])din, &out, dout) !=
        EDP_NOT_RESET) {
        return 3;
    }
    predictor_reset(&state);
    twin = state;
    for (uint32_t k = 0; k < count; k++) {
        predictor_tangent_reset(&tangents[k]);
    }
    while (fread(in, sizeof in, 1u, stdin) == 1u) {
        edp_status status;
        edp_status same;
        if (fread(din, sizeof din[0], count, stdin) != count) {
            return 4;
        }
        for (uint32_t k = 0; alone && (k < count); k++) {
            predictor_tangent_reset(&tangents[k]);
        }
        if (in[0] == -12345.0f) {
            status = predictor_missed_tangents(&state, tangents, count, 1u, &out, dout);
            same = predictor_missed(&twin, 1u, &other);
        } else if (count == 1u) {
            status = predictor_step_tangent(&state, tangents, in, din[0], &out, dout);
            same = predictor_step(&twin, in, &other);
        } else {
            status = predictor_step_tangents(&state, tangents, count, in, (const float(*)[PREDICTOR_INPUTS])din, &out,
                                             dout);
            same = predictor_step(&twin, in, &other);
        }
        /* The step itself is predictor_step, bit for bit, in what it gives and in what it remembers. */
        if ((status != same) || (memcmp(&out, &other, sizeof out) != 0) || (memcmp(&state, &twin, sizeof twin) != 0)) {
            return 5;
        }
        if ((fwrite(&out, sizeof out, 1u, stdout) != 1u) || (fwrite(dout, sizeof out, count, stdout) != count)) {
            return 6;
        }
    }
    return 0;
}
