/* Start of a bare Cortex-M image under QEMU (mps2-an386, mps2-an500): vectors, floating-point unit, semihosting. */
#include <stdint.h>

extern uint32_t stack_top;
extern int main(int argc, char **argv);
extern void initialise_monitor_handles(void);
extern void exit(int code);

void reset_handler(void);
void fault_handler(void);

void fault_handler(void) { exit(3); }

void reset_handler(void) {
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* full access to the FPU */
    __asm volatile("dsb\n isb");
    initialise_monitor_handles();
    exit(main(0, 0));
}

__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    &stack_top,    reset_handler, fault_handler, fault_handler, fault_handler, fault_handler, fault_handler, 0, 0, 0, 0,
    fault_handler, fault_handler, 0,             fault_handler, fault_handler};

/* Named by the C library; nothing is to be done here. */
void _init(void);
void _fini(void);
void _init(void) {}
void _fini(void) {}
