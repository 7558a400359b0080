/* What a board brings: the mains (main.c with its sensors on the second line, flight.c with its own) know no
 * more of it than this. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "quad_bus.h"
#include "quad_firmware.h"
#include "quad_store.h"
#include "radio.h"
#include "registers.h"
#include "serial_radio.h"

/* Core clock, timers' clock to 1 MHz, watchdog. True where it comes from one of its own bites. */
bool board_start(void);

/* us since boot. */
uint64_t board_now_us(void);

/* The control loop is alive: at least every BOARD_HUNG_MS. */
void board_alive(void);
#define BOARD_HUNG_MS 50u
#ifndef EMULATED_HUNG_MS /* an emulator's time is its host's, which may have other work */
#define EMULATED_HUNG_MS 5000u
#endif

extern const quad_flash board_flash; /* to be written while the motors stand */

void board_tick(void); /* SysTick, 1 kHz */
uint64_t board_id(void); /* unique to this chip */

uint32_t board_stack_used(void);

/* A USART with rings: what arrives is kept, what is sent never waits. Where the chip has its DMA the
 * rings are the DMA's; where it has none (an emulator) bytes come by interrupt and go out at once. */
typedef enum { UART_BRIDGE, UART_SIMULATION } uart;
void uart_start(void);
size_t uart_read(uart which, uint8_t *bytes, size_t room);
size_t uart_room(uart which);
void uart_write(uart which, const uint8_t *bytes, size_t count);
/* Whether no event is pending for which there is no interrupt. */
bool uart_quiet(void);
void uart_1_interrupt(void);
void uart_2_interrupt(void);

/* I2C2 (PB10, PB11) at 400 kHz, to gyro, compass and barometer. */
extern const quad_bus board_bus;
void i2c_start(void);

/* Receiver, motors, battery. Edges wait in a ring, false where there is none. */
void pulses_start(void);
bool pulses_edge(radio_edge *edge);
void pulses_motors(const float motors[4], float least_us, float most_us);
float battery_pin_v(void); /* behind the divider */
void receiver_4_interrupt(void);
void receiver_5_interrupt(void);

/* A receiver on UART5 instead of pulses: hear what has come by now_us; send telemetry unless some is under way. */
void receiver_start(serial_kind kind);
void receiver_hear(serial_radio *r, uint64_t now_us);
void receiver_tell(const uint8_t *bytes, size_t count);
void receiver_interrupt(void);

/* What both mains do between two cycles: send what waits, hear the bridge at now_us, and keep confirmed gains
 * in flash while the motors stand, or report that they could not; `kept` counts the confirmations handled. */
void serve_send(quad_firmware *f);
void serve_bridge(quad_firmware *f, uint64_t now_us);
void serve_flash(quad_firmware *f, uint32_t *kept);

#endif
