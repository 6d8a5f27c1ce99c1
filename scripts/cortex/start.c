// Where a Cortex-M0 begins: its vector table, for programs that talk to qemu by semihosting.
#include <stdint.h>
#include <stdlib.h>

extern uint32_t stack_top[]; // memory.ld
void _start(void);           // newlib's, of rdimon

// Any fault: a misaligned access, an instruction that this core lacks.
static void fault(void) { _Exit(70); }

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))stack_top,
    _start,
    fault,
    fault,
};
