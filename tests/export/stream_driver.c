/* Reads calls from standard input and writes what each of them gave: status, counts and the output. */
#include "predictor.h"
#include <stdio.h>
#include <string.h>

static predictor_state state;

int main(void) {
    predictor_output out;
    uint32_t call[2]; /* 0 step, 1 missed, 2 reset; how many ticks were missed */
    float in[PREDICTOR_INPUTS];
    memset(&out, 0xff, sizeof out); /* not a number until something is written */
    predictor_reset(&state);
    while (fread(call, sizeof call, 1u, stdin) == 1u && fread(in, sizeof in, 1u, stdin) == 1u) {
        uint32_t said[5] = {0u, 0u, 0u, 0u, 0u};
        if (call[0] == 0u) {
            said[0] = (uint32_t)predictor_step(&state, in, &out);
        } else if (call[0] == 1u) {
            said[0] = (uint32_t)predictor_missed(&state, call[1], &out);
        } else {
            predictor_reset(&state);
            memset(&out, 0xff, sizeof out);
        }
        said[1] = state.ticks;
        said[2] = state.rejected;
        said[3] = state.held;
        said[4] = state.restarts;
        if (fwrite(said, sizeof said, 1u, stdout) != 1u || fwrite(&out, sizeof out, 1u, stdout) != 1u) {
            return 2;
        }
    }
    return 0;
}
