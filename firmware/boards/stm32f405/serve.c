/* What both mains do between two cycles. See board.h. */
#include "board.h"
#include "quad_outbox.h"

#define SLICE 64u /* bytes heard in one turn of the loop */

void serve_send(quad_firmware *f)
{
    uint8_t bytes[256];
    size_t room = uart_room(UART_BRIDGE), count = 1;
    while (room > 0 && count > 0) {
        count = quad_firmware_send(f, bytes, room < sizeof bytes ? room : sizeof bytes);
        uart_write(UART_BRIDGE, bytes, count);
        room -= count;
    }
}

void serve_bridge(quad_firmware *f, uint64_t now_us)
{
    uint8_t bytes[SLICE];
    const size_t count = uart_read(UART_BRIDGE, bytes, sizeof bytes);
    if (count > 0) {
        quad_firmware_receive(f, bytes, count, now_us);
        serve_send(f);
    }
}

/* The core stops for a ms. */
void serve_flash(quad_firmware *f, uint32_t *kept)
{
    const quad_gains *gains = &f->endpoint.gains;
    if (*kept != gains->confirmations && !f->endpoint.armed) {
        *kept = gains->confirmations;
        if (!quad_store_save(&board_flash, gains->good)) {
            quad_put_text(&f->endpoint, 4, "flash: these gains end with the power");
        }
    }
}
