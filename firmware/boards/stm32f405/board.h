/* The parts of this board. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "quad_store.h"
#include "registers.h"

/* Core clock, timers' clock to 1 MHz, watchdog. True where it comes from one of its own bites. */
bool board_start(void);

/* us since boot. */
uint64_t board_now_us(void);

/* The control loop is alive: at least every BOARD_HUNG_MS. */
void board_alive(void);
#define BOARD_HUNG_MS 50u

extern const quad_flash board_flash; /* to be written while the motors stand */

void board_tick(void); /* SysTick, 1 kHz */

uint32_t board_stack_used(void);

/* A USART with rings: what arrives is kept, what is sent never waits. Where the chip has its DMA the
 * rings are the DMA's; where it has none (an emulator) bytes come by interrupt and go out at once. */
typedef enum { UART_BRIDGE, UART_SIMULATION } uart;
void uart_start(void);
size_t uart_read(uart which, uint8_t *bytes, size_t room);
size_t uart_room(uart which);
void uart_write(uart which, const uint8_t *bytes, size_t count);
/* Whether nothing has come that an interrupt would not tell of. */
bool uart_quiet(void);
void uart_1_interrupt(void);
void uart_2_interrupt(void);

#endif
