/* From reset to main: vectors, memory, and a painted stack whose high-water mark can be read. */
#include <stdint.h>

#include "board.h"
#include "registers.h"

#define PAINT 0x5AC3A55Au

extern uint32_t data_load[], data_start[], data_end[], bss_start[], bss_end[], stack_low[],
    stack_high[];

void reset(void);
int main(void);

/* A fault, or an interrupt that nobody asked for: motors are held by their timers at most until the
 * watchdog bites. */
static void stuck(void)
{
    for (;;) {
    }
}

uint32_t board_stack_used(void)
{
    const uint32_t *word = stack_low;
    while (word < stack_high && *word == PAINT) {
        word++;
    }
    return (uint32_t)(stack_high - word) * 4u;
}

void reset(void)
{
    CPACR |= 0xFu << 20; /* the FPU, before any float */
    __asm volatile("dsb\n isb");
    uint32_t *word = stack_low;
    uint32_t *here;
    __asm volatile("mov %0, sp" : "=r"(here));
    while (word < here - 8) {
        *word++ = PAINT;
    }
    const uint32_t *from = data_load;
    for (word = data_start; word < data_end;) {
        *word++ = *from++;
    }
    for (word = bss_start; word < bss_end;) {
        *word++ = 0;
    }
    main();
    stuck();
}

typedef void (*handler)(void);
#define STUCK4 stuck, stuck, stuck, stuck

/* ARMv7-M B1.5.2; RM0090 12.1.3 */
__attribute__((section(".vectors"), used)) static const handler vectors[16 + 82] = {
    (handler)(uintptr_t)stack_high, reset, stuck, stuck, STUCK4, stuck, stuck, stuck, stuck, stuck,
    stuck, stuck, board_tick,
    /* 0 to 28 */ STUCK4, STUCK4, STUCK4, STUCK4, STUCK4, STUCK4, STUCK4, stuck,
    /* 29 */ stuck,
    /* 30 TIM4 */ receiver_4_interrupt,
    /* 31 to 36 */ stuck, STUCK4, stuck,
    /* 37, 38 */ uart_1_interrupt, uart_2_interrupt,
    /* 39 to 49 */ STUCK4, STUCK4, stuck, stuck, stuck,
    /* 50 TIM5 */ receiver_5_interrupt,
    /* 51 to 53 UART5 */ stuck, stuck, receiver_interrupt,
};
