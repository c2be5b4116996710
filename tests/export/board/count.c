/* Checksum of predictions, and on a Cortex-M the executed instructions of a step.
 *
 * Under QEMU with -icount shift=0 an instruction takes 1 ns, and SysTick counts at CLOCK_HZ.
 */
#include "cycles.h"
#include "predictor.h"
#include "predictor_golden.h"

#include <stdio.h>

static predictor_state state;
static predictor_output outputs[GOLDEN_TICKS];

int main(void) {
    const edp_table table = {outputs, (uint32_t)(sizeof outputs / 4u), 4u};
    predictor_reset(&state);
#ifdef __arm__
    const uint32_t start = begin_count();
#endif
    for (uint32_t tick = 0; tick < GOLDEN_TICKS; tick++) {
        (void)predictor_step(&state, golden_inputs[tick], &outputs[tick]);
    }
#ifdef __arm__
    (void)printf("%lu instructions\n", counted_since(start) / GOLDEN_TICKS);
#endif
    (void)printf("%08lx\n", (unsigned long)edp_crc(&table, 1u));
    return 0;
}
