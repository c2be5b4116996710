/* Reads rows of inputs and one number: 1 learn, 0 frozen, 2 a missed tick, 3 keeps what was learned, resets and goes on
 * with it, 4 damages the memory. Writes rows of the network's predictions, the adapted ones, and the status. */
#include "predictor_adaptation.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

static predictor_state state;
static predictor_adaptation adaptation;

int main(void) {
    float row[PREDICTOR_INPUTS + 1u];
    predictor_output out;
    predictor_output adapted;
    predictor_learned learned;
    (void)memset(&out, 0, sizeof out);
    (void)memset(&adapted, 0, sizeof adapted);
    (void)memset(&learned, 0, sizeof learned);
    if (predictor_adapt_set(&adaptation, &learned) ||
        (predictor_adapt(&adaptation, &state, true, &out, &adapted) != EDP_ADAPT_NONE)) {
        return 3; /* neither was reset */
    }
    predictor_reset(&state);
    predictor_adapt_reset(&adaptation);
    while (fread(row, sizeof row, 1u, stdin) == 1u) {
        const float what = row[PREDICTOR_INPUTS];
        float status;
        if (what == 2.0f) {
            (void)predictor_missed(&state, 1u, &out);
        } else {
            (void)predictor_step(&state, row, &out);
        }
        if (what == 3.0f) {
            predictor_adapt_get(&adaptation, &learned);
            predictor_adapt_reset(&adaptation);
            if (!predictor_adapt_set(&adaptation, &learned)) {
                return 4;
            }
            learned.theta[0][0][0] = NAN;
            if (predictor_adapt_set(&adaptation, &learned)) {
                return 5;
            }
        }
        if (what == 4.0f) {
            adaptation.learned.theta[0][0][0] = NAN;
            adaptation.covariance[0][0] = -1.0f;
        }
        status = (float)predictor_adapt(&adaptation, &state, what != 0.0f, &out, &adapted);
        if ((fwrite(&out, sizeof out, 1u, stdout) != 1u) || (fwrite(&adapted, sizeof adapted, 1u, stdout) != 1u) ||
            (fwrite(&status, sizeof status, 1u, stdout) != 1u)) {
            return 6;
        }
    }
    (void)fprintf(stderr, "%u %u\n", (unsigned)adaptation.taught, (unsigned)adaptation.repairs);
    return 0;
}
