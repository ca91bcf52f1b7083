/* What a Cortex-M starts with: its stack, the floating-point unit that the compiler may use, and newlib's start. */
#include <stdint.h>
#include <stdlib.h>

extern char stack_top[];
void _start(void);

static void reset(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xF << 20; /* CPACR */
    __asm__ volatile("dsb\n isb");
    _start();
}

/* A fault ends the program, and not well. */
static void fault(void) { _Exit(3); }

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))stack_top, reset, fault, fault, fault, fault, fault};
