/* USART1 (PA9, PA10) to the bridge, USART2 (PA2, PA3) to a simulation. See board.h.
 *
 * DMA by RM0090 table 42: USART1 on DMA2 streams 2 and 7, USART2 on DMA1 streams 5 and 6, channel 4. */
#include <string.h>

#include "board.h"

#define RING 1024u /* a power of two; 10 ms at 921600 baud */
#define BAUD 921600u

typedef struct {
    usart_registers *usart;
    dma_registers *dma;
    uint8_t rx_stream, tx_stream;
    uint8_t rx[RING], tx[RING];
    volatile uint32_t head; /* written, by interrupt; counts on */
    uint32_t tail;          /* read */
    uint32_t queued, sent, sending; /* positions in tx */
} port;

static port ports[2] = {
    {.usart = USART1, .dma = DMA2, .rx_stream = 2, .tx_stream = 7},
    {.usart = USART2, .dma = DMA1, .rx_stream = 5, .tx_stream = 6},
};
static bool with_dma;

static void start_port(port *p, uint32_t clock_hz)
{
    dma_stream *rx = &p->dma->S[p->rx_stream];
    p->usart->BRR = (clock_hz + BAUD / 2u) / BAUD;
    if (with_dma) {
        rx->PAR = (uint32_t)(uintptr_t)&p->usart->DR;
        rx->M0AR = (uint32_t)(uintptr_t)p->rx;
        rx->NDTR = RING;
        rx->CR = (4u << 25) | (1u << 10) | (1u << 8) | DMA_CR_EN; /* channel 4, memory goes on, circular */
        p->usart->CR3 = (1u << 7) | (1u << 6);
        p->usart->CR1 = (1u << 13) | (1u << 3) | (1u << 2);
    } else {
        p->usart->CR1 = (1u << 13) | (1u << 5) | (1u << 3) | (1u << 2);
    }
}

void uart_start(void)
{
    RCC->AHB1ENR |= (1u << 0) | (1u << 21) | (1u << 22); /* GPIOA, DMA1, DMA2 */
    RCC->APB2ENR |= 1u << 4;
    RCC->APB1ENR |= 1u << 17;
    GPIOA->AFRL |= (7u << 8) | (7u << 12);
    GPIOA->AFRH |= (7u << 4) | (7u << 8);
    GPIOA->MODER |= (2u << 4) | (2u << 6) | (2u << 18) | (2u << 20);
    DMA1->S[0].PAR = 0x40000000u; /* a register that keeps what is written: there is a DMA */
    with_dma = DMA1->S[0].PAR == 0x40000000u;
    start_port(&ports[UART_BRIDGE], 84000000u);
    start_port(&ports[UART_SIMULATION], 42000000u);
    if (!with_dma) {
        NVIC_ISER[USART1_IRQ / 32u] = 1u << (USART1_IRQ % 32u);
        NVIC_ISER[USART2_IRQ / 32u] = 1u << (USART2_IRQ % 32u);
    }
}

static void take(port *p)
{
    if ((p->usart->SR & USART_SR_RXNE) != 0) {
        const uint8_t byte = (uint8_t)p->usart->DR;
        p->rx[p->head % RING] = byte;
        p->head++;
    }
}

void uart_1_interrupt(void)
{
    take(&ports[UART_BRIDGE]);
}

void uart_2_interrupt(void)
{
    take(&ports[UART_SIMULATION]);
}

/* What is older than a ring is lost; the frames' checksums show it. */
size_t uart_read(uart which, uint8_t *bytes, size_t room)
{
    port *p = &ports[which];
    uint32_t head = p->head;
    if (with_dma) {
        const uint32_t at = RING - p->dma->S[p->rx_stream].NDTR;
        head = p->tail + ((at - p->tail) % RING);
    } else if (head - p->tail > RING) {
        p->tail = head - RING;
    }
    size_t count = 0;
    while (count < room && p->tail != head) {
        bytes[count++] = p->rx[p->tail++ % RING];
    }
    return count;
}

bool uart_quiet(void)
{
    return !with_dma && ports[0].head == ports[0].tail && ports[1].head == ports[1].tail;
}

/* Hand the DMA what waits, in one piece up to the ring's end. */
static void go_on(port *p)
{
    dma_stream *tx = &p->dma->S[p->tx_stream];
    if ((tx->CR & DMA_CR_EN) != 0) {
        return;
    }
    p->sent += p->sending;
    const uint32_t first = p->sent % RING, waiting = p->queued - p->sent;
    p->sending = waiting < RING - first ? waiting : RING - first;
    if (p->sending > 0) {
        reg *clear = p->tx_stream > 3 ? &p->dma->HIFCR : &p->dma->LIFCR;
        *clear = p->tx_stream == 7 ? 0x3Du << 22 : 0x3Du << 16; /* streams 7, 6 */
        tx->PAR = (uint32_t)(uintptr_t)&p->usart->DR;
        tx->M0AR = (uint32_t)(uintptr_t)&p->tx[first];
        tx->NDTR = p->sending;
        tx->CR = (4u << 25) | (1u << 10) | (1u << 6) | DMA_CR_EN;
    }
}

size_t uart_room(uart which)
{
    port *p = &ports[which];
    if (!with_dma) {
        return RING;
    }
    go_on(p);
    return RING - (p->queued - p->sent);
}

void uart_write(uart which, const uint8_t *bytes, size_t count)
{
    port *p = &ports[which];
    for (size_t i = 0; i < count; i++) {
        if (with_dma) {
            p->tx[p->queued++ % RING] = bytes[i];
        } else {
            p->usart->DR = bytes[i];
        }
    }
    if (with_dma) {
        go_on(p);
    }
}
