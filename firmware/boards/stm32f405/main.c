/* The firmware on an STM32F405, its sensors and motors on the second line (quad_hil.h): the simulation
 * sends settings, then the inputs of each cycle. In lockstep time is that of the inputs; otherwise TIM2
 * paces the cycles and a cycle whose inputs are late waits for them. Gains that were confirmed are kept in
 * flash; here the simulation's settings count, a board with sensors of its own hands over what it kept. */
#include <string.h>

#include "board.h"
#include "quad_hil.h"
#include "quad_outbox.h"

#define SLICE 64u /* bytes looked at in one turn of the loop */
#define TOLD_CYCLES 1250u /* between two texts on timing */

static struct {
    quad_firmware firmware;
    quad_hil hil;
    quad_hil_boot boot;
    quad_inputs inputs;
    uint64_t due_us, last_us, start_us;
    uint32_t kept;     /* confirmations that serve_flash has seen to */
    bool booted, waiting, started;
} board;

static uint64_t now_us(void)
{
    const uint64_t now = board_now_us();
    return board.boot.lockstep || !board.started ? board.last_us : now - board.start_us;
}

static void begin(void)
{
    board.boot.settings.endpoint.key = NULL;
    quad_firmware_init(&board.firmware, &board.boot.settings);
    board.booted = true;
    board.kept = 0;
    board.started = board.waiting = false;
    board.last_us = 0;
}

static void hear_simulation(void)
{
    uint8_t bytes[SLICE];
    const size_t count = uart_read(UART_SIMULATION, bytes, sizeof bytes);
    for (size_t i = 0; i < count; i++) {
        const quad_hil_kind kind =
            quad_hil_take(&board.hil, bytes[i], &board.boot, &board.due_us, &board.inputs);
        if (kind == QUAD_HIL_BOOT) {
            begin();
        } else if (kind == QUAD_HIL_SENSORS) {
            board.waiting = board.booted;
        }
    }
}

/* What the table in docs/results/firmware.md is made of. */
static void tell_timing(void)
{
    const quad_timing *t = &board.firmware.timing;
    if (t->cycles % TOLD_CYCLES == 0) {
        quad_put_timing(&board.firmware.endpoint, t->latest_us, t->longest_us, board_stack_used());
    }
}

static void run_cycle(void)
{
    float motors[4];
    uint8_t frame[QUAD_HIL_MOTORS];
    const uint64_t began_us = board_now_us();
    if (!board.started) {
        board.started = true;
        board.start_us = began_us - board.due_us;
    }
    const uint64_t due_us = board.boot.lockstep ? began_us : board.start_us + board.due_us;
    board.last_us = board.due_us;
    board.waiting = false;
    quad_firmware_cycle(&board.firmware, board.due_us, &board.inputs, motors);
    quad_firmware_timed(&board.firmware, due_us, began_us, board_now_us());
    tell_timing();
    serve_send(&board.firmware);
    quad_hil_motors(motors, board.due_us, &board.firmware.timing, frame);
    uart_write(UART_SIMULATION, frame, sizeof frame);
}

/* Sleep until an interrupt, where nothing is there to be done (ARMv7-M B1.5.18: it also ends a WFI while
 * masked). SysTick comes once a ms. */
static void rest(void)
{
    __asm volatile("cpsid i");
    if (uart_quiet() && !board.waiting) {
        __asm volatile("wfi");
    }
    __asm volatile("cpsie i");
}

/* A motor frame before the first: the simulation may speak. */
static void say_ready(void)
{
    const float stopped[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    uint8_t frame[QUAD_HIL_MOTORS];
    quad_hil_motors(stopped, 0, &board.firmware.timing, frame);
    uart_write(UART_SIMULATION, frame, sizeof frame);
}

int main(void)
{
    quad_store_prepare(&board_flash); /* before the watchdog: an erasure takes seconds */
    const bool bitten = board_start();
    uart_start();
    say_ready();
    for (;;) {
        board_alive();
        rest();
        if (board.booted) {
            serve_bridge(&board.firmware, now_us());
        }
        hear_simulation();
        if (board.waiting &&
            (board.boot.lockstep || !board.started || board.due_us <= now_us())) {
            const bool first = !board.started;
            run_cycle();
            serve_flash(&board.firmware, &board.kept);
            if (first && bitten) {
                quad_put_text(&board.firmware.endpoint, 2, "restarted by the watchdog");
            }
#ifdef QUAD_HANG_AFTER /* for the test of the watchdog */
            if (!bitten && board.firmware.timing.cycles == QUAD_HANG_AFTER) {
                for (;;) {
                }
            }
#endif
        }
    }
}
