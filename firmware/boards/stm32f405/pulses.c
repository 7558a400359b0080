/* Receiver on TIM4 (PB6 to PB9) and TIM5 (PA0, PA1), motors on TIM3 (PC6 to PC9), battery on ADC1 (PC0).
 * RM0090 18.3.5 input capture, 18.3.9 PWM mode. NOT YET RUN ON A BOARD. See board.h. */
#include "board.h"
#include "esc.h"

#define TIMERS_MHZ 84u
#define EDGES 64u /* a power of two */
#define V_PER_LSB (3.3f / 4095.0f)

static radio_edge edges[EDGES];
static volatile uint32_t head; /* written, by interrupt; counts on */
static uint32_t tail;          /* read */

static void start_capture(timer_registers *timer, uint32_t channels, uint32_t irq)
{
    timer->PSC = TIMERS_MHZ - 1u;
    timer->ARR = 0xFFFFu;
    timer->CCMR1 = 0x3131u; /* inputs, filtered over eight clocks */
    timer->CCMR2 = 0x3131u;
    timer->EGR = 1;
    timer->SR = 0;
    timer->CCER = channels == 4 ? 0xBBBBu : 0xBBu; /* both edges */
    timer->DIER = channels == 4 ? 0x1Eu : 0x06u;
    timer->CR1 = 1;
    NVIC_ISER[irq / 32u] = 1u << (irq % 32u);
}

static void start_motors(void)
{
    TIM3->PSC = TIMERS_MHZ - 1u;
    TIM3->ARR = ESC_PERIOD_US - 1u;
    TIM3->CCR1 = TIM3->CCR2 = TIM3->CCR3 = TIM3->CCR4 = (uint16_t)ESC_LEAST_US;
    TIM3->CCMR1 = 0x6868u; /* PWM mode 1, a new pulse from the next period on */
    TIM3->CCMR2 = 0x6868u;
    TIM3->EGR = 1;
    TIM3->CCER = 0x1111u;
    TIM3->CR1 = (1u << 7) | 1u;
}

/* 13.13: channel 10 over and over, 480 clocks of 21 MHz each */
static void start_battery(void)
{
    ADC_CCR = 1u << 16;
    ADC1->SMPR1 = 7;
    ADC1->SQR3 = 10;
    ADC1->CR2 = 3;
    ADC1->CR2 |= 1u << 30;
}

void pulses_start(void)
{
    RCC->AHB1ENR |= 7u; /* GPIOA to GPIOC */
    RCC->APB1ENR |= 7u << 1;
    RCC->APB2ENR |= 1u << 8;
    start_motors(); /* before its pins */
    GPIOA->AFRL |= (2u << 0) | (2u << 4);
    GPIOA->PUPDR |= (2u << 0) | (2u << 2); /* down: a loose wire is silent */
    GPIOA->MODER |= (2u << 0) | (2u << 2);
    GPIOB->AFRL |= (2u << 24) | (2u << 28);
    GPIOB->AFRH |= (2u << 0) | (2u << 4);
    GPIOB->PUPDR |= 0xAAu << 12;
    GPIOB->MODER |= 0xAAu << 12;
    GPIOC->AFRL |= (2u << 24) | (2u << 28);
    GPIOC->AFRH |= (2u << 0) | (2u << 4);
    GPIOC->MODER |= (0xAAu << 12) | 3u;
    start_capture(TIM4, 4, TIM4_IRQ);
    start_capture(TIM5, 2, TIM5_IRQ);
    start_battery();
}

static void keep(uint32_t at_us, uint32_t wire, bool high)
{
    const radio_edge edge = {(uint16_t)at_us, (uint8_t)wire, high};
    edges[head % EDGES] = edge;
    head++;
}

/* A flag is cleared by writing 0 to it; the pin still has the level of the edge: pulses last 800 us. */
void receiver_4_interrupt(void)
{
    reg *captured = &TIM4->CCR1;
    const uint32_t flags = TIM4->SR, pins = GPIOB->IDR >> 6;
    TIM4->SR = ~flags;
    for (uint32_t i = 0; i < 4; i++) {
        if ((flags & (2u << i)) != 0) {
            keep(captured[i], i, (pins & (1u << i)) != 0);
        }
    }
}

void receiver_5_interrupt(void)
{
    reg *captured = &TIM5->CCR1;
    const uint32_t flags = TIM5->SR, pins = GPIOA->IDR;
    TIM5->SR = ~flags;
    for (uint32_t i = 0; i < 2; i++) {
        if ((flags & (2u << i)) != 0) {
            keep(captured[i], 4 + i, (pins & (1u << i)) != 0);
        }
    }
}

bool pulses_edge(radio_edge *edge)
{
    const uint32_t written = head;
    if (written - tail > EDGES) {
        tail = written - EDGES;
    }
    if (tail == written) {
        return false;
    }
    *edge = edges[tail % EDGES];
    tail++;
    return true;
}

void pulses_motors(const float motors[4], float least_us, float most_us)
{
    reg *pulse = &TIM3->CCR1;
    for (size_t i = 0; i < 4; i++) {
        pulse[i] = esc_pulse_us(motors[i], least_us, most_us);
    }
}

float battery_pin_v(void)
{
    return V_PER_LSB * (float)(ADC1->DR & 0xFFFu);
}
