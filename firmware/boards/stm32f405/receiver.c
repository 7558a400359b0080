/* A receiver that sends frames of bytes, on UART5: PD2 hears, PC12 sends CRSF's telemetry. RM0090 30.3.
 * NOT YET RUN ON A BOARD. See board.h. */
#include <string.h>

#include "board.h"

#define RING 256u /* a power of two; 6 ms at 420,000 baud */
#define ERRORS 7u /* parity, framing, noise */
#define OVERRUN (1u << 3) /* may stand alone, and asks until the data are read: 30.3.3 */

static struct {
    uint8_t bytes[RING];
    uint16_t at_us[RING];
    volatile uint32_t head; /* written, by interrupt; counts on */
    uint32_t tail;          /* read */
    uint8_t out[SERIAL_LONGEST];
    volatile size_t left, sent;
} line;

void receiver_start(serial_kind kind)
{
    static const uint32_t baud[] = {100000u, 420000u, 115200u};
    RCC->AHB1ENR |= (1u << 2) | (1u << 3); /* GPIOC, GPIOD */
    RCC->APB1ENR |= 1u << 20;
    GPIOC->AFRH |= 8u << 16;
    GPIOC->MODER |= 2u << 24;
    GPIOD->AFRL |= 8u << 8;
    GPIOD->PUPDR |= 1u << 4;
    GPIOD->MODER |= 2u << 4;
    UART5->BRR = (42000000u + baud[kind] / 2u) / baud[kind];
    UART5->CR2 = kind == SERIAL_SBUS ? 2u << 12 : 0u; /* two stop bits */
    UART5->CR1 = (1u << 13) | (1u << 5) | (1u << 3) | (1u << 2) |
                 (kind == SERIAL_SBUS ? (1u << 12) | (1u << 10) : 0u); /* nine bits, the ninth even parity */
    NVIC_ISER[UART5_IRQ / 32u] = 1u << (UART5_IRQ % 32u);
}

/* A damaged byte is left out: its frame is then too short. */
void receiver_interrupt(void)
{
    const uint32_t status = UART5->SR;
    if ((status & (USART_SR_RXNE | OVERRUN)) != 0) {
        const uint8_t byte = (uint8_t)UART5->DR;
        if ((status & USART_SR_RXNE) != 0 && (status & ERRORS) == 0) {
            line.bytes[line.head % RING] = byte;
            line.at_us[line.head % RING] = (uint16_t)TIM2->CNT;
            line.head++;
        }
    }
    if ((status & USART_SR_TXE) != 0 && (UART5->CR1 & (1u << 7)) != 0) {
        if (line.left > 0) {
            UART5->DR = line.out[line.sent];
            line.sent++;
            line.left--;
        } else {
            UART5->CR1 &= ~(1u << 7);
        }
    }
}

void receiver_hear(serial_radio *r, uint64_t now_us)
{
    const uint32_t head = line.head;
    if (head - line.tail > RING) {
        line.tail = head - RING;
    }
    for (; line.tail != head; line.tail++) {
        const uint16_t after_us = (uint16_t)(line.at_us[line.tail % RING] - (uint16_t)now_us);
        const bool before = after_us >= 0x8000u; /* else it came since now_us was asked for */
        serial_radio_take(r, line.bytes[line.tail % RING], before ? now_us - (uint64_t)(0x10000u - after_us) : now_us + after_us);
    }
}

void receiver_tell(const uint8_t *bytes, size_t count)
{
    if (line.left == 0 && count <= SERIAL_LONGEST) {
        memcpy(line.out, bytes, count);
        line.sent = 0;
        line.left = count;
        UART5->CR1 |= 1u << 7;
    }
}
