/* Executed instructions on a Cortex-M under QEMU with -icount shift=0: one takes 1 ns, and SysTick counts at CLOCK_HZ. */
#ifndef CYCLES_H
#define CYCLES_H
#ifdef __arm__
#include <stdint.h>

#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
#define PER_COUNT (1000000000u / CLOCK_HZ)

static inline uint32_t begin_count(void) {
    SYST_RVR = 0xFFFFFFu;
    SYST_CVR = 0u;
    SYST_CSR = 5u;
    return SYST_CVR;
}

static inline unsigned long counted_since(uint32_t start) {
    return (unsigned long)(((start - SYST_CVR) & 0xFFFFFFu) * PER_COUNT);
}
#endif
#endif
