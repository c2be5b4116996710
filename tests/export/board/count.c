/* Checksum of predictions, and on a Cortex-M the executed instructions of a step.
 *
 * Under QEMU with -icount shift=0 an instruction takes 1 ns, and SysTick counts at CLOCK_HZ.
 */
#include "predictor.h"
#include "predictor_golden.h"

#include <stdio.h>

#ifdef __arm__
#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
#define PER_COUNT (1000000000u / CLOCK_HZ)
#endif

static predictor_state state;
static predictor_output outputs[GOLDEN_TICKS];

int main(void) {
    const edp_table table = {outputs, (uint32_t)(sizeof outputs / 4u), 4u};
    predictor_reset(&state);
#ifdef __arm__
    SYST_RVR = 0xFFFFFFu;
    SYST_CVR = 0u;
    SYST_CSR = 5u;
    const uint32_t start = SYST_CVR;
#endif
    for (uint32_t tick = 0; tick < GOLDEN_TICKS; tick++) {
        (void)predictor_step(&state, golden_inputs[tick], &outputs[tick]);
    }
#ifdef __arm__
    const uint32_t passed = (start - SYST_CVR) & 0xFFFFFFu;
    (void)printf("%lu instructions\n", (unsigned long)(passed * PER_COUNT / GOLDEN_TICKS));
#endif
    (void)printf("%08lx\n", (unsigned long)edp_crc(&table, 1u));
    return 0;
}
