/* Checksum of levers of a controller, and on a Cortex-M the executed instructions of a tick: see count.c. */
#include "cycles.h"
#include "machine_control.h"
#include "machine_control_golden.h"

#include <stdio.h>

#ifndef TICKS
#define TICKS 8u
#endif

static machine_control control;
static float levers[TICKS][EDP_AXES];
static const edp_reference reference = {GOLDEN_ROWS, golden_strokes, golden_tip};

int main(void) {
    const edp_table table = {levers, TICKS * EDP_AXES, 4u};
    unsigned long instructions = 0u;
    if (machine_control_begin(&control, golden_measured[0], &reference) != EDP_CONTROL_OK) {
        return 2;
    }
    for (uint32_t tick = 0; tick < TICKS; tick++) {
#ifdef __arm__
        const uint32_t start = begin_count();
#endif
        if (machine_control_step(&control, golden_measured[tick], levers[tick]) != EDP_CONTROL_OK) {
            return 3;
        }
#ifdef __arm__
        instructions += counted_since(start);
#endif
    }
    (void)printf("%lu instructions\n", instructions / TICKS);
    (void)printf("%08lx\n", (unsigned long)edp_crc(&table, 1u));
    return 0;
}
