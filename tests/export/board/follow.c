/* Executed instructions of ticks of a follower on a Cortex-M, one run of a stretch a tick: see count.c. */
#include "cycles.h"
#include "follower.h"
#include "follower_golden.h"

#include <math.h>

#include <stdio.h>
#include <string.h>

static follower_state state;

int main(void) {
    follower_tick tick;
    float y[FOLLOWER_HORIZONS][FOLLOWER_TARGETS];
    unsigned long most = 0u;
    unsigned long long sum = 0u;
    unsigned long counted = 0u;
    follower_reset(&state);
    (void)memset(y, 0, sizeof y);
    for (uint32_t at = 0; at < GOLDEN_TICKS; at++) {
        (void)memcpy(tick.commands, golden_inputs[at], sizeof tick.commands);
        (void)memcpy(tick.measured, golden_inputs[at] + FOLLOWER_COMMANDS, sizeof tick.measured);
        tick.oil_c = NAN;
#ifdef __arm__
        const uint32_t start = begin_count();
#endif
        (void)follower_step(&state, &tick, RUNS, y, y);
#ifdef __arm__
        const unsigned long spent = counted_since(start);
        /* A stretch is run again from the prefix and one stretch on. */
        if (at >= SKIPPED) {
            most = (spent > most) ? spent : most;
            sum += spent;
            counted++;
        }
#endif
    }
    (void)printf("%lu %lu instructions\n", (counted > 0u) ? (unsigned long)(sum / counted) : 0u, most);
    (void)printf("%lu taught\n", (unsigned long)state.count.taught);
    return 0;
}
